from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

import labapp as package
from labapp.core import pipeline
from labapp.core.images.find_dots import find_dots
from labapp.core.pipeline import Measurement, Settings
from labapp.core.rows.correction import Correction
from labapp.core.rows.find_lattice import find_lattice
from labapp.core.surface.measures import Measures
from labapp.core.values import CannotMeasure
from labapp.errors import InputError
from labapp.run import measurers
from labapp.session.checklist import SAFETY, STEPS
from labapp.session.frames import Frames
from labapp.session.record import LaserEntries
from labapp.session.results.measured import StoredResults
from labapp.session.session import Session
from tests.conftest import Run
from tests.same import assert_same

SAMPLE = Path(package.__file__).parents[1] / "sample_sessions" / "gtaw"
SETUP = SAMPLE / "setup.toml"

DARK = 5
"""The frame of the recording without dots."""


def picture(shift_px: float) -> np.ndarray:
    """Seven by seven dots 20 px apart without the one in the middle, shifted to the right."""
    v, u = np.mgrid[:160, :200]
    image = np.full(u.shape, 10.0)
    for row in range(7):
        for column in range(7):
            if (row, column) != (3, 3):
                away = (u - 30 - shift_px - 20 * column) ** 2 + (v - 20 - 20 * row) ** 2
                image += 150 * np.exp(-away / 8)
    return image.astype(np.uint8)


def measure(
    image: np.ndarray,
    _bench: object,
    settings: Settings,
    _prior: None = None,
    correction: Correction | None = None,
) -> tuple[Measurement, None]:
    """Find real dots; the height is their number, plus 100 for each blocked row."""
    try:
        dots = find_dots(image, settings.dots)
        lattice = find_lattice(dots, (image.shape[0], image.shape[1]), settings.lattice)
    except CannotMeasure as error:
        return Measurement(error.status, error.reason, settings.scheme), None
    if correction is not None:
        dots, lattice = correction.dots, correction.lattice
    measurement = Measurement("ok", "", settings.scheme, dots, lattice, correction=correction)
    if settings.scheme == "ers":
        return replace(measurement, status="no-match", reason="for the test"), None
    sizes = dict.fromkeys(Measures.__dataclass_fields__, 1.0)
    sizes |= {name: 0.0 for name in sizes if "_setup_" in name}
    sizes["height_mm"] = float(len(dots) + 100 * len(lattice.blocked_rows))
    sizes["own_are_mm"] = np.nan
    return replace(measurement, measures=Measures(**sizes)), None


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurers, "measure", measure)
    monkeypatch.setattr(pipeline, "measure", measure)


@pytest.fixture(scope="module")
def imported_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording of six frames, the last of them dark, and a session of it."""
    folder = tmp_path_factory.mktemp("cli_session")
    frames = [picture(1.5 * k) for k in range(DARK)]
    np.save(folder / "stack.npy", np.stack([*frames, np.full((160, 200), 10, np.uint8)]))
    with Session.create(folder / "run.labsession") as session:
        session.set_setup(SETUP.read_text("utf-8"))
        session.import_recording(folder / "stack.npy", frame_rate_hz=100)
    return folder


@pytest.fixture
def file(imported_once: Path, tmp_path: Path) -> Path:
    """A session in which nothing was measured."""
    folder = Path(shutil.copytree(imported_once, tmp_path / "run"))
    return folder / "run.labsession"


@pytest.fixture(scope="module")
def measured_once(imported_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("measured") / "run"
    shutil.copytree(imported_once, folder)
    with (
        pytest.MonkeyPatch.context() as patched,
        Session.open(folder / "run.labsession") as session,
    ):
        patched.setattr(measurers, "measure", measure)
        statuses = [measurement.status for _, measurement in session.measure_each()]
    assert statuses == ["ok"] * DARK + ["no-dots"]
    return folder


@pytest.fixture
def measured(measured_once: Path, tmp_path: Path) -> Path:
    """A session in which all six frames were measured."""
    return Path(shutil.copytree(measured_once, tmp_path / "measured")) / "run.labsession"


def open_read_only(file: Path) -> Session:
    return Session.open(file, read_only=True)


# --- new, setup, import, relink ---------------------------------------------------------------


def test_new_session_stores_setup_and_record(labapp: Run, tmp_path: Path) -> None:
    file = tmp_path / "a.labsession"
    options = (
        "--title T --operator O --material M --thickness-mm 2 --current-a 120 --gas Ar".split()
    )
    more_options = "--voltage-v 11.5 --travel-speed-mm-s 3 --notes N".split()
    code, stdout, stderr = labapp("session", "new", file, "--setup", SETUP, *options, *more_options)
    assert (code, stderr) == (0, "")
    assert stdout.startswith(f"{file} is made\n")
    with open_read_only(file) as session:
        record = session.record
        assert (record.title, record.operator, record.material, record.gas) == ("T", "O", "M", "Ar")
        assert (record.thickness_mm, record.current_a, record.voltage_v) == (2, 120, 11.5)
        assert (record.travel_speed_mm_s, record.notes) == (3, "N")
        assert session.setup_text == SETUP.read_text("utf-8")


def test_checklists_of_appendix_ii_are_ticked(labapp: Run, tmp_path: Path) -> None:
    file = tmp_path / "a.labsession"
    labapp("session", "new", file)
    code, stdout, _ = labapp("session", "checklist", file)
    assert code == 0
    assert stdout.count("[ ]") == 7 + 7 + 6
    code, stdout, _ = labapp("session", "checklist", file, "--tick", 2, "--tick", 15)
    assert code == 0
    assert stdout.count("[x]") == 2
    with open_read_only(file) as session:
        assert [item for item, _ in session.record.safety] == [SAFETY[1][0], STEPS[0][0]]
    _, stdout, _ = labapp("session", "checklist", file, "--untick", 2)
    assert stdout.count("[x]") == 1
    code, _, stderr = labapp("session", "checklist", file, "--tick", 21)
    assert code == 2
    assert "--tick" in stderr


def test_session_without_a_setup_prints_the_next_command(labapp: Run, tmp_path: Path) -> None:
    file = tmp_path / "a.labsession"
    code, stdout, _ = labapp("session", "new", file)
    assert code == 0
    assert f"labapp session setup {file} SETUP.toml" in stdout
    with open_read_only(file) as session:
        assert session.history == ()


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("run.txt", [], "run.txt: name: run.txt; expected a name that ends in .labsession"),
        ("there.labsession", [], "file: is there already; expected a new name, or open it"),
        ("a.labsession", ["--setup", "none.toml"], "none.toml: file: No such file"),
        ("a.labsession", ["--thickness-mm", "nan"], "--thickness-mm"),
        ("a.labsession", ["--thickness-mm", "-1"], "--thickness-mm"),
        ("a.labsession", ["--current-a", "x"], "--current-a"),
    ],
)
def test_session_is_not_created_from_wrong_arguments(
    labapp: Run, tmp_path: Path, name: str, options: list[str], message: str
) -> None:
    existing = tmp_path / "there.labsession"
    existing.write_bytes(b"mine")
    code, _, stderr = labapp("session", "new", tmp_path / name, *options)
    assert code == 2
    assert message in stderr
    assert existing.read_bytes() == b"mine"
    assert not (tmp_path / "a.labsession").exists()


def test_changed_setup_lists_stale_results(labapp: Run, measured: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    other.write_text(SETUP.read_text().replace("distance_mm = 31.48", "distance_mm = 31.9"))
    code, stdout, _ = labapp("session", "setup", measured, other)
    assert code == 0
    assert "Now stale: 6 results (frames 0 to 5)" in stdout
    assert f"labapp session measure {measured}" in stdout
    code, stdout, _ = labapp("session", "undo", measured)
    assert stdout.startswith("Undone: set-up (of ")
    assert "No longer stale: 6 results (frames 0 to 5)" in stdout
    _, stdout, _ = labapp("session", "setup", measured, SETUP)
    assert stdout == "The set-up is the same as before\n"


def test_wrong_setup_changes_nothing(labapp: Run, file: Path, tmp_path: Path) -> None:
    (tmp_path / "wrong.toml").write_text(SETUP.read_text().replace("= 31.48", "= -31.48"))
    code, _, stderr = labapp("session", "setup", file, tmp_path / "wrong.toml")
    assert code == 2
    assert "laser.distance_mm: -31.48; expected a number above 0" in stderr
    with open_read_only(file) as session:
        assert session.setup_text == SETUP.read_text("utf-8")


def test_import_describes_the_recording(labapp: Run, tmp_path: Path) -> None:
    file = tmp_path / "a.labsession"
    shutil.copy(SAMPLE / "recording.avi", tmp_path)
    labapp("session", "new", file)
    code, stdout, stderr = labapp(
        "session", "import", file, tmp_path / "recording.avi", "--frames", "0:10:3"
    )
    assert (code, stderr) == (0, "")
    lines = stdout.splitlines()
    assert re.fullmatch(r"recording.avi: AVI, FFV1, 480×640 px, 8 bit grey.*", lines[0])
    assert lines[1:] == [
        "frames     30 in it, 4 frames in the session (0:10:3)",
        "time base  60 frames/s, the recording's own",
        "seeking    frame-exact",
        "kept       as recording.avi",
        "The set-up is not complete:",
        f"  labapp session setup {file} SETUP.toml",
        "Measure it:",
        f"  labapp session measure {file}",
    ]
    with open_read_only(file) as session:
        assert session.frames.tolist() == [0, 3, 6, 9]


@pytest.mark.parametrize("options", [("--all",), ("--frames", "1:4")])
def test_frame_damaged_after_measuring_keeps_its_result(
    labapp: Run, measured: Path, options: tuple[str, ...]
) -> None:
    stack = measured.parent / "stack.npy"
    content = bytearray(stack.read_bytes())
    content[-4 * 160 * 200 : -3 * 160 * 200] = bytes(160 * 200)
    stack.write_bytes(content)
    with open_read_only(measured) as session:
        before = session.result(2), session.result(3), session.overview().status
    code, stdout, stderr = labapp("session", "measure", measured, *options)
    assert code == 2
    assert "1 unreadable" in stdout
    assert f"{stack}: frame 2: no longer what was imported" in stderr.splitlines()[-1]
    with open_read_only(measured) as session:
        assert session.overview().status == before[2]
        for frame, former in ((2, before[0]), (3, before[1])):
            result = session.result(frame)
            assert result is not None
            assert former is not None
            assert_same(result.measurement.measures, former.measurement.measures)
            assert not result.stale
        assert session.problems() != []
    code, _, _ = labapp("session", "verify", measured)
    assert code == 1


def test_frame_damaged_after_import_is_not_measured(labapp: Run, file: Path) -> None:
    stack = file.parent / "stack.npy"
    stack.write_bytes(stack.read_bytes()[: -160 * 200 - 1] + bytes(160 * 200 + 1))
    code, _, _ = labapp("session", "measure", file)
    assert code == 2
    with open_read_only(file) as session:
        assert session.stale_frames().tolist() == [4, 5]


def test_hints_are_quoted_for_the_shell(labapp: Run, tmp_path: Path) -> None:
    file = tmp_path / "Schweißung 1.labsession"
    _, stdout, _ = labapp("session", "new", file, "--setup", SETUP)
    assert stdout.splitlines()[-1] == f"  labapp session import '{file}' RECORDING"


def test_ctrl_c_is_reported_and_imports_nothing(
    labapp: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "a.labsession"
    labapp("session", "new", file)
    before = file.read_bytes()

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Frames, "import_recording", interrupt)
    output = labapp("session", "import", file, SAMPLE / "recording.avi")
    assert output == (130, "", "stopped reading recording.avi; nothing was changed\n")
    assert file.read_bytes() == before


def test_import_with_a_frame_rate_and_embedded_frames(labapp: Run, tmp_path: Path) -> None:
    file = tmp_path / "a.labsession"
    np.save(tmp_path / "s.npy", np.zeros((3, 8, 9), np.uint8))
    labapp("session", "new", file)
    _, stdout, _ = labapp("session", "import", file, tmp_path / "s.npy")
    assert "time base  none: give --frame-rate, or the frames have no times" in stdout
    options = ("--frame-rate", 500, "--embed")
    code, stdout, _ = labapp("session", "import", file, tmp_path / "s.npy", *options)
    assert code == 0
    assert "time base  500 frames/s, as given" in stdout
    assert "kept       in the session itself" in stdout
    (tmp_path / "s.npy").unlink()
    with open_read_only(file) as session:
        assert session.frame(2).time_s == pytest.approx(2 / 500)


def test_warnings_of_a_recording_are_printed(labapp: Run, tmp_path: Path) -> None:
    content = (SAMPLE / "recording.avi").read_bytes()
    (tmp_path / "v.avi").write_bytes(content[: len(content) // 2])
    labapp("session", "new", tmp_path / "a.labsession")
    code, _, stderr = labapp("session", "import", tmp_path / "a.labsession", tmp_path / "v.avi")
    assert code == 0
    assert stderr.startswith("warning: v.avi ends early")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["none.avi"], "none.avi: source: No such file or directory"),
        (["stack.npy", "--frames", "9:"], "stack.npy: frames: 9:"),
        (["stack.npy", "--frame-rate", "nan"], "--frame-rate"),
        (["stack.npy", "--frame-rate", "0"], "stack.npy: frame rate: 0.0"),
        (["stack.npy", "--frame-rate", "1e-320"], "stack.npy: frame rate: 1e-320"),
        (["stack.npy", "--frame-rate", "1e308"], "stack.npy: frame rate: 1e+308"),
    ],
)
def test_failed_import_changes_nothing(
    labapp: Run, file: Path, options: list[str], message: str
) -> None:
    before = file.read_bytes()
    code, _, stderr = labapp("session", "import", file, file.parent / options[0], *options[1:])
    assert code == 2
    assert message in stderr
    assert file.read_bytes() == before


def test_session_is_rejected_as_a_recording(labapp: Run, file: Path, tmp_path: Path) -> None:
    message = f"labapp: {file}: content: a session, or another database; expected a recording;"
    out = tmp_path / "out"
    code, _, stderr = labapp("reconstruct", file, "--setup", SETUP, "--out", out)
    assert code == 2
    assert stderr.startswith(message)
    assert not out.exists()
    assert labapp("session", "import", file, file)[2].startswith(message)


def test_moved_recording_can_be_relinked(labapp: Run, measured: Path) -> None:
    moved = (measured.parent / "stack.npy").rename(measured.parent / "moved.npy")
    code, _, stderr = labapp("session", "measure", measured, "--all")
    assert code == 2
    assert "stack.npy: recording: does not exist" in stderr
    _, stdout, _ = labapp("session", "info", measured)
    assert "stack.npy is missing; labapp session relink sets its new path" in stdout
    code, _, stderr = labapp("session", "relink", measured, SAMPLE / "recording.avi")
    assert code == 2
    assert "content: another recording" in stderr
    code, stdout, _ = labapp("session", "relink", measured, moved)
    assert (code, stdout) == (0, f"{measured} finds its recording at {moved}\n")
    assert labapp("session", "measure", measured, "--all")[0] == 0


# --- measure ----------------------------------------------------------------------------------


def test_measure_selects_missing_and_stale_frames(labapp: Run, file: Path) -> None:
    code, stdout, _ = labapp("session", "measure", file, "--frames", "1:4:2")
    assert code == 0
    assert stdout.startswith("2 frames, 2 with a surface\n")
    _, stdout, _ = labapp("session", "measure", file)
    assert stdout.startswith("4 frames, 3 with a surface (1 no-dots)")
    code, stdout, _ = labapp("session", "measure", file)
    assert code == 0
    assert stdout.startswith("Nothing to measure")
    _, stdout, _ = labapp("session", "measure", file, "--all")
    assert stdout.startswith("6 frames, 5 with a surface (1 no-dots)")


def test_change_of_scheme_can_be_undone(labapp: Run, measured: Path) -> None:
    options = ("--scheme", "irs", "--algorithm", "epa-c", "--correspondence", "I/I")
    code, stdout, _ = labapp("session", "measure", measured, "--frames", 2, *options)
    assert code == 0
    assert stdout.startswith("Settings: scheme irs, algorithm epa-c, correspondence I/I (labapp")
    with open_read_only(measured) as session:
        assert session.settings == Settings("irs", "epa-c", "I/I")
        assert session.measured_by == {
            ("fit", package.__version__): 6,
            ("irs-epa-c", package.__version__): 1,
        }
    _, stdout, _ = labapp("session", "undo", measured)
    assert stdout.startswith("Undone: scheme irs, algorithm epa-c, correspondence I/I")
    with open_read_only(measured) as session:
        assert session.settings == Settings()
        assert not session.overview().stale.any()


def test_detector_and_row_search_are_stored_as_settings(labapp: Run, measured: Path) -> None:
    options = ("--detector", "block-threshold", "--rows", "masks")
    code, stdout, _ = labapp("session", "measure", measured, "--frames", 2, *options)
    assert code in {0, 1}
    assert "detector block-threshold, rows masks" in stdout
    with open_read_only(measured) as session:
        settings = session.settings
        assert (settings.dots.method, settings.lattice.method) == ("block-threshold", "masks")
        result = session.result(2)
        assert result is not None
        assert result.settings.dots.method == "block-threshold"
    labapp("session", "undo", measured)
    with open_read_only(measured) as session:
        assert session.settings == Settings()


def test_run_without_a_surface_exits_with_1(labapp: Run, file: Path) -> None:
    code, stdout, stderr = labapp("session", "measure", file, "--frames", "0:2", "--scheme", "ers")
    assert code == 1
    assert stderr.splitlines() == [f"frame {k}: no-match: for the test" for k in range(2)]
    assert stdout.endswith("2 frames, 0 with a surface (2 no-match)\n")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--frames 7", "--frames: frames: 7; expected some of the frames 0 to 5"),
        ("--frames x", "--frames: frames: x; expected A:B:STEP"),
        ("--frames 1 --all", "--all: frames: and --frames 1; expected one of the two"),
        ("--algorithm epa-r", "--algorithm: algorithm: epa-r; expected scheme irs"),
        ("--scheme best", "--scheme"),
    ],
)
def test_failed_measure_command_changes_nothing(
    labapp: Run, file: Path, options: str, message: str
) -> None:
    before = file.read_bytes()
    code, _, stderr = labapp("session", "measure", file, *options.split())
    assert code == 2
    assert message in stderr
    assert file.read_bytes() == before


def test_interrupted_measuring_reports_finished_frames(
    labapp: Run, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put = StoredResults.put

    def put_until_full(results: StoredResults, frame: int, *arguments: Any) -> None:
        if frame == 2:
            raise InputError(file, "disk", "no space left", "room on the disk")
        put(results, frame, *arguments)

    monkeypatch.setattr(StoredResults, "put", put_until_full)
    code, stdout, stderr = labapp("session", "measure", file)
    assert (code, stdout) == (2, "")
    assert stderr.splitlines() == [
        "stopped: 2 of 6 frames are done and kept",
        f"labapp: {file}: disk: no space left; expected room on the disk",
    ]
    with open_read_only(file) as session:
        assert session.stale_frames().tolist() == [2, 3, 4, 5]


def test_only_imported_frames_are_measured(labapp: Run, file: Path) -> None:
    labapp("session", "import", file, file.parent / "stack.npy", "--frames", "::2")
    code, stdout, _ = labapp("session", "measure", file, "--frames", "1:3")
    assert code == 0
    assert stdout.startswith("1 frame, 1 with a surface")
    code, _, stderr = labapp("session", "measure", file, "--frames", "3")
    assert code == 2
    assert "expected some of frames 0, 2, 4" in stderr


def test_missing_setup_and_recording_are_reported(labapp: Run, tmp_path: Path) -> None:
    file = tmp_path / "a.labsession"
    labapp("session", "new", file)
    code, _, stderr = labapp("session", "measure", file, "--scheme", "ers")
    assert code == 2
    assert f"{file}: laser: missing; expected a table [laser]" in stderr
    labapp("session", "setup", file, SETUP)
    code, _, stderr = labapp("session", "measure", file, "--scheme", "ers")
    assert code == 2
    assert "recording: none; expected one: labapp session import" in stderr
    with open_read_only(file) as session:
        assert session.settings == Settings()


@pytest.mark.parametrize(
    ("signal_number", "handler", "told"),
    [
        (signal.SIGINT, signal.default_int_handler, (130, "")),
        (signal.SIGTERM, signal.SIG_DFL, (143, "labapp: stopped by SIGTERM\n")),
    ],
)
def test_stopped_measuring_keeps_finished_frames(
    labapp: Run,
    file: Path,
    monkeypatch: pytest.MonkeyPatch,
    signal_number: signal.Signals,
    handler: signal.Handlers,
    told: tuple[int, str],
) -> None:
    calls: list[object] = []

    def measure_and_signal(*arguments: object) -> tuple[Measurement, None]:
        calls.append(arguments)
        if len(calls) == 3:
            os.kill(os.getpid(), signal_number)
        return measure(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(measurers, "measure", measure_and_signal)
    former = signal.signal(signal_number, handler)
    try:
        code, stdout, stderr = labapp("session", "measure", file)
    finally:
        signal.signal(signal_number, former)
    assert (code, stdout) == (told[0], "")
    message = "stopped: 2 of 6 frames are done and kept; the others: labapp session measure"
    assert stderr == f"{message} {file}\n{told[1]}"
    with open_read_only(file) as session:
        assert session.stale_frames().tolist() == [2, 3, 4, 5]
    with open_read_only(file) as session:
        assert session.stale_frames().tolist() == [2, 3, 4, 5]
        assert session.problems() == []


# --- correct ----------------------------------------------------------------------------------


def test_edits_are_applied_in_the_given_order(labapp: Run, measured: Path) -> None:
    correct = ("session", "correct", measured, "--frame", 1)
    code, _, stderr = labapp(*correct, "--merge-rows", "1:2", "--shift-row", "1:7")
    assert code == 2
    assert "--merge-rows: ROW:INTO: 1:2; expected an edit that fits frame 1: row 1" in stderr
    order = "--shift-row 1:7 --merge-rows 1:2 --shift-row 1:-1"
    code, stdout, stderr = labapp(*correct, *order.split())
    assert (code, stderr) == (0, "")
    assert stdout.splitlines()[0] == "Corrected: frame 1 (labapp session undo takes it back)"
    with open_read_only(measured) as session:
        correction = session.correction(1)
        assert correction is not None
        assert correction.lattice.row.tolist().count(1) == 14
        (change,) = session.history[1:]
        assert change.label == "frame 1: shift-row 1:7, merge-rows 1:2, shift-row 1:-1"


def test_every_edit_is_applied_to_the_frame(labapp: Run, measured: Path) -> None:
    # The dot of row 1 (the lowest), column 1, is at (30, 140) px in frame 0.
    edits = (
        "--delete 31,141 --add 30.2,139.7 --place 30,140:1,1 --move 50,140:0.5,-0.25 "
        "--clear 70,140 --split-row 7:4 --block-row 2 --block-row 3 --unblock-row 3 "
        "--reference 4,4"
    )
    code, stdout, stderr = labapp("session", "correct", measured, "--frame", 0, *edits.split())
    assert (code, stderr) == (0, "")
    with open_read_only(measured) as session:
        correction = session.correction(0)
    assert correction is not None
    lattice, dots = correction.lattice, correction.dots
    assert (len(dots), lattice.reference, lattice.blocked_rows) == (48, (4, 4), frozenset({2}))
    assert (lattice.row[-1], lattice.column[-1]) == (1, 1)
    np.testing.assert_allclose(dots.image_px[-1], [30, 140], atol=0.2)
    moved = int(np.argmin(np.hypot(dots.u_px - 50.5, dots.v_px - 139.75)))
    np.testing.assert_allclose(dots.image_px[moved], [50.5, 139.75], atol=0.2)
    assert lattice.row[int(np.argmin(np.hypot(dots.u_px - 70, dots.v_px - 140)))] == 0
    assert (lattice.row == 8).sum() == 4
    assert stdout.splitlines()[1:] == [
        "frame 0: ok → ok",
        "  width    1.0000 →   1.0000 mm",
        "  length   1.0000 →   1.0000 mm",
        "  height  48.0000 → 148.0000 mm",
        "  depth    1.0000 →   1.0000 mm",
        "  ARE      1.0000 →   1.0000 mm",
    ]


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        ("--delete 40,130", "the nearest is dot"),
        ("--delete 40", "--delete: U,V: 40; expected an edit that fits frame 0: it is of the form"),
        ("--delete x,1", "U is a number (px)"),
        ("--delete nan,1", "U is a number (px)"),
        ("--move 30,140:1", "it is of the form U,V:DU,DV"),
        ("--place 30,140:1.5,1", "ROW is a whole number"),
        ("--place 30,140:1,2", "row 1, column 2 is already assigned to dot"),
        ("--add 500,1", "(500, 1) px is not in the frame"),
        ("--add 30,140", "is there already"),
        ("--shift-row 40:1", "row 40 has no dots"),
        ("--merge-rows 1:1", "cannot be merged with itself"),
        ("--block-row 8", "an edit that fits frame 0: its highest row is 7"),
        ("--unblock-row 1", "row 1 is not marked as blocked"),
        ("--reference 1", "it is of the form ROW,COLUMN"),
        ("--dots none.csv", "none.csv: file: No such file"),
        ("", "correct: edits: none; expected some of --dots, --delete, --add, --move"),
        ("", "--shift-row, --split-row, --merge-rows, --block-row"),
        ("--automatic --carry-on", "--carry-on: edits: --automatic"),
    ],
)
def test_wrong_edit_changes_nothing(labapp: Run, measured: Path, edit: str, message: str) -> None:
    before = measured.read_bytes()
    # A valid edit before it is not applied either.
    valid = [] if "automatic" in edit or not edit else ["--block-row", "2"]
    code, stdout, stderr = labapp(
        "session", "correct", measured, "--frame", 0, *valid, *edit.split()
    )
    assert (code, stdout) == (2, "")
    assert message in stderr
    assert measured.read_bytes() == before


def test_missing_frame_cannot_be_corrected(labapp: Run, measured: Path) -> None:
    code, _, stderr = labapp("session", "correct", measured, "--frame", 6, "--block-row", 1)
    assert code == 2
    assert "--frame: frame: 6; expected one of frames 0 to 5" in stderr


def test_correction_can_be_reset_to_automatic(labapp: Run, measured: Path) -> None:
    correct = ("session", "correct", measured, "--frame", 0)
    labapp(*correct, "--delete", "30,140", "--block-row", 2)
    # Edits before --automatic are discarded; those after it start from the found dots.
    labapp(*correct, "--block-row", 7, "--automatic", "--block-row", 3)
    with open_read_only(measured) as session:
        correction = session.correction(0)
        assert correction is not None
        assert (len(correction.dots), correction.lattice.blocked_rows) == (48, frozenset({3}))
    code, stdout, _ = labapp(*correct, "--automatic", "--no-measure")
    assert code == 0
    assert "Now stale: 1 result (frame 0)" in stdout
    with open_read_only(measured) as session:
        assert session.correction(0) is None
        assert len(session.history) == 4


def test_correction_starts_from_the_current_state(labapp: Run, measured: Path) -> None:
    """An undone correction is not restored from the result measured with it."""
    correct = ("session", "correct", measured, "--frame", 0)
    labapp(*correct, "--delete", "30,140")
    labapp("session", "undo", measured)
    labapp(*correct, "--block-row", 2)
    with open_read_only(measured) as session:
        correction = session.correction(0)
        assert correction is not None
        assert len(correction.dots) == 48


def test_unmeasured_frame_can_be_corrected(labapp: Run, file: Path) -> None:
    code, stdout, _ = labapp("session", "correct", file, "--frame", 3, "--block-row", 2)
    assert code == 0
    assert "frame 3: not measured → ok" in stdout
    assert "  height        – → 148.0000 mm" in stdout


def test_correction_is_carried_on_while_it_fits(labapp: Run, measured: Path) -> None:
    labapp("session", "correct", measured, "--frame", 3, "--block-row", 5, "--no-measure")
    code, stdout, stderr = labapp(
        "session", "correct", measured, "--frame", 1, "--block-row", 2, "--carry-on"
    )
    assert code == 0, stderr
    assert "It replaces earlier corrections of frame 3\n" in stdout
    assert "Carried on over 3 frames, stopped before frame 5: no-dots" in stdout
    assert "Corrected: frames 1 to 4 (" in stdout
    assert "4 frames, 4 with a surface" in stdout
    with open_read_only(measured) as session:
        overview = session.overview()
        assert overview.corrected.tolist() == [False, True, True, True, True, False]
        assert not overview.stale.any()
        assert overview.measures["height_mm"][:5].tolist() == [48, 148, 148, 148, 148]
        carried = session.correction(4)
        assert carried is not None
        assert carried.lattice.blocked_rows == frozenset({2})
        assert len(session.history) == 3
    # Undo takes back all of it in one step.
    labapp("session", "undo", measured)
    with open_read_only(measured) as session:
        assert session.overview().corrected.tolist() == [False] * 3 + [True] + [False] * 2


def test_existing_correction_can_be_carried_on(labapp: Run, measured: Path) -> None:
    labapp("session", "correct", measured, "--frame", 3, "--block-row", 5)
    code, stdout, _ = labapp("session", "correct", measured, "--frame", 3, "--carry-on")
    assert code == 0
    assert "Corrected: frames 3 to 4 (" in stdout


def dot_rows(file: Path, frame: int) -> list[dict[str, str]]:
    with open_read_only(file) as session:
        result = session.result(frame)
    assert result is not None
    dots, lattice = result.measurement.dots, result.measurement.lattice
    assert dots is not None
    assert lattice is not None
    return [
        {
            "frame": str(frame),
            "u_px": f"{dots.u_px[k]:.4f}",
            "v_px": f"{dots.v_px[k]:.4f}",
            "reflected_row": str(lattice.row[k] or ""),
            "reflected_column": str(lattice.column[k] or ""),
            "blocked": "0",
        }
        for k in range(len(dots))
    ]


def test_dots_are_read_from_a_table(labapp: Run, measured: Path, tmp_path: Path) -> None:
    rows = dot_rows(measured, 0) + dot_rows(measured, 2)
    for row in rows:
        row["blocked"] = str(int(row["frame"] == "2" and row["reflected_row"] == "2"))
    with (tmp_path / "dots.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    code, stdout, stderr = labapp(
        *("session", "correct", measured, "--frame", 2, "--dots", tmp_path / "dots.csv"),
        *("--delete", "33,140"),
    )
    assert (code, stderr) == (0, "")
    assert "  height  48.0000 → 147.0000 mm" in stdout
    with open_read_only(measured) as session:
        correction = session.correction(2)
        assert correction is not None
        assert correction.lattice.blocked_rows == frozenset({2})
        assert not correction.manual.any()


# --- undo, redo -------------------------------------------------------------------------------


def test_undo_and_redo_describe_the_change(labapp: Run, measured: Path) -> None:
    labapp("session", "correct", measured, "--frame", 1, "--block-row", 2)
    code, stdout, _ = labapp("session", "undo", measured)
    assert code == 0
    assert stdout.startswith("Undone: frame 1: block-row 2 (of 2")
    assert "Now stale: 1 result (frame 1)" in stdout
    code, stdout, _ = labapp("session", "redo", measured)
    assert stdout.startswith("Done again: frame 1: block-row 2 (of 2")
    assert "No longer stale: 1 result (frame 1)" in stdout
    assert labapp("session", "redo", measured)[:2] == (0, "Nothing to redo\n")
    labapp("session", "undo", measured)
    labapp("session", "undo", measured)
    assert labapp("session", "undo", measured)[:2] == (0, "Nothing to undo\n")


# --- export -----------------------------------------------------------------------------------


def test_results_are_exported(labapp: Run, measured: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    before = measured.read_bytes()
    code, stdout, stderr = labapp("session", "export", measured, "--out", out)
    assert (code, stderr) == (0, "")
    assert stdout == f"4 files and the manifest are in {out}\n"
    with (out / "measures.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["status"] for row in rows] == ["ok"] * DARK + ["no-dots"]
    assert rows[3]["time_s"] == "0.030000"
    code, _, _ = labapp(
        *("session", "export", measured, "--out", out, "--frames", "::2", "--no-tables"),
        *("--surfaces", "none", "--hdf5", "--pictures", "frames,trends"),
    )
    assert code == 0
    assert sorted(path.name for path in out.iterdir()) == [
        *(f"frame_{k:06d}.png" for k in (0, 2, 4)),
        *("manifest.json", "results.h5", "trends.png"),
    ]
    nothing = ("--frames", DARK, "--no-tables", "--surfaces", "none")
    code, stdout, _ = labapp("session", "export", measured, "--out", out, *nothing, "--report")
    assert (code, stdout) == (0, f"1 file and the manifest are in {out}\n")
    assert (out / "report.pdf").read_bytes().startswith(b"%PDF")
    assert measured.read_bytes() == before


def test_a_film_is_exported(labapp: Run, tmp_path: Path) -> None:
    pytest.importorskip("pyvista")
    sample = Path(package.__file__).parents[1] / "sample_sessions" / "blocked_rows"
    code, _, stderr = labapp(
        *("session", "export", sample / "blocked_rows.labsession", "--out", tmp_path / "out"),
        *("--no-tables", "--surfaces", "none", "--pictures", "film"),
        *("--view", "top", "--size", "480x320", "--film-rate", 5),
    )
    assert (code, stderr) == (0, "")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        *("film.mp4", "manifest.json")
    ]
    with av.open(str(tmp_path / "out" / "film.mp4")) as container:
        frames = list(container.decode(video=0))
    assert [frame.time for frame in frames] == pytest.approx([k / 5 for k in range(6)])
    assert {(frame.width, frame.height) for frame in frames} == {(480, 320)}
    assert all(np.ptp(frame.to_ndarray(format="gray")) > 100 for frame in frames)


def test_exported_dots_can_be_read_as_a_correction(
    labapp: Run, measured: Path, tmp_path: Path
) -> None:
    labapp("session", "export", measured, "--out", tmp_path / "out", "--surfaces", "none")
    code, _, stderr = labapp(
        *("session", "correct", measured, "--frame", 1),
        *("--dots", tmp_path / "out" / "dots.csv", "--no-measure"),
    )
    assert (code, stderr) == (0, "")
    with open_read_only(measured) as session:
        correction, result = session.correction(1), session.result(1)
    assert correction is not None
    assert result is not None
    assert result.measurement.dots is not None
    np.testing.assert_array_equal(correction.dots.u_px, result.measurement.dots.u_px)
    assert not correction.manual.any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--surfaces obj", "export: surfaces: obj; expected some of csv, stl"),
        ("--pictures all", "export: pictures: all; expected some of frames, surfaces, trends"),
        ("--pictures film --size 1280", "--size: size: 1280; expected WIDTHxHEIGHT"),
        ("--pictures film --size 1281x720", "export: size_px: 1281x720; expected even numbers"),
        ("--pictures film --film-rate 0", "export: film_rate_hz: 0.0; expected above 0"),
        ("--surfaces csv --solid", "export: solid: no mesh format; expected one of stl"),
        ("--no-tables --surfaces none", "export: choice: nothing; expected tables, surfaces"),
        ("--scheme ers", "results: none by ers; expected frames to be measured"),
        ("--scheme irs", "--scheme"),
        ("--frames 6", "--frames: frames: 6; expected some of the frames 0 to 5"),
    ],
)
def test_failed_export_leaves_no_folder(
    labapp: Run, measured: Path, tmp_path: Path, options: str, message: str
) -> None:
    out = tmp_path / "out"
    code, _, stderr = labapp("session", "export", measured, "--out", out, *options.split())
    assert code == 2
    assert message in stderr
    assert not out.exists()


def test_export_lists_unmeasured_frames(labapp: Run, file: Path, tmp_path: Path) -> None:
    labapp("session", "measure", file, "--frames", "1:3")
    code, stdout, _ = labapp("session", "export", file, "--out", tmp_path / "out")
    assert code == 0
    assert stdout.startswith("Not measured, so not in it: frames 0, 3 to 5\n4 files and")
    _, stdout, _ = labapp("session", "export", file, "--out", tmp_path / "out", "--frames", "1:3")
    assert "Not measured" not in stdout


def test_stale_results_are_not_exported(labapp: Run, measured: Path, tmp_path: Path) -> None:
    labapp("session", "correct", measured, "--frame", 1, "--block-row", 2, "--no-measure")
    export = ("session", "export", measured, "--out", tmp_path / "out")
    code, _, stderr = labapp(*export)
    assert code == 2
    assert "1 of 6 frames are out of date: the dots or rows were corrected" in stderr
    assert labapp(*export, "--frames", "2:")[0] == 0


def test_export_does_not_overwrite_other_files(labapp: Run, measured: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "measures.csv").write_text("mine")
    code, _, stderr = labapp("session", "export", measured, "--out", tmp_path / "out")
    assert code == 2
    assert "folder: holds measures.csv and no manifest.json; expected" in stderr
    assert (tmp_path / "out" / "measures.csv").read_text() == "mine"


# --- info, verify -----------------------------------------------------------------------------


def test_info_summarizes_the_session(labapp: Run, measured: Path) -> None:
    labapp("session", "correct", measured, "--frame", 1, "--block-row", 2, "--no-measure")
    code, stdout, stderr = labapp("session", "info", measured, "--history")
    assert (code, stderr) == (0, "")
    lines = stdout.splitlines()
    assert lines[0].startswith(f"session    {measured} (0.")
    assert lines[1] == "record     empty"
    assert lines[2].startswith("recording  stack.npy: ")
    assert lines[3] == "           6 frames, of which 0:6:1; 100 frames/s; frame-exact"
    assert "set-up     complete" in lines
    assert "settings   all as usual" in lines
    assert "frames     6: 5 ok, 1 no-dots (fit)" in lines
    assert "corrected  frame 1" in lines
    assert "stale      frame 1" in lines
    assert f"results    6 fit by labapp {package.__version__}" in lines
    assert "changes    2 to undo, 0 to redo" in lines
    assert lines[-1].endswith("  frame 1: block-row 2")


def test_info_as_json(labapp: Run, measured: Path) -> None:
    labapp("session", "measure", measured, "--scheme", "irs", "--frames", "1")
    labapp("session", "undo", measured)
    code, stdout, _ = labapp("session", "info", measured, "--json", "--history")
    assert code == 0
    info = json.loads(stdout)
    assert info["size_bytes"] == measured.stat().st_size
    assert (info["scheme"], info["statuses"]) == ("fit", {"ok": 5, "no-dots": 1})
    assert (info["setup_lacks"], info["stale"], info["corrected"]) == ([], [], [])
    assert [(r["scheme"], r["count"]) for r in info["results"]] == [("fit", 6), ("irs-opa", 1)]
    assert info["recording"]["frame_rate_hz"] == 100
    assert info["recording"]["missing"] is None
    assert [(c["label"], c["undone"]) for c in info["history"]] == [
        ("set-up", False),
        ("scheme irs", True),
    ]


def test_info_lists_what_waits_to_be_applied(labapp: Run, measured: Path) -> None:
    with Session.open(measured) as session:
        session.set_entries("laser", LaserEntries((("4.6", "", ""),), 10.0, 0.1, 0.05))
        assert (
            "waiting    laser readings: not applied yet" in labapp("session", "info", measured)[1]
        )
        session.set_entries("laser", None)
        assert "waiting" not in labapp("session", "info", measured)[1]


def test_info_lists_missing_parts_and_unusual_settings(labapp: Run, tmp_path: Path) -> None:
    file = tmp_path / "a.labsession"
    labapp("session", "new", file, "--operator", "A. Weld")
    with Session.open(file) as session:
        session.calibrate_laser([13.675], [18.561], [7.874])
        session.calibrate_plane(SAMPLE / "calibration.png", 6.35)
        fit = replace(Settings().fit, knot_mm=0.8)
        session.set_settings(Settings(correspondence="S/S", fit=fit))
        code, stdout, _ = labapp("session", "info", file)  # while it is open here
    assert code == 0
    assert "record     operator A. Weld" in stdout
    assert "recording  none imported yet" in stdout
    assert "set-up     pattern: missing; expected a table [pattern] with rows" in stdout
    assert re.search(r"laser +(30\.0|29\.9)\d+ ± .* degrees, (90\.0|89\.9)\d+ ± .* mm", stdout)
    assert re.search(r"plane +5\.6\d+ px/mm along X′, 5\.6\d+ px/mm along Z′", stdout)
    assert "settings   correspondence S/S, fit.knot_mm 0.8" in stdout
    assert "frames     0: none (fit)" in stdout


def test_verify_confirms_an_intact_session(labapp: Run, measured: Path) -> None:
    before = measured.read_bytes()
    assert labapp("session", "verify", measured) == (
        0,
        "whole: 6 frames, 6 results, 1 change\n",
        "",
    )
    assert measured.read_bytes() == before


def test_verify_prints_one_line_for_each_problem(labapp: Run, measured: Path) -> None:
    with Session.open(measured) as session, session._database.transaction() as connection:
        connection.execute("UPDATE result SET height_mm = 7 WHERE frame IN (1, 2)")
    (measured.parent / "stack.npy").unlink()
    code, stdout, _ = labapp("session", "verify", measured)
    assert code == 1
    assert len(stdout.splitlines()) == 3
    assert "stack.npy" in stdout
    code, stdout, _ = labapp("session", "verify", measured, "--no-recording")
    assert code == 1
    assert stdout.splitlines() == [
        f"result of frame {k} (fit) differs from its measurement" for k in (1, 2)
    ]


# --- any session ------------------------------------------------------------------------------

COMMANDS = {
    "setup": [SETUP],
    "import": [SAMPLE / "recording.avi"],
    "relink": [SAMPLE / "recording.avi"],
    "measure": [],
    "correct": ["--frame", "0", "--block-row", "1"],
    "undo": [],
    "redo": [],
    "export": ["--out", "no_export"],
    "info": [],
    "verify": [],
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("content", [None, b"", b"SQLite format 3\0" + bytes(500), b"text" * 99])
def test_invalid_session_file_is_rejected_in_one_line(
    labapp: Run, tmp_path: Path, command: str, content: bytes | None
) -> None:
    file = tmp_path / "a.labsession"
    if content is not None:
        file.write_bytes(content)
    code, stdout, stderr = labapp("session", command, file, *COMMANDS[command])
    assert (code, stdout) == (2, "")
    assert stderr.startswith(f"labapp: {file}: ")
    assert stderr.count("\n") == 1
    assert (file.read_bytes() if file.exists() else None) == content


@pytest.mark.parametrize("command", COMMANDS)
def test_open_session_is_read_only_for_commands(
    labapp: Run, measured: Path, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(measured.parent)
    with Session.open(measured):
        code, _, stderr = labapp("session", command, measured, *COMMANDS[command])
    if command in ("export", "info", "verify"):
        assert (code, stderr) == (0, "")
    else:
        assert code == 2
        assert "read-only" in stderr


@pytest.mark.parametrize("command", ["", "new", *COMMANDS])
def test_help_states_units(labapp: Run, command: str) -> None:
    code, stdout, _ = labapp("session", *command.split(), "--help")
    assert code == 0
    if command in ("new", "import", "correct", "export"):
        assert re.search(r"mm|px|Hz", stdout)
