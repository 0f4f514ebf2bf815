from __future__ import annotations

import stat
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labapp.config.setup import read_setup, update_setup, updated_setup
from labapp.config.setup_text import frame_px_of
from labapp.core.geometry.rig import Laser
from labapp.core.geometry.uncertainty import (
    ANGLE,
    DISTANCE,
    GLASS,
    INDEX,
    POINTS,
    QUANTITIES,
    RigUncertainty,
)
from labapp.errors import InputError

SETUP = """\
# bench 2
[laser]
projection_angle_deg = 31.14   # by the cross hair
distance_mm = 31.48
[pattern]
rows = 19
columns = 19
inter_beam_angle_deg = 0.77
[electrode]
height_mm = 5.0
[imaging_plane]
distance_mm = 50
s_mm = 45.0
h_mm = 3.0
width_mm = 101.6
height_mm = 101.6
[image_calibration]
origin_px = [44.0, 590.0]
x_axis_px = [440.0, 590.0]
x_axis_mm = 69.85
z_axis_px = [44.0, 410.0]
z_axis_mm = 31.75
"""
HOMOGRAPHY = SETUP[: SETUP.index("origin_px")] + (
    "homography = [[0.2, 0.0, -8.0], [0.0, -0.2, 110.0], [0.0, 0.0, 1.0]]\n"
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "setup.toml"
    path.write_text(SETUP, encoding="utf-8")
    return path


def change(path: Path, old: str, new: str) -> Path:
    assert path.read_text().count(old) == 1
    path.write_text(path.read_text().replace(old, new))
    return path


def test_setup_is_read(path: Path) -> None:
    setup = read_setup(path)
    rig = setup.rig
    assert (rig.laser.projection_angle_deg, rig.laser.distance_mm) == (31.14, 31.48)
    assert (rig.pattern.rows, rig.pattern.columns) == (19, 19)
    assert rig.pattern.absent_rays == {(10, 10)}
    assert rig.electrode.height_mm == 5.0
    np.testing.assert_allclose(rig.imaging_plane.origin_mm, [-45, -50, 3])
    np.testing.assert_allclose(rig.imaging_plane.normal, [0, -1, 0])
    assert (rig.imaging_plane.width_mm, rig.imaging_plane.height_mm) == (101.6, 101.6)
    np.testing.assert_allclose(
        setup.calibration.to_plane(np.array([[44, 590], [440, 410]])),
        [[0, 0], [69.85, 31.75]],
        atol=1e-9,
    )
    assert setup.text == SETUP


def test_documented_setup_is_valid(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "command-line.md").read_text(encoding="utf-8")
    path = tmp_path / "setup.toml"
    path.write_text(text.split("```toml\n")[1].split("```")[0], encoding="utf-8")
    assert read_setup(path).rig.pattern.absent_rays == {(10, 10)}


def test_absent_rays_can_be_listed(path: Path) -> None:
    change(path, "rows = 19\n", "rows = 19\nabsent = [[1, 2], [10, 10]]\n")
    assert read_setup(path).rig.pattern.absent_rays == {(1, 2), (10, 10)}


def test_byte_order_mark_and_crlf_are_accepted(path: Path) -> None:
    path.write_bytes(b"\xef\xbb\xbf" + SETUP.replace("\n", "\r\n").encode())
    assert read_setup(path).rig.laser.distance_mm == 31.48


def test_plane_can_be_tilted(path: Path) -> None:
    change(path, "h_mm = 3.0\n", "h_mm = 3.0\npitch_deg = 10\nyaw_deg = 20\n")
    plane = read_setup(path).rig.imaging_plane
    pitch, yaw = np.radians([10, 20])
    about_x = np.array(
        [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
    )
    about_z = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    np.testing.assert_allclose(plane.x_axis, about_z @ about_x @ [1, 0, 0])
    np.testing.assert_allclose(plane.z_axis, about_z @ about_x @ [0, 0, 1])
    np.testing.assert_allclose(plane.origin_mm, [-45, -50, 3])


def test_homography_replaces_the_three_points(path: Path) -> None:
    path.write_text(HOMOGRAPHY)
    plane_mm = read_setup(path).calibration.to_plane(np.array([100.0, 50.0]))
    np.testing.assert_allclose(plane_mm, [12.0, 100.0])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("distance_mm = 31.48", "distance_mm = -31.48", "laser.distance_mm: -31.48; expected a nu"),
        ("distance_mm = 31.48", "distance_mm = nan", "laser.distance_mm: nan; expected a number"),
        ("distance_mm = 31.48", "distance_mm = inf", "laser.distance_mm: inf; expected"),
        ("distance_mm = 31.48", "distance_mm = true", "laser.distance_mm: true; expected a number"),
        ("distance_mm = 31.48", "distance_mm = '31'", 'laser.distance_mm: "31"; expected a number'),
        ("distance_mm = 31.48", f"distance_mm = 1{'0' * 400}", "expected a number above 0 and bel"),
        ("distance_mm = 31.48", "distance_mm = 1e-300", "laser.distance_mm: 1e-300; expected"),
        ("x_axis_mm = 69.85", "x_axis_mm = 1e-300", "x_axis_mm: 1e-300; .* not 0"),
        ("distance_mm = 31.48\n", "", "laser.distance_mm: missing; expected a number above 0"),
        (
            "distance_mm = 31.48",
            "distanse_mm = 31.48",
            "unknown key; expected distance_mm, the most",
        ),
        ("= 31.14", "= 0", "laser.projection_angle_deg: 0; expected a number above 0 and below 90"),
        ("= 31.14", "= 90.0", "laser.projection_angle_deg: 90.0; expected a number above 0 and"),
        ("= 31.14", "= 6.9", "laser.projection_angle_deg: 6.9; expected a number above half the f"),
        ("rows = 19", "rows = 18", "pattern.rows: 18; expected an odd whole number"),
        ("rows = 19", "rows = 0", "pattern.rows: 0; expected an odd"),
        ("rows = 19", "rows = 19.0", "pattern.rows: 19.0; expected an odd whole number"),
        ("rows = 19", "rows = 19\nabsent = [[0, 3]]", r"pattern.absent: \[0, 3\]; expected rays"),
        ("rows = 19", "rows = 19\nabsent = [[20, 3]]", r"\[1, 1\] to \[19, 19\]"),
        ("rows = 19", "rows = 19\nabsent = [10, 10]", "pattern.absent: .* expected a list of rays"),
        (
            "angle_deg = 0.77",
            "angle_deg = 5",
            "inter_beam_angle_deg: 5; expected a number below 5 ",
        ),
        ("h_mm = 3.0\n", "h_mm = 3.0\npitch_deg = 91\n", "imaging_plane.pitch_deg: 91; expected"),
        ("height_mm = 5.0", "height_mm = -1", "electrode.height_mm: -1; expected a number from 0"),
        ("[44.0, 590.0]", "[44.0]", r"image_calibration.origin_px: \[44.0\]; expected \[u, v\]"),
        ("[44.0, 590.0]", "[44.0, nan]", r"image_calibration.origin_px: \[44.0, nan\]"),
        ("[440.0, 590.0]", "[44.0, 590.0]", "image_calibration: .* lie on one line"),
        ("[440.0, 590.0]", "[44.0, 500.0]", "image_calibration: .* lie on one line"),
        ("[440.0, 590.0]", "[50.0, 500.0]", "image_calibration: .* nearly on one line; .* 10 deg"),
        ("x_axis_mm = 69.85", "x_axis_mm = 0", "image_calibration.x_axis_mm: 0; .* not 0"),
        ("[electrode]\nheight_mm = 5.0\n", "", r"electrode: missing; expected a table \[electrode"),
        (
            "[electrode]",
            "[elektrode]",
            "elektrode: unknown key; expected electrode, the most",
        ),
        ("# bench 2", "electrode = 5", "syntax|electrode: 5"),
        ("rows = 19", "rows = ", "syntax: line .* a value after rows ="),
        ("rows = 19", "rows = 19,5", r"syntax: line .* a decimal point: 19\.5"),
        ("rows = 19", "rows = 19 mm", "syntax: line .* without its unit: rows = 19$"),
        ("rows = 19", "rows = many", 'syntax: line .* text in quotation marks: rows = "many"'),
        ("rows = 19", "rows = 19\nrows = 19", "syntax: "),
    ],
)
def test_wrong_value_is_named(path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_setup(change(path, old, new))
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("[0.0, 0.0, 1.0]]", "[0.0, 0.0, 0.0]]"),
        ("[0.0, 0.0, 1.0]]", "[0.0, 0.0]]"),
        ("[0.0, 0.0, 1.0]]", "[0.0, 0.0, true]]"),
        ("-8.0", "nan"),
    ],
)
def test_wrong_homography_is_rejected(path: Path, old: str, new: str) -> None:
    path.write_text(HOMOGRAPHY)
    with pytest.raises(InputError, match=r"image_calibration\.homography: .*3 rows of 3 numbers"):
        read_setup(change(path, old, new))


@pytest.mark.parametrize("row", ["[0.0, -0.004, 1.0]]", "[0.01, 0.0, 1e-300]]"])
def test_horizon_across_the_plane_is_rejected(path: Path, row: str) -> None:
    path.write_text(HOMOGRAPHY)
    with pytest.raises(InputError) as caught:
        read_setup(change(path, "[0.0, 0.0, 1.0]]", row))
    assert [each.field for each in caught.value.problems] == ["image_calibration.homography"]


@pytest.mark.parametrize("k1", [-4.0, -5.0, -1e300])
@pytest.mark.parametrize("points", [True, False])
def test_distortion_that_cannot_be_undone_is_rejected(path: Path, k1: float, points: bool) -> None:
    text = path.read_text() if points else HOMOGRAPHY
    lens = "focal_px = [800, 800]\ncenter_px = [240, 320]\n"
    path.write_text(f"{text}\n[camera_lens]\n{lens}distortion = [{k1}, 0, 0, 0, 0]\n")
    with pytest.raises(InputError) as caught:
        read_setup(path)
    assert [each.field for each in caught.value.problems] == ["camera_lens.distortion"]
    read_setup(change(path, f"[{k1},", "[-0.3,"))


@pytest.mark.parametrize(
    ("frame_px", "k1", "valid"),
    [
        ("", -0.8, False),  # at O′ and on the axes it can be undone
        ("frame_px = [480, 640]", -0.8, False),
        ("frame_px = [480, 640]", -0.5, True),
        ("", -0.5, True),
    ],
)
def test_distortion_that_folds_beside_the_axes_is_rejected(
    path: Path, frame_px: str, k1: float, valid: bool
) -> None:
    text = path.read_text()
    lens = "focal_px = [800, 800]\ncenter_px = [240, 320]\n"
    lens += f"distortion = [{k1}, 0, 0, 0, 0]\n"
    text = text.replace("[image_calibration]", f"[image_calibration]\n{frame_px}")
    path.write_text(f"{text}\n[camera_lens]\n{lens}")
    if valid:
        read_setup(path)
        return
    with pytest.raises(InputError) as caught:
        read_setup(path)
    assert [each.field for each in caught.value.problems] == ["camera_lens.distortion"]


def test_pattern_without_rays_is_rejected(path: Path) -> None:
    rays = [[i, j] for i in range(1, 20) for j in range(1, 20)]
    change(path, "rows = 19\n", f"rows = 19\nabsent = {rays}\n")
    with pytest.raises(InputError) as caught:
        read_setup(path)
    assert caught.value.field == "pattern.absent"
    read_setup(change(path, "[1, 1], ", ""))


def test_two_forms_of_calibration_are_rejected(path: Path) -> None:
    path.write_text(HOMOGRAPHY + "z_axis_mm = 31.75\n")
    with pytest.raises(InputError, match=r"image_calibration\.z_axis_mm: unknown key") as caught:
        read_setup(path)
    assert "homography" in caught.value.expected  # not a key that is merely spelt alike


def test_all_problems_are_reported_together(path: Path) -> None:
    change(path, "distance_mm = 31.48", "distance_mm = -1")
    change(path, "columns = 19\n", "")
    change(path, "height_mm = 5.0", "height_mm = 5.0\ntip = 1")
    with pytest.raises(InputError) as caught:
        read_setup(path)
    assert {problem.field for problem in caught.value.problems} == {
        "laser.distance_mm",
        "pattern.columns",
        "electrode.tip",
    }


def test_invalid_setup_file_is_rejected(tmp_path: Path, path: Path) -> None:
    path.write_bytes(b"\xff\xfe[\x00l\x00")
    with pytest.raises(InputError, match="encoding: not UTF-8"):
        read_setup(path)
    with pytest.raises(InputError, match="No such file"):
        read_setup(tmp_path / "missing.toml")
    with pytest.raises(InputError, match="Is a directory"):
        read_setup(tmp_path)
    path.write_bytes(b"")
    with pytest.raises(InputError, match="laser: missing"):
        read_setup(path)


@given(st.text())
def test_any_text_raises_an_input_error(text: str) -> None:
    with mock.patch("labapp.config.setup.read_text", return_value=text), pytest.raises(InputError):
        read_setup("setup.toml")


toml_values = st.recursive(
    st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda values: st.lists(values, max_size=4),
    max_leaves=6,
)


@given(
    st.sampled_from("laser pattern electrode imaging_plane image_calibration".split()),
    st.sampled_from(
        "distance_mm rows absent height_mm s_mm pitch_deg homography x_axis_px".split()
    ),
    toml_values,
)
def test_any_value_is_accepted_or_raises_an_input_error(
    section: str, key: str, value: object
) -> None:
    import tomllib

    values = tomllib.loads(SETUP)
    values[section][key] = value
    with (
        mock.patch("labapp.config.setup.read_text", return_value=SETUP),
        mock.patch("labapp.config.toml_keys.tomllib.loads", return_value=values),
    ):
        try:
            setup = read_setup("setup.toml")
        except InputError:
            return
    assert np.isfinite(setup.calibration.matrix).all()


def write_values(path: Path, values: dict[str, dict[str, object]]) -> None:
    """Change a setup file as `update_setup`, without its check."""
    path.write_text(updated_setup(path.read_text(), path, values))


@pytest.mark.parametrize("lacking", ["", "[electrode]"])
def test_update_refuses_only_wrong_values_of_its_own(path: Path, lacking: str) -> None:
    path.write_text(path.read_text().replace(lacking, "[other]") if lacking else path.read_text())
    before = path.read_text()
    with pytest.raises(InputError) as caught:
        update_setup(path, {"laser": {"projection_angle_deg": 90.0, "distance_mm": 40.0}})
    assert caught.value.field == "laser.projection_angle_deg"
    assert caught.value.others == ()
    assert path.read_text() == before
    update_setup(path, {"laser": {"projection_angle_deg": 40.0}})
    assert "projection_angle_deg = 40.0" in path.read_text()


def test_update_preserves_comments_and_other_keys(path: Path) -> None:
    update_setup(path, {"laser": {"projection_angle_deg": 30.5, "distance_mm": 40.0}})
    expected = SETUP.replace("31.14", "30.5").replace("31.48", "40.0")
    assert path.read_text() == expected
    assert read_setup(path).rig.laser.distance_mm == 40.0


def test_update_can_replace_a_homography(path: Path) -> None:
    path.write_text(HOMOGRAPHY)
    points = {
        "origin_px": [44.0, 590.0],
        "x_axis_px": [440.0, 590.0],
        "x_axis_mm": 69.85,
        "z_axis_px": [44.0, 410.0],
        "z_axis_mm": 31.75,
    }
    update_setup(path, {"image_calibration": {**points, "homography": None}})
    plane_mm = read_setup(path).calibration.to_plane(np.array([440.0, 410.0]))
    np.testing.assert_allclose(plane_mm, [69.85, 31.75])


def test_update_creates_missing_file_and_tables(tmp_path: Path) -> None:
    path = tmp_path / "new.toml"
    update_setup(path, {"laser": {"projection_angle_deg": 30.5, "distance_mm": 40.0}})
    update_setup(path, {"electrode": {"height_mm": 5.0}})
    assert path.read_text() == (
        "[laser]\nprojection_angle_deg = 30.5\ndistance_mm = 40.0\n\n[electrode]\nheight_mm = 5.0\n"
    )
    with pytest.raises(InputError) as caught:
        read_setup(path)
    assert [problem.field for problem in caught.value.problems] == [
        "pattern",
        "imaging_plane",
        "image_calibration",
    ]


def test_failed_update_changes_nothing(path: Path) -> None:
    values = {"laser": {"distance_mm": 40.0}}
    with (
        mock.patch("pathlib.Path.replace", side_effect=OSError(28, "No space left on device")),
        pytest.raises(InputError, match="No space left on device"),
    ):
        update_setup(path, values)
    assert path.read_text() == SETUP
    assert [entry.name for entry in path.parent.iterdir()] == ["setup.toml"]
    path.write_text("rows = ")
    with pytest.raises(InputError, match="syntax"):
        update_setup(path, values)
    path.write_text("laser = 3")
    with pytest.raises(InputError, match="laser: 3; expected a table"):
        update_setup(path, values)
    assert path.read_text() == "laser = 3"


def test_update_preserves_permissions_and_links(path: Path, tmp_path: Path) -> None:
    path.chmod(0o640)
    link = tmp_path / "link.toml"
    link.symlink_to(path)
    update_setup(link, {"laser": {"distance_mm": 40.0}})
    assert link.is_symlink()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert read_setup(path).rig.laser.distance_mm == 40.0


FULL = {
    "[pattern]": """azimuth_deg = 0.5
aim_y_mm = -0.2
projection_angle_deg_sigma = 0.25
angle_distance_correlation = 0.9
[pattern]
rotation_deg = 1.5""",
    "[image_calibration]": """roll_deg = 0.4
s_mm_sigma = 0.05
[camera_lens]
focal_px = [1500.0, 1490.0]
center_px = [310.0, 300.0]
distortion = [-0.1, 0.0, 0.001, 0.0, 0.0]
distortion_percent_sigma = 0.1
[image_calibration]
origin_px_sigma = 0.04""",
}


def test_nonideal_bench_is_read_with_its_uncertainty(path: Path) -> None:
    for old, new in FULL.items():
        change(path, old, new)
    setup = read_setup(path)
    rig, uncertainty = setup.rig, setup.rig.uncertainty
    assert uncertainty is not None
    assert (rig.laser.azimuth_deg, rig.laser.aim_x_mm, rig.laser.aim_y_mm) == (0.5, 0.0, -0.2)
    assert rig.pattern.rotation_deg == 1.5
    assert rig.imaging_plane.angles_deg == pytest.approx((0, 0, 0.4))
    assert setup.calibration.lens is not None
    assert setup.calibration.lens.focal_px == (1500.0, 1490.0)
    sigma = dict(zip([quantity.key for quantity in QUANTITIES], uncertainty.sigma, strict=True))
    assert sigma["laser.projection_angle_deg"] == pytest.approx(0.25)
    assert sigma["imaging_plane.s_mm"] == pytest.approx(0.05)
    assert sigma["image_calibration.origin_px[u]"] == pytest.approx(0.04)
    assert sigma["image_calibration.origin_px[v]"] == pytest.approx(0.04)
    assert sigma["camera_lens.distortion_percent"] == pytest.approx(0.1)
    assert uncertainty.correlation[ANGLE, DISTANCE] == pytest.approx(0.9)
    assert "laser.distance_mm" in uncertainty.assumed
    assert not {"imaging_plane.s_mm", "image_calibration.origin_px[v]"} & uncertainty.assumed


def test_setup_without_uncertainties_has_the_assumed_ones(path: Path) -> None:
    setup = read_setup(path)
    uncertainty = setup.rig.uncertainty
    assert setup.rig.laser == Laser(31.14, 31.48)
    assert setup.calibration.lens is None
    assert uncertainty is not None
    assert uncertainty.assumed == {quantity.key for quantity in QUANTITIES} - GLASS
    assumed = [0.0 if quantity.key in GLASS else quantity.assumed for quantity in QUANTITIES]
    np.testing.assert_allclose(uncertainty.sigma, assumed)


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("[pattern]", "distance_mm_sigma = -1.0\n[pattern]", "laser.distance_mm_sigma"),
        ("[pattern]", "angle_distance_correlation = 2\n[pattern]", "angle_distance_correlation"),
        ("[pattern]", "rows_sigma = 2\n[pattern]", "laser.rows_sigma"),
        ("[pattern]", "[camera_lens]\nfocal_px = [1.0, 1.0]\n[pattern]", "camera_lens.center_px"),
        ("[pattern]", "[camera_lens]\nfocal_px = [0.0, 1.0]\n[pattern]", "camera_lens.focal_px"),
    ],
)
def test_wrong_uncertainties_and_lenses_are_rejected(
    path: Path, old: str, new: str, field: str
) -> None:
    with pytest.raises(InputError) as caught:
        read_setup(change(path, old, new))
    assert field in str(caught.value)


def test_lens_may_have_only_an_uncertainty(path: Path) -> None:
    setup = read_setup(
        change(path, "[pattern]", "[camera_lens]\ndistortion_percent_sigma = 0\n[pattern]")
    )
    assert setup.calibration.lens is None
    assert setup.rig.uncertainty is not None
    assert setup.rig.uncertainty.sigma[INDEX["camera_lens.distortion_percent"]] == 0.0


def test_glass_and_axis_points_have_uncertainties(path: Path) -> None:
    values = {
        "imaging_plane": {"glass_mm": 3.0, "glass_index_sigma": 0.005},
        "image_calibration": {"x_axis_mm_sigma": 0.02},
    }
    update_setup(path, values)
    uncertainty = read_setup(path).rig.uncertainty
    assert uncertainty is not None
    keys = [f"imaging_plane.glass_{suffix}" for suffix in ("mm", "index")]
    keys += [f"image_calibration.{axis}_axis_mm" for axis in "xz"]
    np.testing.assert_allclose(
        uncertainty.sigma[[INDEX[key] for key in keys]], [0.1, 0.005, 0.02, 0.1]
    )
    assert uncertainty.assumed & set(keys) == {keys[0], keys[3]}


def test_glass_and_welding_direction_are_read(path: Path) -> None:
    plain = read_setup(path).rig
    assert (plain.imaging_plane.glass_mm, plain.travel) == (0.0, "+y")
    update_setup(path, {"imaging_plane": {"glass_mm": 3.0}, "torch": {"travel": "-y"}})
    rig = read_setup(path).rig
    assert (rig.imaging_plane.glass_mm, rig.imaging_plane.glass_index) == (3.0, 1.5)
    assert (rig.travel, rig.head_sign) == ("-y", -1)
    update_setup(path, {"imaging_plane": {"glass_index": 1.46}})
    assert read_setup(path).rig.imaging_plane.glass_index == 1.46


@pytest.mark.parametrize(
    ("section", "key", "value", "field"),
    [
        ("torch", "travel", "+x", "torch.travel"),
        ("torch", "travel", ["-y"], "torch.travel"),
        ("torch", "speed", 3.0, "torch.speed"),
        ("imaging_plane", "glass_mm", -1.0, "imaging_plane.glass_mm"),
        ("imaging_plane", "glass_mm", 60.0, "imaging_plane.glass_mm"),
        ("imaging_plane", "glass_index", 0.9, "imaging_plane.glass_index"),
    ],
)
def test_wrong_glass_and_directions_are_rejected(
    path: Path, section: str, key: str, value: object, field: str
) -> None:
    write_values(path, {section: {key: value}})
    with pytest.raises(InputError) as caught:
        read_setup(path)
    assert caught.value.field == field


def test_changed_value_loses_its_calibrated_uncertainty(path: Path) -> None:
    calibrated = {
        "projection_angle_deg": 31.0,
        "projection_angle_deg_sigma": 0.2,
        "distance_mm": 31.5,
        "distance_mm_sigma": 0.3,
        "angle_distance_correlation": 0.9,
        "azimuth_deg_sigma": 0.1,
    }
    update_setup(path, {"laser": calibrated})
    update_setup(path, {"laser": {"distance_mm": 31.5}})  # the same value
    assert read_setup(path).rig.uncertainty.sigma[DISTANCE] == 0.3
    update_setup(path, {"laser": {"distance_mm": 32.0, "azimuth_deg": 1.0}})
    uncertainty = read_setup(path).rig.uncertainty
    assert uncertainty.sigma[[ANGLE, DISTANCE]].tolist() == [0.2, 0.5]
    assert uncertainty.correlation[ANGLE, DISTANCE] == 0.0
    assert uncertainty.sigma[INDEX["laser.azimuth_deg"]] == 0.1


COVARIANCE = np.diag([0.01, 0.04, 0.0025, 0.0025, 0.09, 0.09])
COVARIANCE[0, 2] = COVARIANCE[2, 0] = 0.003
"""Of the points of a calibration, px²: u of O′ and of the point on O′X′ are correlated."""


def test_calibration_points_have_a_full_covariance(path: Path) -> None:
    sigma = np.sqrt([0.025, 0.0025, 0.09])
    names = ("origin_px", "x_axis_px", "z_axis_px")
    sigmas = {f"{name}_sigma": float(value) for name, value in zip(names, sigma, strict=True)}
    points = np.ix_(POINTS, POINTS)

    def uncertainty_with(**keys: object) -> RigUncertainty:
        update_setup(path, {"image_calibration": keys})
        uncertainty = read_setup(path).rig.uncertainty
        assert uncertainty is not None
        return uncertainty

    full = uncertainty_with(**sigmas, points_covariance_px2=COVARIANCE.tolist())
    np.testing.assert_allclose(full.covariance[points], COVARIANCE)
    np.testing.assert_allclose(full.root @ full.root.T, full.covariance, atol=1e-9)
    wider = uncertainty_with(origin_px_sigma=2 * sigmas["origin_px_sigma"])
    np.testing.assert_allclose(wider.covariance[points][:2, :2], 4 * COVARIANCE[:2, :2])
    np.testing.assert_allclose(wider.correlation, full.correlation)
    # A changed point was not calibrated: its correlations are unknown.
    changed = uncertainty_with(origin_px=[45.0, 590.0])
    uncorrelated = np.diag([0.09, 0.09, 0.0025, 0.0025, 0.09, 0.09])
    np.testing.assert_allclose(changed.covariance[points], uncorrelated)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("origin_px_sigma", [0.1, 0.2]),
        ("points_covariance_px2", 0.5),
        ("points_covariance_px2", [[1.0, 0.0], [0.0, 1.0]]),
        ("points_covariance_px2", (COVARIANCE - 0.0025 * np.eye(6)).tolist()),
        ("points_covariance_px2", (COVARIANCE + np.eye(6, k=1)).tolist()),
        ("points_mm", [30.0, 30.0]),
    ],
)
def test_wrong_covariances_of_points_are_rejected(path: Path, key: str, value: object) -> None:
    write_values(path, {"image_calibration": {key: value}})
    with pytest.raises(InputError) as caught:
        read_setup(path)
    assert caught.value.field == f"image_calibration.{key}"


def test_points_of_a_homography_are_those_of_their_uncertainties(path: Path) -> None:
    setup = read_setup(path)
    points = ("origin_px", "x_axis_px", "x_axis_mm", "z_axis_px", "z_axis_mm")
    rows = {"homography": setup.calibration.matrix.tolist()}
    update_setup(path, {"image_calibration": dict.fromkeys(points) | rows})
    default = read_setup(path).rig
    assert default.uncertainty is not None
    assert default.uncertainty.axes.x_mm == default.imaging_plane.width_mm / 2
    update_setup(path, {"image_calibration": {"points_mm": [30.0, 20.0]}})
    uncertainty = read_setup(path).rig.uncertainty
    assert uncertainty is not None
    assert (uncertainty.axes.x_mm, uncertainty.axes.z_mm) == (30.0, 20.0)


def test_changed_points_discard_the_size_of_the_calibration_picture(
    path: Path,
) -> None:
    update_setup(path, {"image_calibration": {"frame_px": [640, 480]}})
    setup = read_setup(path)
    setup.require_size((480, 640), "frame 0")
    with pytest.raises(InputError) as refused:
        setup.require_size((240, 320), "frame 0")
    assert "320×240" in str(refused.value)
    assert "640×480" in str(refused.value)
    update_setup(path, {"image_calibration": {"origin_px": [45.0, 590.0]}})
    assert frame_px_of(path.read_text()) is None
    read_setup(path).require_size((240, 320), "frame 0")


@pytest.mark.parametrize("size", [[640], [640, 0], [640.5, 480], "640×480", True])
def test_wrong_size_of_the_calibration_picture_is_rejected(path: Path, size: object) -> None:
    write_values(path, {"image_calibration": {"frame_px": size}})
    with pytest.raises(InputError, match="frame_px"):
        read_setup(path)
