from __future__ import annotations

import csv
import hashlib
import json
import os
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from unittest import mock

import cv2
import h5py
import numpy as np
import pytest
import trimesh

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.pipeline import Measurement
from labapp.core.rows.correction import Correction
from labapp.errors import InputError
from labapp.export import folder as module
from labapp.export.folder import ExportChoice, ExportedFile, export, verify_export
from labapp.export.frame_result import FrameResult
from labapp.export.results import ResultsWriter
from labapp.text import SIGMA_OF

ALL = ExportChoice(
    surfaces=frozenset({"csv", "stl", "stl-ascii", "ply", "vtp"}),
    solid=True,
    hdf5=True,
    spacing_mm=0.5,
)
ABOUT = {"source": {"path": "v.avi"}, "setup": {"path": "s.toml", "toml": "[laser]\n"}}
Run = Callable[..., tuple[ExportedFile, ...]]


@pytest.fixture
def frames(measured: Measurement, unmeasured: Measurement) -> list[FrameResult]:
    values = [(3, 0.5, measured), (4, None, unmeasured), (12, 0.7, measured)]
    return [FrameResult(*value) for value in values]


@pytest.fixture
def run(frames: list[FrameResult], calibration: ImageCalibration) -> Run:
    """Export three frames, the second without a surface."""
    return lambda folder, choice=ALL, measured=frames, **others: export(
        folder, measured, calibration, ABOUT, choice, **others
    )


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def alone(folder: Path) -> bool:
    return [path.name for path in folder.parent.iterdir()] == [folder.name]


def test_only_the_chosen_files_are_written(run: Run, tmp_path: Path) -> None:
    written = run(tmp_path / "a" / "out")
    expected = {f"{name}.csv" for name in ("measures", "dots", "points", "boundary")}
    expected.add("results.h5")
    for frame in ("000003", "000012"):
        expected.add(f"surface_{frame}.csv")
        for stem in ("surface", "solid"):
            expected |= {f"{stem}_{frame}{end}" for end in (".stl", "_ascii.stl", ".ply", ".vtp")}
    files = contents(tmp_path / "a" / "out")
    assert files.keys() == expected | {"manifest.json"}
    assert [file.name for file in written] == sorted(expected)
    assert alone(tmp_path / "a" / "out")
    assert trimesh.load_mesh(tmp_path / "a" / "out" / "solid_000012.ply").is_watertight
    assert not trimesh.load_mesh(tmp_path / "a" / "out" / "surface_000012.ply").is_watertight


def test_manifest_lists_every_file(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "out"
    written = run(out)
    manifest = json.loads((out / "manifest.json").read_text(encoding="utf-8"))
    assert (manifest["program"], manifest["frames"]) == ("labapp", 3)
    assert manifest["provenance"] == ABOUT
    assert manifest["version"]
    assert manifest["created"]
    assert manifest["sigma_of"] == SIGMA_OF
    assert manifest["files"] == [vars(file) for file in written]
    files = contents(out)
    for file in written:
        assert file.size == len(files[file.name])
        assert file.sha256 == hashlib.sha256(files[file.name]).hexdigest()
        if file.name.endswith(".csv"):
            text = files[file.name].decode().splitlines()
            assert file.rows == len(list(csv.DictReader(text)))
        else:
            assert file.rows is None
    assert verify_export(out) == []


def test_tables_and_surfaces_equal_those_of_a_run(
    run: Run,
    tmp_path: Path,
    frames: list[FrameResult],
    calibration: ImageCalibration,
) -> None:
    with ResultsWriter(tmp_path / "run", calibration, {}) as writer:
        for result in frames:
            writer.write(result)
    run(tmp_path / "out", ExportChoice())
    expected, exported = contents(tmp_path / "run"), contents(tmp_path / "out")
    del expected["run.json"], exported["manifest.json"]
    assert exported == expected


def test_hdf5_contains_the_content_of_the_tables(run: Run, tmp_path: Path) -> None:
    run(tmp_path / "out")
    with h5py.File(tmp_path / "out" / "results.h5") as file:
        assert list(file["measures/frame"]) == [3, 4, 12]
        assert set(file["frames"]) == {"000003", "000004", "000012"}
        assert file.attrs["setup"] == "[laser]\n"
        assert json.loads(file.attrs["source"]) == {"path": "v.avi"}
        assert file.attrs["program"] == "labapp"
        assert file.attrs["sigma_of"] == SIGMA_OF


def test_unselected_files_are_not_written(run: Run, tmp_path: Path) -> None:
    choice = ExportChoice(tables=frozenset({"points"}), surfaces=frozenset())
    run(tmp_path / "out", choice)
    assert contents(tmp_path / "out").keys() == {"points.csv", "manifest.json"}
    run(tmp_path / "out", replace(choice, tables=frozenset()))
    assert contents(tmp_path / "out").keys() == {"manifest.json"}


def test_equal_results_give_equal_files(run: Run, tmp_path: Path) -> None:
    with mock.patch.object(module, "now", return_value="2026-01-01T00:00:00+00:00"):
        run(tmp_path / "a")
        written = int(time.time())
        while int(time.time()) == written:  # HDF5 may store the second in which it was written
            time.sleep(0.05)
        run(tmp_path / "b")
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_corrected_dots_are_marked_as_manual(
    run: Run, tmp_path: Path, measured: Measurement
) -> None:
    assert measured.dots is not None
    assert measured.lattice is not None
    correction = Correction(measured.dots, measured.lattice, np.array([False, True, False]))
    corrected = replace(measured, correction=correction)
    run(tmp_path / "out", measured=[FrameResult(0, None, corrected)])
    with (tmp_path / "out" / "dots.csv").open(newline="") as file:
        assert [row["source"] for row in csv.DictReader(file)] == ["auto", "manual", "auto"]
    with h5py.File(tmp_path / "out" / "results.h5") as file:
        assert list(file["frames/000000/dots"]["source"]) == [b"auto", b"manual", b"auto"]


def test_pictures_are_drawn(run: Run, tmp_path: Path, unmeasured: Measurement) -> None:
    drawn: list[int] = []

    def image_of(frame: int) -> np.ndarray:
        drawn.append(frame)
        return np.full((40, 60), 20, np.uint8)

    choice = ExportChoice(
        tables=frozenset(), surfaces=frozenset(), pictures=frozenset({"frames", "trends"})
    )
    run(tmp_path / "out", choice, image_of=image_of)
    assert drawn == [3, 4, 12]
    names = {f"frame_{frame:06d}.png" for frame in drawn} | {"trends.png", "manifest.json"}
    assert contents(tmp_path / "out").keys() == names
    assert cv2.imread(str(tmp_path / "out" / "frame_000003.png")).shape == (120, 180, 3)
    unreadable = replace(unmeasured, status="unreadable", dots=None)
    run(tmp_path / "out", choice, measured=[FrameResult(5, None, unreadable)], image_of=image_of)
    assert contents(tmp_path / "out").keys() == {"manifest.json"}


def test_trends_show_the_larger_of_height_and_depth_with_sigma(
    run: Run, tmp_path: Path, measured: Measurement
) -> None:
    drawn: list[dict[str, tuple[np.ndarray, np.ndarray]]] = []
    choice = ExportChoice(frozenset(), frozenset(), pictures=frozenset({"trends"}))
    assert measured.measures is not None
    hollow = replace(measured.measures, height_mm=0.0, depth_mm=-0.6, depth_sigma_mm=0.03)
    with mock.patch.object(module, "write_trend_picture", lambda *given: drawn.append(given[3])):
        run(tmp_path / "out", choice)
        run(tmp_path / "out", choice, [FrameResult(0, 0.0, replace(measured, measures=hollow))])
    assert [list(series) for series in drawn] == [
        ["width", "length", "height"],
        ["width", "length", "depth"],
    ]
    (value,), (sigma,) = drawn[1]["depth"]
    assert (value, sigma) == (-0.6, 0.03)


def test_surfaces_are_drawn_in_one_process(run: Run, tmp_path: Path) -> None:
    choice = ExportChoice(frozenset(), frozenset(), pictures=frozenset({"surfaces"}))
    processes = []

    def draw(path: Path, _: object, process: object) -> None:
        path.write_bytes(b"PNG")
        processes.append(process)

    with mock.patch.object(module, "write_surface_picture", draw):
        run(tmp_path / "out", choice)
    assert len(processes) == 2
    assert len(set(processes)) == 1
    names = {"surface_000003.png", "surface_000012.png", "manifest.json"}
    assert contents(tmp_path / "out").keys() == names


@pytest.mark.parametrize(
    ("failure", "message"),
    [
        (ModuleNotFoundError("no", name="pyvista"), r"expected pyvista, which is not installed"),
        (BrokenProcessPool("ended"), "a system on which OpenGL can be used"),
    ],
)
def test_failed_drawing_is_reported(
    run: Run, tmp_path: Path, failure: Exception, message: str
) -> None:
    choice = ExportChoice(pictures=frozenset({"surfaces"}))
    with (
        mock.patch.object(module, "write_surface_picture", side_effect=failure),
        pytest.raises(InputError, match=message),
    ):
        run(tmp_path / "out", choice)
    assert list(tmp_path.iterdir()) == []


def test_pictures_of_frames_need_the_recording(run: Run, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a recording that can be read"):
        run(tmp_path / "out", ExportChoice(pictures=frozenset({"frames"})))


def test_extra_files_are_included(run: Run, tmp_path: Path) -> None:
    run(tmp_path / "out", extras={"report.pdf": lambda: b"%PDF"})
    assert (tmp_path / "out" / "report.pdf").read_bytes() == b"%PDF"
    assert verify_export(tmp_path / "out") == []


@pytest.mark.parametrize("place", ["/proc/nope", "file/out", "mine"])
def test_unwritable_folder_is_rejected_before_any_work(
    run: Run, tmp_path: Path, place: str
) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    prepared, measured = mock.Mock(return_value=b""), mock.MagicMock()
    with pytest.raises(InputError):
        run(tmp_path / place, extras={"report.pdf": prepared}, measured=measured)
    prepared.assert_not_called()
    measured.__iter__.assert_not_called()


@pytest.mark.parametrize("name", ["../a.pdf", "/a.pdf", "", ".", "a/b", ".part", "measures.csv"])
def test_wrong_names_of_extra_files_are_rejected(run: Run, tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError):
        run(tmp_path / "out", extras={name: bytes})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "choice",
    [
        {"tables": frozenset({"measure"})},
        {"surfaces": frozenset({"obj"})},
        {"pictures": frozenset({"movie"})},
        {"view": "below"},
        {"size_px": (1281, 720)},
        {"size_px": (1280, 10_000)},
        {"film_rate_hz": 0.0},
        {"film_rate_hz": float("nan")},
        {"surfaces": frozenset({"csv"}), "solid": True},
        {"spacing_mm": 0.01},
        {"spacing_mm": float("nan")},
    ],
)
def test_impossible_choice_is_rejected(choice: dict[str, object]) -> None:
    with pytest.raises(InputError, match=r"^export: "):
        ExportChoice(**choice)


def test_progress_counts_finished_frames(run: Run, tmp_path: Path) -> None:
    done: list[int] = []
    run(tmp_path / "out", progress=done.append)
    assert done == [1, 2, 3]


# --- existing files -----------------------------------------------------------------------------


def test_earlier_export_and_empty_folder_are_replaced(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    run(out)
    (out / "points.csv").unlink()  # a missing file cannot be lost
    run(out, ExportChoice(surfaces=frozenset()))
    assert "surface_000003.stl" not in contents(out)
    assert verify_export(out) == []
    assert alone(out)


def test_link_to_a_folder_is_preserved(run: Run, tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "out").symlink_to("real")
    run(tmp_path / "out")
    assert (tmp_path / "out").is_symlink()
    assert verify_export(tmp_path / "real") == []


def mine(out: Path) -> None:
    (out / "notes.txt").write_text("mine")


def changed(out: Path) -> None:
    with (out / "measures.csv").open("a") as file:
        file.write("mine")


def same_size(out: Path) -> None:
    content = bytearray((out / "measures.csv").read_bytes())
    content[-2] ^= 1
    (out / "measures.csv").write_bytes(content)


def below(out: Path) -> None:
    (out / "mine").mkdir()


def linked(out: Path) -> None:
    (out / "dots.csv").rename(out.parent / "elsewhere.csv")
    (out / "dots.csv").symlink_to("../elsewhere.csv")


def no_manifest(out: Path) -> None:
    (out / "manifest.json").unlink()


def other_manifest(out: Path) -> None:
    (out / "manifest.json").write_text('{"program": "other", "files": []}')


def huge(measured: Measurement, change: str) -> Measurement:
    """A measurement of an untrusted session whose surface would be too large."""
    reconstruction = measured.reconstruction
    assert reconstruction is not None
    boundary, count = reconstruction.boundary, len(reconstruction.boundary.points_mm)
    changed = {
        "wide": replace(boundary, points_mm=boundary.points_mm * 1e6),
        "far": replace(boundary, center_mm=boundary.center_mm + 1e9),
        "fine": replace(
            boundary,
            theta_deg=np.resize(boundary.theta_deg, 10**6),
            points_mm=boundary.points_mm[np.arange(10**6) % count],
        ),
        "unknown": replace(boundary, points_mm=boundary.points_mm * np.nan),
    }[change]
    return replace(measured, reconstruction=replace(reconstruction, boundary=changed))


@pytest.mark.parametrize("change", ["wide", "far", "fine", "unknown"])
def test_too_large_surface_is_rejected(
    run: Run, tmp_path: Path, measured: Measurement, change: str
) -> None:
    frames = [FrameResult(0, None, huge(measured, change))]
    for choice in (
        ExportChoice(frozenset(), frozenset({"csv"})),
        ExportChoice(frozenset(), frozenset({"stl"})),
        ExportChoice(frozenset(), frozenset(), hdf5=True),
    ):
        with pytest.raises(InputError, match="a surface of at most"):
            run(tmp_path / "out", choice, frames)
    assert list(tmp_path.iterdir()) == []


CHANGES = {
    mine: "notes.txt is not in the manifest",
    changed: "measures.csv has ",
    same_size: "measures.csv was changed",
    below: "mine is not in the manifest",
    linked: "dots.csv is not a file",
    no_manifest: "and no manifest.json",
    other_manifest: "manifest.json: is not one of labapp",
}


def test_links_in_place_of_temporary_folders_are_not_followed(run: Run, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    mine(tmp_path / "mine")
    for name in (".out.part", ".out.old", ".out.0123456789abcdef.part", ".out.lock"):
        (tmp_path / name).symlink_to("mine")
    for _ in range(2):
        run(tmp_path / "out")
    assert contents(tmp_path / "mine") == {"notes.txt": b"mine"}


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_other_files_are_never_deleted(
    run: Run, tmp_path: Path, change: Callable[[Path], None]
) -> None:
    out = tmp_path / "place" / "out"
    run(out)
    change(out)
    before = {path: path.is_file() and path.read_bytes() for path in sorted(tmp_path.rglob("*"))}
    with pytest.raises(InputError, match=CHANGES[change]):
        run(out)
    after = {path: path.is_file() and path.read_bytes() for path in sorted(tmp_path.rglob("*"))}
    assert after == before


def test_file_added_during_an_export_is_preserved(
    run: Run, tmp_path: Path, frames: list[FrameResult]
) -> None:
    out = tmp_path / "out"
    run(out)

    def add_file_and_measure() -> Iterator[tuple[int, float | None, Measurement]]:
        mine(out)
        yield from frames

    with pytest.raises(InputError, match=r"notes\.txt is not in the manifest"):
        run(out, measured=add_file_and_measure())
    assert (out / "notes.txt").read_text() == "mine"
    assert alone(out)


def test_path_that_is_no_folder_is_rejected(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for folder in (tmp_path / "file", tmp_path / "file" / "below", Path("/")):
        with pytest.raises(InputError, match="expected"):
            run(folder)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_run_of_the_command_line_is_not_replaced(run: Run, written: Path) -> None:
    with pytest.raises(InputError, match=r"holds boundary\.csv and no manifest\.json"):
        run(written)


@pytest.fixture
def written(tmp_path: Path, calibration: ImageCalibration, measured: Measurement) -> Path:
    with ResultsWriter(tmp_path / "run", calibration, {}) as writer:
        writer.write(FrameResult(0, None, measured))
    return tmp_path / "run"


def test_concurrent_export_to_the_same_folder_is_rejected(
    run: Run, tmp_path: Path, frames: list[FrameResult]
) -> None:
    def measured() -> Iterator[tuple[int, float | None, Measurement]]:
        with pytest.raises(InputError, match="is being written by another program"):
            run(tmp_path / "out")
        yield from frames

    run(tmp_path / "out", measured=measured())
    assert verify_export(tmp_path / "out") == []


# --- failures -----------------------------------------------------------------------------------


class Stopped(BaseException):
    pass


FAILURES = [OSError(28, "No space left on device"), KeyboardInterrupt(), Stopped()]


@pytest.mark.parametrize("failure", FAILURES, ids=lambda failure: type(failure).__name__)
@pytest.mark.parametrize("earlier", [True, False], ids=["earlier", "none"])
@pytest.mark.parametrize("name", ["write_bytes", "rename", "fsync", "progress", "open"])
def test_failure_leaves_only_the_earlier_export(
    run: Run, tmp_path: Path, failure: BaseException, earlier: bool, name: str
) -> None:
    """Each call of one kind fails in turn."""
    out = tmp_path / "out"
    if earlier:
        run(out, ExportChoice())
    before = contents(out) if earlier else None
    owner = os if name == "fsync" else Path
    real = print if name == "progress" else getattr(owner, name)
    finished = False
    for at in range(0, 200, 1 if name == "rename" else 7):
        calls = iter(range(10_000))

        def fail(*args: object, at: int = at, calls: Iterator[int] = calls, **kw: object) -> object:
            if next(calls) == at:
                raise failure
            return None if name == "progress" else real(*args, **kw)

        choice = ExportChoice(tables=frozenset({"measures"}), hdf5=True, spacing_mm=0.5)
        expected = InputError if isinstance(failure, OSError) else type(failure)
        try:
            if name == "progress":
                run(out, choice, progress=fail)
            else:
                with mock.patch.object(owner, name, fail):
                    run(out, choice)
        except expected:
            assert not earlier or contents(out) == before
            assert alone(out) if earlier else not list(tmp_path.iterdir())
        else:
            finished = True
            break
    assert finished
    assert at > 0
    assert verify_export(out) == []
    assert "results.h5" in contents(out)


def test_remains_of_a_killed_export_are_removed(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(out, ExportChoice())
    before = contents(out)
    for partial in (
        tmp_path / ".out.0123456789abcdef.part",
        tmp_path / ".out.fedcba9876543210.part",
    ):
        partial.mkdir()
        (partial / "measures.csv").write_text("half")
    # The export was killed between the two renames that replace the folder.
    out.rename(tmp_path / ".out.0123456789abcdef.old")
    with pytest.raises(Stopped):
        run(out, progress=mock.Mock(side_effect=Stopped))
    assert contents(out) == before
    assert alone(out)
    run(out)
    assert verify_export(out) == []


FULL_DISK = """
    import resource, sys
    import numpy as np
    from pathlib import Path
    from labapp.core.geometry.coordinates import ImageCalibration
    from labapp.core.images.dots import Dots
    from labapp.core.pipeline import Measurement
    from labapp.errors import InputError
    from labapp.export.folder import ExportChoice, export, verify_export
    from labapp.export.frame_result import FrameResult

    found = Measurement("no-rows", "", "fit", Dots(*np.random.default_rng(0).random((7, 300))))
    arguments = ImageCalibration(np.eye(3)), {}, ExportChoice(hdf5=sys.argv[2] == "hdf5")
    out = Path(sys.argv[1])
    export(out, [FrameResult(0, None, found)], *arguments)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
    try:
        export(out, (FrameResult(frame, None, found) for frame in range(100)), *arguments)
    except InputError as error:
        print(error)
    print(verify_export(out), [path.name for path in out.parent.iterdir()])
"""


@pytest.mark.parametrize("kind", ["hdf5", "tables"])
def test_full_disk_leaves_the_earlier_export(tmp_path: Path, kind: str) -> None:
    """The limit is set in the operating system."""
    process = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(FULL_DISK), str(tmp_path / "out"), kind],
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": ":".join(sys.path)},
    )
    assert (process.returncode, process.stderr) == (0, "")
    message, state = process.stdout.splitlines()
    assert "export: File too large" in message
    assert "expected a writable folder with enough disk space" in message
    assert state == "[] ['out']"


# --- verify -------------------------------------------------------------------------------------


def test_verify_lists_differences(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(out)
    mine(out)
    same_size(out)
    points = (out / "points.csv").stat().st_size
    (out / "points.csv").write_text("")
    (out / "results.h5").unlink()
    (out / "dots.csv").unlink()
    os.mkfifo(out / "dots.csv")
    assert verify_export(out) == [
        "notes.txt is not in the manifest",
        "dots.csv is not a file",
        "measures.csv was changed",
        f"points.csv has 0 bytes instead of {points}",
        "results.h5 is missing",
    ]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        "null",
        "[" * 100_000,
        '{"program": "labapp"}',
        '{"program": "labapp", "files": 1}',
        '{"program": "labapp", "files": ["a"]}',
        '{"program": "labapp", "files": [{"name": 1, "size": 1, "sha256": "", "rows": 1}]}',
        '{"program": "labapp", "files": [{"name": "a", "size": null, "sha256": ""}]}',
    ],
)
def test_invalid_manifest_is_reported(tmp_path: Path, text: str) -> None:
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(InputError, match=r"manifest\.json: is not one of labapp"):
        verify_export(tmp_path)


def test_missing_manifest_is_reported(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(InputError, match=r"manifest\.json: does not exist"):
            verify_export(folder)
