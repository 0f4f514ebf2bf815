"""`labapp simulate`: its files and its errors."""

from __future__ import annotations

import csv
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from labapp.config.scenario import read_scenario
from labapp.config.setup import parse_setup, read_setup
from labapp.core.pipeline import Settings, measure
from labapp.media import open_source
from labapp.simulated.simulate import simulate
from labapp.simulation.pools import Wave
from labapp.simulation.torch import ConeTorch
from labapp.system import IS_WINDOWS
from tests.conftest import INTERRUPTIBLE, Run
from tests.waiting import PATIENCE_S, wait_until

EXAMPLES = Path(__file__).parents[1] / "resources" / "simulations"
SCENARIO = (EXAMPLES / "mode_11.toml").read_text("utf-8")
BENCH = SCENARIO.partition("[laser]")[2].partition("[look]")[0]


def scenario(folder: Path, pool: str = "", more: str = "", **changed: str) -> Path:
    """Write a scenario of two small frames, with keys replaced by name and tables added."""
    text = SCENARIO
    if pool:
        text = f"[pool]\n{pool}\n[laser]{BENCH}" + text[text.index("[look]") :]
    for key, value in {"frames": "2", **changed}.items():
        text, count = re.subn(rf"(?m)^{key} = .*$", f"{key} = {value}", text, count=1)
        assert count == 1, key
    path = folder / "scenario.toml"
    path.write_text(text + more, "utf-8")
    return path


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def column(path: Path, name: str) -> np.ndarray:
    return np.array([float(row[name]) for row in rows(path)])


# --- written files -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulated") / "out"
    simulate(read_scenario(EXAMPLES / "mode_11.toml", frames=3), out, workers=1)
    return out


def test_recording_is_written_with_its_truth(written: Path) -> None:
    names = {path.name for path in written.iterdir()}
    tables = {"truth.csv", "dots_truth.csv"}
    assert names == tables | {"recording.avi", "setup.toml", "calibration.png", "scenario.toml"}
    assert [path.name for path in written.parent.iterdir()] == ["out"]
    with open_source(written / "recording.avi") as source:
        assert (len(source), source.frame_rate_hz, source.shape) == (3, 60.0, (640, 480))
    assert column(written / "truth.csv", "time_s").tolist() == [0.0, 0.01667, 0.03333]
    assert (written / "scenario.toml").read_text("utf-8") == SCENARIO


def test_shipped_scenario_is_found_by_its_name(
    tmp_path: Path, labapp: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for _ in range(2):  # the folder of that name is not taken for a scenario
        code, _, stderr = labapp("simulate", "egg", "--out", "egg", "--frames", 1)
        assert code == 0, stderr
    text = (tmp_path / "egg" / "scenario.toml").read_text("utf-8")
    assert text == (EXAMPLES / "egg.toml").read_text("utf-8")


@pytest.mark.skipif(IS_WINDOWS, reason="quoting as of a POSIX shell")
def test_next_command_is_quoted_for_the_shell(tmp_path: Path, labapp: Run) -> None:
    out = tmp_path / "my run"
    code, stdout, stderr = labapp("simulate", "egg", "--out", out, "--frames", 1)
    assert code == 0, stderr
    words = shlex.split(stdout.splitlines()[-1])
    names = [str(out / name) for name in ("recording.avi", "setup.toml")]
    assert words == ["labapp", "reconstruct", names[0], "--setup", names[1], "--out", "results"]


def test_truth_agrees_with_the_rays_and_with_the_picture(written: Path) -> None:
    """All values are read from the written files."""
    setup = read_setup(written / "setup.toml")
    lines = [row for row in rows(written / "dots_truth.csv") if row["frame"] == "1"]
    visible = [row for row in lines if row["visible"] == "1"]
    assert len(visible) == int(rows(written / "truth.csv")[1]["dots"]) > 90
    with open_source(written / "recording.avi") as source:
        image = source.frame(1).image.astype(float)
    px = np.array([[float(row["u_px"]), float(row["v_px"])] for row in visible])
    u, v = np.rint(px).astype(int).T
    around = np.stack([image[v + dv, u + du] for du in (-1, 0, 1) for dv in (-1, 0, 1)])
    assert (around.mean(axis=0) > np.median(image) + 8).mean() > 0.97
    # Each point lies on its ray of the pattern, by the angles of the setup file.
    point = np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in visible])
    ray = np.array([[int(row["ray_row"]), int(row["ray_column"])] for row in visible])
    alpha, beta = np.radians([31.14, 0.77])
    laser = 31.48 * np.array([0, np.cos(alpha), np.sin(alpha)])
    from_laser = point - laser
    axis, up = -laser / 31.48, np.array([0, -np.sin(alpha), np.cos(alpha)])
    along = from_laser @ axis
    np.testing.assert_allclose(
        np.arctan2(from_laser[:, 0], along), (ray[:, 1] - 10) * beta, atol=0.02 * beta
    )
    np.testing.assert_allclose(
        np.arctan2(from_laser @ up, along), (10 - ray[:, 0]) * beta, atol=0.02 * beta
    )
    assert setup.rig.laser.distance_mm == 31.48


def test_same_seed_gives_equal_files_for_any_number_of_processes(
    written: Path, tmp_path: Path
) -> None:
    for workers in (1, 2):
        simulate(read_scenario(EXAMPLES / "mode_11.toml", 3), tmp_path / "again", workers)
        for file in written.iterdir():
            assert (tmp_path / "again" / file.name).read_bytes() == file.read_bytes(), file.name


def test_another_seed_changes_noise_and_pool_sizes(written: Path, labapp: Run,
                                                        tmp_path: Path) -> None:  # fmt: skip
    out = tmp_path / "other"
    code, stdout, _ = labapp(
        "simulate", EXAMPLES / "mode_11.toml", "--out", out, "--frames", 1, "--seed", 7
    )
    assert code == 0
    assert "1 frame," in stdout
    assert "labapp reconstruct" in stdout
    with (
        open_source(out / "recording.avi") as other,
        open_source(written / "recording.avi") as first,
    ):
        assert (other.frame(0).image != first.frame(0).image).mean() > 0.3
    assert abs(column(out / "truth.csv", "width_mm")[0] / 6.66 - 1) > 1e-4


@pytest.mark.parametrize(("form", "bits", "kind"), [("tif", 12, "u2"), ("png", 16, "u2"),
                                                    ("png", 8, "u1")])  # fmt: skip
def test_frames_of_more_bits_are_written_to_stacks_and_folders(
    tmp_path: Path, form: str, bits: int, kind: str
) -> None:
    path = scenario(tmp_path, hot_pixels=f"2\nbits = {bits}", seed=f'1\nformat = "{form}"')
    simulate(read_scenario(path, 2), tmp_path / "out", workers=1)
    name = {"tif": "recording.tif", "png": "recording"}[form]
    with open_source(tmp_path / "out" / name) as source:
        image = source.frame(1).image
        assert len(source) == 2
    assert image.dtype == np.dtype(kind)
    assert 60 / 255 < image.max() / (2**bits - 1) <= 1


def test_only_a_moving_pool_changes_between_frames(tmp_path: Path) -> None:
    still = 'shape = "cap"\ndiameter_mm = 7.0\nheight_mm = 0.3'
    recording = read_scenario(scenario(tmp_path, still), 5).recording
    assert len(set(recording.pools)) == 1
    wave = "\n[[pool.wave]]\nmode = [0, 1]\namplitude_mm = 0.05\nfrequency_hz = 15.0\n"
    oscillating = read_scenario(scenario(tmp_path, still, wave), 5).recording
    heights = [pool.size.height_mm for pool in oscillating.pools]
    np.testing.assert_allclose(heights, [0.35, 0.3, 0.25, 0.3, 0.35], atol=1e-6)


def test_pool_wander_is_independent_of_the_number_of_frames(tmp_path: Path) -> None:
    path = scenario(tmp_path)
    few, many = (read_scenario(path, count).recording.pools for count in (4, 3000))
    widths, lengths, heights = np.array(
        [[p.footprint.width_mm / 6.66, p.footprint.tail_mm / 4.4, p.peak_mm / 0.29] for p in many]
    ).T
    for course in (widths, lengths, heights):
        assert course.std() == pytest.approx(0.02, rel=0.1)
        assert course.mean() == pytest.approx(1, abs=2e-3)
        assert np.abs(np.diff(course)).mean() < 0.3 * course.std()
    assert abs(np.corrcoef(widths, lengths)[0, 1]) < 0.3
    assert few == many[:4]


@pytest.mark.parametrize("kind", ["cap", "concave"])
def test_simulated_frame_is_measured_with_correct_labels(
    tmp_path: Path, labapp: Run, kind: str
) -> None:
    out, results = tmp_path / "out", tmp_path / "results"
    assert labapp("simulate", EXAMPLES / f"{kind}.toml", "--out", out, "--frames", 1)[0] == 0
    setup = out / "setup.toml"
    code, _, _ = labapp(
        "reconstruct", out / "recording.avi", "--setup", setup, "--out", results, "--surfaces",
        "none",
    )  # fmt: skip
    assert code == 0
    truth = {
        (row["ray_row"], row["ray_column"]): np.array([float(row["u_px"]), float(row["v_px"])])
        for row in rows(out / "dots_truth.csv")
        if row["visible"] == "1"
    }
    labelled = [row for row in rows(results / "dots.csv") if row["ray_row"]]
    assert len(labelled) > 0.9 * len(truth) > 50
    for row in labelled:
        apart = truth[row["ray_row"], row["ray_column"]] - [float(row["u_px"]), float(row["v_px"])]
        assert np.hypot(*apart) < 1.5
    size, measured = rows(out / "truth.csv")[0], rows(results / "measures.csv")[0]
    which = "depth_mm" if kind == "concave" else "height_mm"
    assert float(measured[which]) == pytest.approx(float(size[which]), rel=0.1)


@pytest.mark.parametrize("number", [15, 20])
def test_axisymmetric_waves_do_not_shift_labels_by_a_row(number: int) -> None:
    # In frame 15, all labels were a row off; in frame 20, five at the edge were wrong.
    scenario = read_scenario(EXAMPLES / "mode_02.toml")
    setup, frame = parse_setup(scenario.setup, "setup"), scenario.recording.frame(number)
    measurement = measure(frame.image, setup.bench, Settings())[0]
    assert measurement.status in ("ok", "no-match")
    if measurement.match is not None:
        assert measurement.dots is not None
        i, j = measurement.match.ray.T - 1
        off = measurement.dots.image_px[measurement.match.dot] - frame.dot_px[i, j]
        assert np.hypot(*off.T).max() < 1.5


# --- keys of a scenario -------------------------------------------------------------------------


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_example_can_be_simulated_and_has_visible_dots(path: Path) -> None:
    recording = read_scenario(path, frames=1).recording
    frame = recording.frame(0)
    assert frame.shown.sum() > 60
    size = frame.pool.size
    assert 0.2 < max(size.height_mm, -size.depth_mm) < 0.8


def test_every_key_of_a_scenario_is_used(tmp_path: Path) -> None:
    pool = """
    shape = "egg"
    width_mm = 6.0
    head_mm = 2.5
    tail_mm = 4.0
    height_mm = 0.25
    center_mm = [0.1, -0.2]
    fullness = 0.3
    wave = { mode = [2, 1], amplitude_mm = 0.01, frequency_hz = 9.0, kind = "travelling", \
turned_deg = 20.0, phase_deg = 30.0 }
    dent = [{ depth_mm = 0.05, radius_mm = 0.8 }, { depth_mm = 0.02, radius_mm = 0.5, \
offset_mm = [0.5, 0.4] }]
    low_rear = { drop_mm = 0.04 }
    """
    more = """
    [torch]
    tip_mm = [0.2, -1.0, 2.0]
    half_angle_deg = 20.0
    [camera]
    width_px = 500
    focal_px = 900.0
    k1 = -0.1
    """
    recording = read_scenario(scenario(tmp_path, pool, more), 2).recording
    first = recording.pools[0]
    assert first.footprint.head_mm == 2.5
    assert (first.peak_mm, first.fullness) == (0.25, 0.3)
    assert [type(term).__name__ for term in first.terms] == ["Dent", "Dent", "LowRear", "Wave"]
    assert first.terms[1].offset_mm == (0.5, 0.4)
    assert first.terms[3] == Wave((2, 1), 0.01, 9.0, 0.0, True, 20.0, 30.0)
    assert recording.pools[1].terms[3].time_s == pytest.approx(1 / 60)
    assert recording.torches == (ConeTorch((0.2, -1.0, 2.0), half_angle_deg=20.0),) * 2
    assert recording.view.width_px == 500
    assert recording.view.height_px == 640
    assert recording.view.lens.k1 == -0.1
    assert recording.look.hot_pixels == 2
    assert recording.exposure_s == 0.0005


def test_surface_file_is_relative_to_the_scenario(tmp_path: Path, labapp: Run) -> None:
    path = scenario(tmp_path, 'shape = "surface"\nfile = "my.csv"\nspacing_mm = 0.2')
    code, _, stderr = labapp("simulate", path, "--out", tmp_path / "out")
    assert code == 2
    assert f"{tmp_path / 'my.csv'}: file: No such file or directory" in stderr
    (tmp_path / "my.csv").write_bytes((EXAMPLES / "height_map.csv").read_bytes())
    assert read_scenario(path, 1).recording.pools[0].size.height_mm > 0.25


# --- errors -------------------------------------------------------------------------------------

CAP = 'shape = "cap"\ndiameter_mm = 7.0\nheight_mm = 0.3\n'


@pytest.mark.parametrize(
    ("pool", "more", "changed", "message"),
    [
        ("", "[lock]\nx = 1\n", {}, "lock: unknown key; expected look, the most"),
        ("", "[torches]\n", {}, "torches: unknown key; expected torch, the most"),
        ("", "[torch]\nradius_mm = 1.0\n", {}, "torch.tip_mm: missing; expected [x, y, z]"),
        ("", "", {"hot_pixels": "1.5"}, "look.hot_pixels: 1.5; expected a whole number from 0"),
        ("", "", {"frames": "0"}, "recording.frames: 0; expected a whole number from 1"),
        ("", "", {"frame_rate_hz": "nan"}, "recording.frame_rate_hz: nan; expected a number above"),
        ("", "", {"seed": '"x"'}, 'recording.seed: "x"; expected a whole number'),
        ("", "", {"exposure_ms": "20.0"}, "recording.exposure_ms: 20.0; expected at most 16.6667"),
        ("", "", {"missing": "1.0\nbits = 12"}, 'expected 8 in a video; recording.format = "tif"'),
        ("", "", {"missing": "0.0\nbits = 9"}, "look.bits: 9; expected 8, 12 or 16"),
        ("", "", {"missing": "0.0\ndot_floor_mm = 0.9"}, "expected a number up to look.dot_ceil"),
        ("", "[camera]\nk1 = -0.1\n", {}, "camera.focal_px: missing"),
        ("", "[camera]\nfocal_px = 300\nk1 = -2\n", {}, "folds the picture; expected smaller k1"),
        ("", "", {"distance_mm": "-1.0"}, "laser.distance_mm: -1.0; expected a number above 0"),
        ("", "", {"mode": "[0, 0]"}, "pool.wave[0].mode: [0, 0]; expected [m, n]"),
        ("", "", {"kind": '"running"'}, 'expected "standing" or "travelling"'),
        ("", "", {"shape": '"eg"'}, 'pool.shape: "eg"; expected "cap" or "ellipsoid" or "egg"'),
        ("width_mm = 6.0\n", "", {}, 'pool.shape: missing; expected "cap"'),
        (CAP + "head_mm = 3.0\n", "", {}, "pool.head_mm: unknown key; expected height_mm"),
        (CAP + "dent = 3\n", "", {}, "pool.dent: 3; expected a table, or a list of them"),
        (CAP + "dent = [3]\n", "", {}, "pool.dent[0]: 3; expected a table [[pool.dent]] with dep"),
        (CAP + "[pool.low_rear]\n", "", {}, "pool.low_rear.drop_mm: missing"),
        (CAP.replace("0.3", "3.6"), "", {}, "its sides would overhang"),
        ('shape = "surface"\nfile = "a.csv"\nwave = []', "", {}, "pool.wave: unknown key"),
        (CAP + '[[pool.wave]]\nmode = [0, 1]\namplitude_mm = 0.1\nfrequency_hz = 1\n'
         'kind = "travelling"', "", {}, "cannot travel"),
    ],
)  # fmt: skip
def test_wrong_key_is_named_with_the_allowed_values(
    tmp_path: Path, labapp: Run, pool: str, more: str, changed: dict[str, str], message: str
) -> None:
    path = scenario(tmp_path, pool, more, **changed)
    code, _, stderr = labapp("simulate", path, "--out", tmp_path / "out")
    assert code == 2
    assert message in stderr
    assert stderr.startswith(f"labapp: {path}: ")
    assert not (tmp_path / "out").exists()


def test_all_problems_are_reported_together(tmp_path: Path, labapp: Run) -> None:
    path = scenario(tmp_path, CAP + "widht_mm = 3.0\n", "[lens]\n", distance_mm="0", seed="-1")
    _, _, stderr = labapp("simulate", path, "--out", tmp_path / "out")
    problems = [line.split(": ")[-2:][0] for line in stderr.splitlines()]
    assert len(problems) == 4, stderr
    for key in ("laser.distance_mm", "lens", "pool.widht_mm", "recording.seed"):
        assert key in stderr


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"[pool", "syntax"),
        (b"\xff\xfe", "encoding: not UTF-8"),
        (b"", "pool: missing; expected a table [pool] with shape"),
        (b"pool = 3\nrecording = 4\nimage_calibration = 5\n", "pool: 3; expected a table [pool]"),
    ],
)
def test_invalid_scenario_file_is_rejected(
    tmp_path: Path, labapp: Run, content: bytes, message: str
) -> None:
    path = tmp_path / "scenario.toml"
    path.write_bytes(content)
    code, _, stderr = labapp("simulate", path, "--out", tmp_path / "out")
    assert code == 2
    assert message in stderr


def test_unknown_name_is_rejected_with_the_available_names(labapp: Run, tmp_path: Path) -> None:
    names = {path.stem for path in EXAMPLES.glob("*.toml")}
    code, _, stderr = labapp("simulate", "eg", "--out", tmp_path / "out")
    assert code == 2
    assert "egg (the most similar name)" in stderr
    page = (EXAMPLES.parents[1] / "docs" / "simulation.md").read_text("utf-8")
    help_text = " ".join(labapp("simulate", "--help")[1].replace("│", " ").split())
    for name in names:
        assert name in stderr
        assert f"`{name}`" in page
        assert name in help_text


def test_missing_scenario_and_homography_are_rejected(tmp_path: Path, labapp: Run) -> None:
    code, _, stderr = labapp("simulate", tmp_path / "no.toml", "--out", tmp_path / "out")
    assert code == 2
    assert "no.toml: file: No such file or directory" in stderr
    text = SCENARIO[: SCENARIO.index("origin_px")] + SCENARIO[SCENARIO.index("[look]") :]
    matrix = "homography = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]\n"
    path = tmp_path / "homography.toml"
    path.write_text(text.replace("[image_calibration]\n", f"[image_calibration]\n{matrix}"))
    code, _, stderr = labapp("simulate", path, "--out", tmp_path / "out")
    assert code == 2
    assert "image_calibration: a homography; expected the three points" in stderr


def test_only_an_earlier_simulation_is_replaced(tmp_path: Path, labapp: Run) -> None:
    path, out = scenario(tmp_path), tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    code, _, stderr = labapp("simulate", path, "--out", out, "--frames", 1)
    assert code == 2
    assert "holds mine.txt; expected a new folder, an empty one or that of a former" in stderr
    assert [file.name for file in out.iterdir()] == ["mine.txt"]
    (out / "mine.txt").unlink()
    for _ in range(2):
        assert labapp("simulate", path, "--out", out, "--frames", 1)[0] == 0
    setup = out / "setup.toml"
    simulated = setup.read_text("utf-8")
    setup.write_text(f"{simulated}# calibrated anew\n", "utf-8")
    code, _, stderr = labapp("simulate", path, "--out", out, "--frames", 1)
    assert code == 2
    assert "setup.toml" in stderr
    assert setup.read_text("utf-8") != simulated
    (out / "scenario.toml").unlink()
    code, _, stderr = labapp("simulate", path, "--out", out, "--frames", 1)
    assert code == 2
    assert "holds no scenario.toml" in stderr
    code, _, stderr = labapp("simulate", path, "--out", path, "--frames", 1)
    assert code == 2
    assert "is a file" in stderr


def test_impossible_output_folder_is_reported(tmp_path: Path, labapp: Run) -> None:
    path = scenario(tmp_path)
    code, _, stderr = labapp("simulate", path, "--out", path / "out", "--frames", 1)
    assert code == 2
    assert f"{path / 'out'}: folder: " in stderr
    assert "expected a folder that can be written" in stderr


@pytest.mark.parametrize(("signal_number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_stopped_simulation_leaves_no_files(
    tmp_path: Path, signal_number: signal.Signals, code: int
) -> None:
    path, out = scenario(tmp_path, frames="500"), tmp_path / "results" / "out"
    process = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTIBLE, "simulate", path, "--out", out],
        stderr=subprocess.PIPE,
        env={**os.environ, "XDG_STATE_HOME": str(tmp_path / "state")},
        text=True,
    )
    parts = "results/.out.*/out/recording.avi"
    wait_until(lambda: process.poll() is not None or any(tmp_path.glob(parts)))
    assert process.poll() is None
    process.send_signal(signal_number)
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code
    assert "nothing is written" in stderr
    assert "Traceback" not in stderr
    assert list((tmp_path / "results").iterdir()) == []
