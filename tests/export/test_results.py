from __future__ import annotations

import csv
import io
import json
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.pipeline import Measurement, Settings, reconstruct
from labapp.core.surface.measures import measure_surface
from labapp.errors import InputError
from labapp.export import results
from labapp.export.frame_result import FrameResult
from labapp.export.results import ResultsWriter
from labapp.export.tables import TABLES
from labapp.simulation.forward import exact_match, trace
from labapp.simulation.pools import egg
from labapp.text import HEIGHT_SIGMA_OF, SIGMA_OF
from tests.export.conftest import dots

Writer = Callable[[Path], ResultsWriter]
CONVENTION = {
    "measures.csv": "frame,time_s,status,scheme,correspondence,dots,rows,are_mm,mre_mm,width_mm,"
    "length_mm,height_mm,depth_mm,area_mm2,volume_mm3,center_x_mm,center_y_mm,peak_x_mm,peak_y_mm",
    "dots.csv": "frame,u_px,v_px,plane_x_mm,plane_z_mm,reflected_row,reflected_column,ray_row,"
    "ray_column,blocked,source",
    "points.csv": "frame,ray_row,ray_column,x_mm,y_mm,z_mm,residual_mm",
    "boundary.csv": "frame,theta_deg,x_mm,y_mm,z_mm",
}


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "deep" / "out"


@pytest.fixture
def written(out: Path, writer: Writer, measured: Measurement, unmeasured: Measurement) -> Path:
    with writer(out) as files:
        files.write(FrameResult(0, 0.0, measured))
        files.write(FrameResult(7, None, unmeasured))
    return out


@pytest.mark.parametrize("name", CONVENTION)
def test_columns_have_the_specified_order(written: Path, name: str) -> None:
    header = (written / name).read_text(encoding="utf-8").splitlines()[0]
    assert (header + ",").startswith(CONVENTION[name] + ",")


def test_every_frame_has_a_row_of_measures(written: Path) -> None:
    ok, other = table(written / "measures.csv")
    assert (ok["frame"], ok["time_s"]) == ("0", "0.000000")
    assert (ok["status"], ok["scheme"], ok["correspondence"]) == ("ok", "fit", "I/I")
    assert (ok["dots"], ok["rows"]) == ("3", "2")
    assert (ok["width_mm"], ok["area_mm2"], ok["width_sigma_mm"]) == ("1.250000",) * 3
    assert ok["depth_mm"] == "0.000000"
    assert ok["sigma_of"] == SIGMA_OF
    assert ok["volume_sigma_mm3"] == ""
    assert {key: value for key, value in other.items() if value} == {
        "frame": "7",
        "status": "ambiguous-rows",
        "scheme": "fit",
        "dots": "1",
        "reason": 'two references fit, "a" and "b"',
    }


def test_every_dot_has_a_row(written: Path) -> None:
    first, doubtful, last, other = table(written / "dots.csv")
    assert first == {
        "frame": "0",
        "u_px": "10.0000",
        "v_px": "20.0000",
        "plane_x_mm": "5.000000",
        "plane_z_mm": "40.000000",
        "reflected_row": "1",
        "reflected_column": "4",
        "ray_row": "10",
        "ray_column": "11",
        "blocked": "0",
        "source": "auto",
    }
    empty = {"reflected_row", "reflected_column", "ray_row", "ray_column", "blocked"}
    assert {key for key, value in doubtful.items() if not value} == empty
    assert (last["ray_row"], last["ray_column"], last["blocked"]) == ("10", "9", "1")
    assert other["frame"] == "7"


def test_points_have_residual_and_sigma(written: Path) -> None:
    first, second = table(written / "points.csv")
    assert (first["ray_row"], first["ray_column"], first["z_mm"]) == ("10", "9", "0.300000")
    assert (first["residual_mm"], first["sigma_mm"]) == ("0.500000", "0.002000")
    assert (second["residual_mm"], second["sigma_mm"]) == ("0.010000", "")


def test_sigma_of_is_empty_without_any_sigma(
    out: Path, writer: Writer, unmeasured: Measurement
) -> None:
    with writer(out) as files:
        files.write(FrameResult(7, None, unmeasured))
    assert json.loads((out / "run.json").read_text("utf-8"))["sigma_of"] == ""


def test_content_of_sigma_is_documented_with_the_tables(written: Path) -> None:
    assert json.loads((written / "run.json").read_text("utf-8"))["sigma_of"] == SIGMA_OF
    sigmas = [c for name in TABLES for c in TABLES[name] if "_sigma_" in f"_{c.name}_" and c.digits]
    assert len(sigmas) == 10 + 27
    for column in sigmas:  # a total states its content, and a part states its total
        expected = HEIGHT_SIGMA_OF if column.name == "sigma_mm" else SIGMA_OF
        assert ("part of" if column.is_part else expected) in column.description


@pytest.mark.parametrize("scheme", ["fit", "ers", "irs"])
def test_are_agrees_with_the_points(out: Path, writer: Writer, scheme: str) -> None:
    rig = Rig(
        Laser(31.14, 31.48),
        DotPattern(),
        Electrode(1e9),
        ImagingPlane.vertical(50.0, 1e4, -1e4, 2e4, 2e4),
    )
    rng = np.random.default_rng(5)
    reflections = trace(egg(6.6, 3.0, 4.0, 0.35), rig)
    match = exact_match(reflections, sigma_mm=0.05, rng=rng)
    match = replace(match, dot=np.zeros(len(match.ray), int))
    reconstruction = reconstruct(match, rig, Settings(scheme=scheme))
    size = measure_surface(reconstruction, match, rig)
    with writer(out) as files:
        measurement = Measurement("ok", "", scheme, dots(1), None, match, reconstruction, size)
        files.write(FrameResult(0, 0.0, measurement))
    measures = table(out / "measures.csv")[0]
    points = [row for row in table(out / "points.csv") if row["residual_mm"]]
    names = ("residual_mm", "residual_x_mm", "residual_z_mm", "error_x_mm", "error_y_mm")
    column = {name: np.array([float(row[name]) for row in points]) for name in names}
    on_plane = np.hypot(column["residual_x_mm"], column["residual_z_mm"])
    np.testing.assert_allclose(on_plane, column["residual_mm"], atol=2e-6)
    error = np.hypot(column["error_x_mm"], column["error_y_mm"])
    assert error.mean() == pytest.approx(float(measures["are_mm"]), abs=2e-6)
    assert error.max() == pytest.approx(float(measures["mre_mm"]), abs=2e-6)
    # Errors on the work piece are smaller than on the imaging plane, with the same sign.
    assert error.mean() < 0.5 * on_plane.mean()
    assert (column["residual_x_mm"] * column["error_x_mm"] >= 0).all()
    assert {np.sign(value) for value in column["error_y_mm"]} >= {-1.0, 1.0}
    assert bool(measures["own_are_mm"]) == (scheme != "fit")
    if scheme == "fit":  # captured minus computed: the noise added to a dot
        noise = match.plane_mm - exact_match(reflections).plane_mm
        assert np.corrcoef(column["residual_x_mm"], noise[:, 0])[0, 1] > 0.5
        assert np.corrcoef(column["residual_z_mm"], noise[:, 1])[0, 1] > 0.5


def test_boundary_is_written(written: Path) -> None:
    rows = table(written / "boundary.csv")
    assert len(rows) == 72
    radius = [np.hypot(float(row["x_mm"]), float(row["y_mm"])) for row in rows]
    np.testing.assert_allclose(radius, 3.0, atol=1e-5)


def test_nodes_lie_on_the_surface_and_fill_the_boundary(written: Path) -> None:
    assert not (written / "surface_000007.csv").exists()
    rows = table(written / "surface_000000.csv")
    x, y, z = (np.array([float(row[f"{axis}_mm"]) for row in rows]) for axis in "xyz")
    np.testing.assert_allclose(z, 0.3 * (1 - (x**2 + y**2) / 9), atol=2e-6)
    assert len(rows) * results.SPACING_MM**2 == pytest.approx(np.pi * 9, rel=0.02)


def test_mesh_is_the_surface_with_normals_up(written: Path) -> None:
    content = (written / "surface_000000.stl").read_bytes()
    count = int.from_bytes(content[80:84], "little")
    assert len(content) == 84 + 50 * count
    kind = np.dtype([("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("attribute", "<u2")])
    mesh = np.frombuffer(content[84:], kind)
    corner = mesh["corner"].astype(float)
    edges = corner[:, 1:] - corner[:, :1]
    doubled = np.cross(edges[:, 0], edges[:, 1])
    assert (mesh["normal"][:, 2] > 0.9).all()
    assert np.abs(doubled[:, 2]).sum() / 2 == pytest.approx(np.pi * 9, rel=0.01)
    np.testing.assert_allclose(
        doubled / np.linalg.norm(doubled, axis=1, keepdims=True), mesh["normal"], atol=1e-2
    )
    # Every edge belongs to two triangles, except for one closed loop: the boundary.
    vertices, index = np.unique(corner.reshape(-1, 3).round(5), axis=0, return_inverse=True)
    sides = np.sort(index.reshape(-1, 3)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    pairs, uses = np.unique(sides, axis=0, return_counts=True)
    assert set(uses) == {1, 2}
    rim = pairs[uses == 1]
    assert (np.unique(rim, return_counts=True)[1] == 2).all()
    np.testing.assert_allclose(vertices[np.unique(rim), 2], 0, atol=1e-6)


def test_run_json_contains_the_provenance(written: Path) -> None:
    run = json.loads((written / "run.json").read_text())
    assert run["program"] == "labapp"
    assert run["source"] == {"path": "v.avi"}
    assert (run["state"], run["frames_done"]) == ("finished", 2)


def test_surfaces_are_optional(out: Path, measured: Measurement, calibration: object) -> None:
    with ResultsWriter(out, calibration, {}, surfaces=False) as files:
        files.write(FrameResult(0, 0.0, measured))
    assert not list(out.glob("surface_*"))
    assert table(out / "measures.csv")[0]["status"] == "ok"


def test_only_files_of_a_former_run_are_replaced(
    written: Path, writer: Writer, unmeasured: Measurement
) -> None:
    (written / "notes.csv").write_text("mine")
    with writer(written) as files:
        files.write(FrameResult(3, None, unmeasured))
    assert sorted(path.name for path in written.iterdir()) == [
        "boundary.csv",
        "dots.csv",
        "measures.csv",
        "notes.csv",
        "points.csv",
        "run.json",
    ]
    assert [row["frame"] for row in table(written / "measures.csv")] == ["3"]


def test_run_that_fails_before_its_first_frame_leaves_the_former_one(
    written: Path, writer: Writer
) -> None:
    before = {path.name: path.read_bytes() for path in written.iterdir()}
    for error in (InputError("frame 0", "size", "1×1 px", "480×640 px"), KeyboardInterrupt()):
        with pytest.raises(type(error)), writer(written):
            raise error
        assert {path.name: path.read_bytes() for path in written.iterdir()} == before


def test_two_runs_do_not_mix_in_a_folder(out: Path, writer: Writer, measured: Measurement) -> None:
    with writer(out) as files:
        files.write(FrameResult(0, 0.0, measured))
        before = {path.name: path.read_bytes() for path in out.iterdir()}
        with pytest.raises(InputError, match="another program"):
            writer(out)
        assert {path.name: path.read_bytes() for path in out.iterdir()} == before
        files.write(FrameResult(1, 0.1, measured))
    assert len(table(out / "measures.csv")) == 2
    with writer(out):
        pass
    assert table(out / "measures.csv") == []


@pytest.mark.parametrize("run", [None, "{}", "not json"])
def test_other_files_are_not_replaced(out: Path, writer: Writer, run: str | None) -> None:
    out.mkdir(parents=True)
    (out / "dots.csv").write_text("mine")
    if run is not None:
        (out / "run.json").write_text(run)
    with pytest.raises(InputError, match=r"holds dots\.csv and no run\.json"):
        writer(out)
    assert (out / "dots.csv").read_text() == "mine"


@pytest.mark.parametrize(
    "start", ["=", "+", "-", "@", "\t", "\r", "\n", "'=", "''-", "＝", "＋", "－", "＠"]
)
def test_text_is_quoted_against_formulas(
    out: Path, writer: Writer, unmeasured: Measurement, start: str
) -> None:
    """Spreadsheets run text with such a start; a reason may contain the name of a recording."""
    reason = f"{start}HYPERLINK(A1)"
    with writer(out) as files:
        files.write(FrameResult(0, -1.5, replace(unmeasured, reason=reason)))
        files.write(FrameResult(1, 0.5, replace(unmeasured, reason="'quoted' - said")))
    first, second = table(out / "measures.csv")
    assert first["reason"] == f"'{reason}"
    assert (first["time_s"], second["reason"]) == ("-1.500000", "'quoted' - said")


def test_link_is_not_followed(out: Path, writer: Writer) -> None:
    out.mkdir(parents=True)
    (out.parent / "mine.json").write_text("mine")
    (out / "run.json").symlink_to("../mine.json")
    with pytest.raises(InputError, match=r"run\.json: is a link"):
        writer(out)
    (out / "run.json").unlink()
    (out / ".run.json.part").symlink_to("../mine.json")
    with writer(out):
        pass
    assert (out.parent / "mine.json").read_text() == "mine"


def test_impossible_folder_is_rejected(tmp_path: Path, writer: Writer) -> None:
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(InputError, match="expected a writable folder with enough disk space"):
            writer(folder)


class Stopped(BaseException):
    pass


FAILURES = [OSError(28, "No space left on device"), KeyboardInterrupt(), Stopped()]


@pytest.mark.parametrize("failure", FAILURES, ids=lambda failure: type(failure).__name__)
@pytest.mark.parametrize("at", range(6), ids=lambda at: f"write {at}")
def test_failed_frame_leaves_no_rows(
    out: Path, writer: Writer, measured: Measurement, failure: BaseException, at: int
) -> None:
    """Each of the six files of a frame fails in turn, half written."""
    write, append = results.write_atomically, results.write_all
    calls = iter(range(100))

    def fail_whole(path: Path, content: bytes) -> None:
        write(path, content)
        if next(calls) == at:
            raise failure

    def fail_append(file: io.FileIO, content: bytes) -> None:
        if next(calls) == at:
            append(file, content[: len(content) // 2])
            raise failure
        append(file, content)

    expected = InputError if isinstance(failure, OSError) else type(failure)
    with pytest.raises(expected), writer(out) as files:  # noqa: PT012 - the frame before counts
        files.write(FrameResult(0, 0.0, measured))
        before = {path: path.read_bytes() for path in out.iterdir()}
        with (
            mock.patch.object(results, "write_atomically", fail_whole),
            mock.patch.object(results, "write_all", fail_append),
        ):
            files.write(FrameResult(1, 0.1, measured))
    after = {path: path.read_bytes() for path in out.iterdir()}
    run = json.loads(after.pop(out / "run.json"))
    del before[out / "run.json"]
    assert after == before
    assert run["frames_done"] == 1
    assert run["state"] == ("interrupted" if expected is KeyboardInterrupt else "failed")


def test_run_whose_tables_cannot_be_opened_has_failed(tmp_path: Path, writer: Writer) -> None:
    with (
        mock.patch.object(results, "write_all", side_effect=OSError(28, "No space left")),
        pytest.raises(InputError),
        writer(tmp_path),
    ):
        pass
    run = json.loads((tmp_path / "run.json").read_text())
    assert (run["state"], run["frames_done"]) == ("failed", 0)
    assert run["ended"] is not None


FULL_DISK = """
    import resource, sys
    from labapp.core.geometry.coordinates import ImageCalibration
    from labapp.core.pipeline import Measurement
    from labapp.core.images.dots import Dots
    from labapp.errors import InputError
    from labapp.export.frame_result import FrameResult
    from labapp.export.results import ResultsWriter
    from pathlib import Path
    import numpy as np

    dots = Dots(*np.ones((7, 40)))
    found = Measurement(status="no-reference", reason="", scheme="fit", dots=dots, lattice=None,
                        match=None, reconstruction=None, measures=None)
    with ResultsWriter(Path(sys.argv[1]), ImageCalibration(np.eye(3)), {}) as files:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))
        try:
            for frame in range(1000):
                files.write(FrameResult(frame, None, found))
        except InputError as error:
            print(error)
"""


def test_full_disk_stops_the_run_after_a_complete_frame(out: Path) -> None:
    """The operating system writes a part of the last row and refuses the rest."""
    process = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(FULL_DISK), str(out)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    measures, dots = table(out / "measures.csv"), table(out / "dots.csv")
    assert len(measures) > 5
    assert f"the {len(measures)} previous frames are complete" in process.stdout
    assert len(dots) == 40 * len(measures)
    assert all(None not in row.values() for row in dots)
    assert (out / "dots.csv").read_text().endswith("auto\n")
