from __future__ import annotations

import csv
import errno
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import textwrap
import time
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer.core
from typer.main import get_command

from labapp import log
from labapp.cli import app
from labapp.core.pipeline import Measurement, Settings
from labapp.errors import InputError
from labapp.export import results
from labapp.run import measurers
from labapp.run.runner import select_frames
from tests.conftest import Run
from tests.waiting import PATIENCE_S, connect, wait_until

SAMPLE = Path(__file__).parents[1] / "sample_sessions" / "gtaw"
SETUP = SAMPLE / "setup.toml"

pytestmark = pytest.mark.usefixtures("state")


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def failed_measurement(status: str = "no-dots") -> Measurement:
    return Measurement(
        status=status,
        reason="for the test",
        scheme="fit",
        dots=None,
        lattice=None,
        match=None,
        reconstruction=None,
        measures=None,
    )


@pytest.fixture
def measured_images(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Replace the measurement by one that only records its images."""
    images: list[np.ndarray] = []

    def measure(image: np.ndarray, *_: object) -> tuple[Measurement, None]:
        images.append(image)
        return failed_measurement(), None

    monkeypatch.setattr(measurers, "measure", measure)
    return images


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Six images, the fourth of them truncated; image k has the grey level k."""
    folder = tmp_path / "images"
    folder.mkdir()
    for k in range(6):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((8, 9), k, np.uint8))
    (folder / "3.png").write_bytes((folder / "3.png").read_bytes()[:40])
    return folder


# --- frames -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (":", [0, 1, 2, 3, 4, 5]),
        ("2:4", [2, 3]),
        ("2:", [2, 3, 4, 5]),
        (":2", [0, 1]),
        ("::2", [0, 2, 4]),
        ("1:100:3", [1, 4]),
        ("3", [3]),
        ("-1", [5]),
        ("-2:", [4, 5]),
    ],
)
def test_frames_are_selected_like_a_slice(text: str, expected: list[int]) -> None:
    assert list(select_frames(text, 6)) == expected


@pytest.mark.parametrize("text", ["a", "1:2:3:4", "::0", "::-1", "6", "4:2", "1.5", "1-3"])
def test_wrong_frame_selection_is_rejected(text: str) -> None:
    with pytest.raises(InputError, match=r"--frames: frames: .*; expected"):
        select_frames(text, 6)


# --- reconstruct ------------------------------------------------------------------------------


def test_each_frame_has_a_row_and_each_failure_a_line(
    labapp: Run, folder: Path, tmp_path: Path, measured_images: list[np.ndarray]
) -> None:
    out = tmp_path / "out"
    code, stdout, stderr = labapp("reconstruct", folder, "--setup", SETUP, "--out", out)
    rows = table(out / "measures.csv")
    assert [row["frame"] for row in rows] == list("012345")
    assert [row["status"] for row in rows] == [*["no-dots"] * 3, "unreadable", *["no-dots"] * 2]
    assert [int(image[0, 0]) for image in measured_images] == [0, 1, 2, 4, 5]
    lines = stderr.splitlines()
    assert len(lines) == 6
    assert lines[0] == "frame 0: no-dots: for the test"
    assert lines[3].startswith("frame 3: unreadable: ")
    assert "3.png: content: cannot be decoded; expected a complete image" in lines[3]
    assert "6 frames, 0 with a surface (5 no-dots, 1 unreadable)" in stdout
    assert str(out) in stdout
    assert code == 1  # done, and nothing could be measured


def test_options_are_passed_to_the_measurement(
    labapp: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    used_settings: list[Settings] = []

    def measure(*arguments: Any) -> tuple[Measurement, None]:
        used_settings.append(arguments[2])
        return failed_measurement(), None

    monkeypatch.setattr(measurers, "measure", measure)
    out = tmp_path / "out"
    options = "--scheme irs --algorithm epa-rc --correspondence I/I --frames 0:3:2".split()
    labapp("reconstruct", folder, "--setup", SETUP, "--out", out, *options)
    assert len(used_settings) == 2
    assert (
        used_settings[0].scheme,
        used_settings[0].algorithm,
        used_settings[0].correspondence,
    ) == ("irs", "epa-rc", "I/I")
    summary = json.loads((out / "run.json").read_text())
    assert summary["settings"]["algorithm"] == "epa-rc"
    assert summary["frames"] == {"start": 0, "stop": 3, "step": 2}
    assert summary["setup"]["toml"] == SETUP.read_text()
    assert summary["source"]["path"] == str(folder)


def test_readable_frames_of_a_truncated_video_are_measured(
    labapp: Run, tmp_path: Path, measured_images: list[np.ndarray]
) -> None:
    video = tmp_path / "v.avi"
    content = (SAMPLE / "recording.avi").read_bytes()
    video.write_bytes(content[: len(content) // 2])
    out = tmp_path / "out"
    _, _, stderr = labapp("reconstruct", video, "--setup", SETUP, "--out", out)
    rows = table(out / "measures.csv")
    assert 10 < len(rows) < 20
    assert float(rows[6]["time_s"]) == pytest.approx(0.1)
    assert stderr.startswith("warning: v.avi ends early: its header says 30 frames")
    assert len(measured_images) == len(rows)


def test_any_image_gets_a_status_and_a_reason(labapp: Run, tmp_path: Path) -> None:
    """One pixel, 16 bit, colour and float, with the real measurement."""
    noise = np.random.default_rng(0).integers(0, 60, (40, 50, 3))
    images = {
        "one.png": np.array([[7]], np.uint8),
        "deep.png": (noise[..., 0] * 257).astype(np.uint16),
        "colour.png": noise.astype(np.uint8),
        "float.tiff": noise[..., 0].astype(np.float32) / 60,
        "black.png": np.zeros((40, 50), np.uint8),
    }
    for name, image in images.items():
        cv2.imwrite(str(tmp_path / name), image)
        out = tmp_path / name.replace(".", "_")
        code, _, _ = labapp("reconstruct", tmp_path / name, "--setup", SETUP, "--out", out)
        (row,) = table(out / "measures.csv")
        assert code == 1
        assert row["status"] not in ("", "ok", "unreadable")
        assert row["reason"]


@pytest.mark.parametrize(
    ("name", "content"),
    [("empty.avi", b""), ("text.avi", b"not a video\n" * 99), ("empty.png", b""), ("x", b"\x00")],
)
def test_invalid_source_is_rejected_in_one_line(
    labapp: Run, tmp_path: Path, name: str, content: bytes, state: Path
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    code, stdout, stderr = labapp("reconstruct", path, "--setup", SETUP, "--out", tmp_path / "o")
    assert code == 2
    assert stdout == ""
    assert stderr.startswith(f"labapp: {path}: ")
    assert stderr.count("\n") == 1
    assert "; expected " in stderr
    assert not (tmp_path / "o").exists()
    (logged,) = state.rglob("labapp.log")
    assert "Traceback" in logged.read_text()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("distance_mm = 31.48\n", "", "laser.distance_mm: missing; expected a number above 0"),
        ("distance_mm = 31.48", "distance_mm = -31.48", "laser.distance_mm: -31.48; expected a"),
        ("distance_mm = 31.48", "distance_mm = nan", "laser.distance_mm: nan; expected a number"),
    ],
)
def test_wrong_setup_is_rejected_in_one_line(
    labapp: Run, folder: Path, tmp_path: Path, old: str, new: str, message: str
) -> None:
    setup = tmp_path / "setup.toml"
    setup.write_text(SETUP.read_text().replace(old, new))
    code, _, stderr = labapp("reconstruct", folder, "--setup", setup, "--out", tmp_path / "o")
    assert code == 2
    assert stderr.startswith(f"labapp: {setup}: {message}")
    assert stderr.count("\n") == 1


def test_unwritable_output_folder_is_rejected(labapp: Run, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    out = tmp_path / "file" / "out"
    code, _, stderr = labapp("reconstruct", folder, "--setup", SETUP, "--out", out)
    assert code == 2
    assert f"labapp: {out}: results: Not a directory" in stderr


@pytest.mark.parametrize("empty", ["SOURCE", "--out"])
def test_empty_path_is_not_the_current_folder(
    labapp: Run, folder: Path, tmp_path: Path, empty: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    given = {"SOURCE": folder, "--out": folder / "out"} | {empty: ""}
    code, _, stderr = labapp(
        "reconstruct", given["SOURCE"], "--setup", SETUP, "--out", given["--out"]
    )
    assert code == 2
    assert empty in stderr
    assert not (tmp_path / "run.json").exists()


def test_full_disk_leaves_complete_frames(
    labapp: Run,
    folder: Path,
    tmp_path: Path,
    measured_images: list[np.ndarray],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    append = results.write_all

    def append_until_full(file: io.FileIO, content: bytes) -> None:
        if len(measured_images) == 3:
            append(file, content[:10])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        append(file, content)

    monkeypatch.setattr(results, "write_all", append_until_full)
    out = tmp_path / "out"
    code, _, stderr = labapp("reconstruct", folder, "--setup", SETUP, "--out", out)
    assert code == 2
    assert "results: No space left on device" in stderr
    assert "the 2 previous frames are complete" in stderr
    assert [row["frame"] for row in table(out / "measures.csv")] == ["0", "1"]
    assert json.loads((out / "run.json").read_text())["state"] == "failed"


SLOW = """
    import signal, sys, time
    from labapp.cli import main
    from labapp.core.images.dots import Dots
    from labapp.core.pipeline import Measurement
    from labapp.run import measurers
    import numpy as np

    def slow(*given):
        time.sleep(0.05)
        return Measurement("no-rows", "for the test", "fit", dots=Dots(*np.ones((7, 5)))), None

    measurers.measure = slow
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    main(sys.argv[1:])
"""


def test_measures_are_streamed_while_measuring(tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ["reconstruct", SAMPLE / "recording.avi", "--setup", SETUP, "--out", out]
    process = subprocess.Popen(
        [sys.executable, "-m", "labapp", *arguments, "--frames", "0:2", "--lines", "0"],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    port = int(process.stderr.readline().rpartition(":")[2])
    with connect(port) as connection:
        lines = [json.loads(line) for line in connection.makefile("rb")][1:]
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, stderr
    assert [line["frame"] for line in lines] == [0, 1]
    for line, row in zip(lines, table(out / "measures.csv"), strict=True):
        assert line["status"] == row["status"] == "ok"
        for name in ("height_mm", "width_mm", "height_sigma_mm", "are_mm"):
            assert line[name] == pytest.approx(float(row[name]), abs=1e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--lines", "0.0.0.0:0"), "other machines"),
        (("--opcua", "port"), "PORT or HOST:PORT"),
    ],
)
def test_invalid_stream_address_is_rejected(
    labapp: Run, tmp_path: Path, options: tuple[str, str], message: str
) -> None:
    source = ("reconstruct", SAMPLE / "recording.avi", "--setup", SETUP, "--out", tmp_path / "out")
    code, _, stderr = labapp(*source, *options)
    assert code == 2
    assert message in " ".join(stderr.split())
    assert not (tmp_path / "out").exists()


LOSES_AN_INTERRUPT = """
import ctypes, signal, sys, time
from labapp import cli

def lose(*_):
    ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(int(sys.argv[1])))()
    while True:
        time.sleep(0.01)

signal.signal(signal.SIGINT, signal.default_int_handler)
cli.asks_for_app = lose
cli.main([])
"""


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signal_in_a_compiler_callback_stops_the_program(sent: signal.Signals, code: int) -> None:
    """An exception in a callback from C is ignored by Python."""
    done = subprocess.run(
        [sys.executable, "-c", LOSES_AN_INTERRUPT, str(int(sent))],
        capture_output=True, text=True, check=False, timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode == code
    assert "Traceback" not in done.stderr


def run_code(code: str) -> subprocess.CompletedProcess[str]:
    """Run code in another Python."""
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True, text=True, check=False, timeout=PATIENCE_S,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip


INTERRUPTED_AT_THE_START = """
import runpy, signal, sys

class Pressed:
    def find_spec(self, name, *_):
        if name == "labapp.cli.shared":
            signal.raise_signal(signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Pressed())
runpy.run_module("labapp", run_name="__main__")
"""


def test_ctrl_c_while_the_commands_are_loaded_stops_the_program() -> None:
    done = run_code(INTERRUPTED_AT_THE_START)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


INTERRUPTED_AT_THE_END = """
import os, runpy, signal, sys

class Last:
    def __del__(self, kill=os.kill, own=os.getpid(), number=signal.SIGINT):
        kill(own, number)

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.last = Last()  # deleted when Python frees its modules
sys.argv = ["labapp", "--version"]
runpy.run_module("labapp", run_name="__main__")
"""


def test_ctrl_c_when_all_is_done_changes_nothing() -> None:
    done = run_code(INTERRUPTED_AT_THE_END)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("labapp ")


@pytest.mark.parametrize(("signal_number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_stopped_run_leaves_complete_frames(
    tmp_path: Path, signal_number: signal.Signals, code: int
) -> None:
    out = tmp_path / "out"
    recording = SAMPLE / "recording.avi"
    arguments = ["reconstruct", recording, "--setup", SETUP, "--out", out]
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(SLOW), *map(str, arguments)],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    measures = out / "measures.csv"
    wait_until(lambda: measures.exists() and len(table(measures)) >= 3)
    process.send_signal(signal_number)
    _, stderr = process.communicate(timeout=PATIENCE_S)
    rows = table(measures)
    assert process.returncode == code
    assert 3 <= len(rows) < 30
    assert f"stopped: {len(rows)} of 30 frames are done, in {out}" in stderr.splitlines()
    assert ("SIGTERM" in stderr) == (signal_number == signal.SIGTERM)
    assert "Traceback" not in stderr
    assert len(table(out / "dots.csv")) == 5 * len(rows)
    summary = json.loads((out / "run.json").read_text())
    assert (summary["state"], summary["frames_done"]) == ("interrupted", len(rows))
    assert not list(out.glob(".*"))


def test_repeated_ctrl_c_does_not_interrupt_the_cleanup(tmp_path: Path) -> None:
    """The first one starts the removal of a half-written frame, which the others do not stop."""
    program = """
        import os, signal, sys
        from labapp import cli
        from labapp.run import measurers

        def pressed(*given):
            try:
                os.kill(os.getpid(), signal.SIGINT)
            finally:
                os.kill(os.getpid(), signal.SIGINT)
                print("tidied up", flush=True)

        measurers.measure = pressed
        signal.signal(signal.SIGINT, signal.default_int_handler)
        cli.main(sys.argv[1:])
    """
    out = tmp_path / "out"
    arguments = ["reconstruct", SAMPLE / "calibration.png", "--setup", SETUP, "--out", out]
    process = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program), *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert (process.returncode, process.stdout) == (130, "tidied up\n")
    assert json.loads((out / "run.json").read_text())["state"] == "interrupted"


def test_ctrl_c_while_modules_load_is_no_internal_error(
    labapp: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A compiled module turns the interrupt into an ImportError."""

    def loading(*_: object) -> Measurement:
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)
        except KeyboardInterrupt:
            raise ImportError("initialization failed") from None
        return failed_measurement()

    monkeypatch.setattr(measurers, "measure", loading)
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        code, _, stderr = labapp("reconstruct", folder, "--setup", SETUP, "--out", tmp_path / "o")
    finally:
        signal.signal(signal.SIGINT, former)
    assert (code, stderr) == (130, "")


def test_name_that_is_too_long_is_no_internal_error(labapp: Run, tmp_path: Path) -> None:
    code, _, stderr = labapp("detect", SAMPLE / "calibration.png", "--out", tmp_path / ("x" * 400))
    assert code == 2
    assert "a shorter name" in stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_full_disk_of_stdout_is_no_internal_error(tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        arguments = ["detect", SAMPLE / "calibration.png", "--out", tmp_path / "dots.csv"]
        process = subprocess.run(
            [sys.executable, "-m", "labapp", *arguments],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert process.returncode == 2
    assert process.stderr.splitlines()[-1].startswith("labapp: output: file: No space left")


def test_internal_error_is_reported_without_a_traceback(
    labapp: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> Measurement:
        raise ZeroDivisionError("by nothing")

    monkeypatch.setattr(measurers, "measure", broken)
    code, _, stderr = labapp("reconstruct", folder, "--setup", SETUP, "--out", tmp_path / "o")
    assert code == 3
    assert "a fault in the program: ZeroDivisionError: by nothing" in stderr
    assert "Traceback" not in stderr
    assert "Traceback" in log.log_file().read_text()


def test_crash_of_a_library_is_reported_beside_the_log(state: Path) -> None:
    script = "import faulthandler\nfrom labapp.log import crash_file, report_crashes\n"
    script += "print(crash_file(), flush=True)\nreport_crashes()\nfaulthandler._sigsegv()\n"
    without = {key: value for key, value in os.environ.items() if key != "PYTHONFAULTHANDLER"}
    done = subprocess.run(
        [sys.executable, "-c", script], env=without, capture_output=True, text=True, check=False
    )
    report = Path(done.stdout.strip())
    assert done.returncode != 0
    assert report.is_relative_to(state)
    assert "Current thread" in report.read_text("utf-8")


def test_unwritable_log_does_not_stop_a_command(
    labapp: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    code, _, stderr = labapp("detect", tmp_path / "missing.png", "--out", tmp_path / "d.csv")
    assert code == 2
    assert stderr.count("\n") == 1


def test_samples_are_copied_without_replacing_anything(labapp: Run, tmp_path: Path) -> None:
    folder = tmp_path / "new"
    assert labapp("samples", folder)[0] == 0
    assert (folder / "sample_sessions/gtaw/recording.avi").stat().st_size > 10_000
    assert (folder / "resources/simulations/egg.toml").exists()
    assert not list(folder.rglob(".*"))
    assert labapp("samples", folder)[0] == 2


def test_samples_reject_a_folder_that_cannot_be_written(labapp: Run, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    code, _, stderr = labapp("samples", tmp_path / "file" / "new")
    assert code == 2
    assert "expected one that can be written" in stderr


def test_samples_report_the_first_file_that_cannot_be_copied(
    labapp: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise shutil.Error([("a", "b", "no space left"), ("c", "d", "no space either")])

    monkeypatch.setattr(shutil, "copytree", fail)
    code, _, stderr = labapp("samples", tmp_path / "new")
    assert code == 2
    assert stderr.count("\n") == 1
    assert "no space left; expected" in stderr
    assert "either" not in stderr


def test_demo_measures_the_sample_recording(
    labapp: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    measured_images: list[np.ndarray],
) -> None:
    monkeypatch.chdir(tmp_path)
    code, stdout, stderr = labapp("demo")
    assert code == 1  # the replaced measurement finds nothing
    assert len(measured_images) == 30 == stderr.count("no-dots")
    assert f"Results are in {tmp_path / 'demo_results' / 'results'}" in stdout
    assert len(table(tmp_path / "demo_results" / "results" / "measures.csv")) == 30
    assert (tmp_path / "demo_results" / "results" / "report.pdf").stat().st_size > 10_000
    code, stdout, _ = labapp("session", "info", tmp_path / "demo_results" / "gtaw.labsession")
    assert code == 0
    assert "30" in stdout


# --- detect, calibrate ------------------------------------------------------------------------


def test_detect_writes_its_columns(labapp: Run, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "dots.csv"
    code, stdout, _ = labapp("detect", SAMPLE / "recording.avi", "--out", out)
    rows = table(out)
    assert code == 0
    assert ",".join(rows[0]) == (
        "u_px,v_px,reflected_row,reflected_column,snr,u_sigma_px,v_sigma_px"
    )
    truth = [row for row in table(SAMPLE / "dots_truth.csv") if row["frame"] == "0"]
    assert len(rows) == pytest.approx(sum(row["visible"] == "1" for row in truth), abs=5)
    assert stdout.startswith(f"{len(rows)} dots, ")


def test_detect_does_not_write_through_a_link_to_another_kind(labapp: Run, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "dots.csv").symlink_to("notes.txt")
    code, _, stderr = labapp("detect", SAMPLE / "recording.avi", "--out", tmp_path / "dots.csv")
    assert code == 2
    assert "dots.csv: --out" in stderr
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("options", [("--detector", "block-threshold"), ("--rows", "rows")])
def test_detect_with_the_methods_of_the_dissertation(
    labapp: Run, tmp_path: Path, options: tuple[str, str]
) -> None:
    tables = {}
    for name, arguments in (("usual", ()), ("text", options)):
        out = tmp_path / f"{name}.csv"
        # The default search finds no rows among the dots of the dissertation's detector.
        assert labapp("detect", SAMPLE / "recording.avi", "--out", out, *arguments)[0] in {0, 1}
        tables[name] = table(out)
    assert tables["text"] != tables["usual"]
    assert len(tables["text"]) > 40


def test_detect_rejects_a_size_for_a_detector_without_one(labapp: Run, tmp_path: Path) -> None:
    options = ("--size", "2", "--detector", "wavelet")
    code, _, stderr = labapp(
        "detect", SAMPLE / "recording.avi", "--out", tmp_path / "dots.csv", *options
    )
    assert code == 2
    assert "--size" in stderr


@pytest.mark.parametrize("name", ["frame.png", "run.labsession", "setup.toml", "mine"])
def test_detect_does_not_overwrite_other_files(labapp: Run, tmp_path: Path, name: str) -> None:
    image = tmp_path / "frame.png"
    cv2.imwrite(str(image), np.full((40, 40), 90, np.uint8))
    target = tmp_path / name
    if target != image:
        target.write_text("mine")
    before = target.read_bytes()
    code, _, stderr = labapp("detect", image, "--out", tmp_path / "." / name)
    assert code == 2
    assert f"{name}: --out: " in stderr
    assert target.read_bytes() == before


def test_image_with_the_suffix_of_a_table_is_not_overwritten(labapp: Run, tmp_path: Path) -> None:
    image = tmp_path / "frame.csv"
    image.write_bytes(cv2.imencode(".png", np.full((40, 40), 90, np.uint8))[1].tobytes())
    before = image.read_bytes()
    code, _, stderr = labapp("detect", image, "--out", image)
    assert (code, image.read_bytes()) == (2, before)
    assert "--out: " in stderr


@pytest.mark.parametrize(
    ("command", "option"),
    [
        ("penetration simulate --out run.labsession", "--out"),
        ("penetration table study.toml sections.csv --out sections.csv", "--out"),
        ("penetration fit sections.csv --out sections.csv", "--out"),
        ("penetration fit sections.csv --out new.json --left-out sections.csv", "--left-out"),
        ("penetration predict model.json sections.csv --out sections.csv", "--out"),
        ("penetration onnx model.json --out model.json", "--out"),
        (f"calibrate bench a.png --mirror plate:0 --setup {SETUP} --out a.png", "--out"),
        (
            f"calibrate pattern a.png b.png --height 0 --height 1 --setup {SETUP} --out a.png",
            "--out",
        ),
    ],
)
def test_other_files_are_not_overwritten_with_results(
    labapp: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, option: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("run.labsession", "study.toml", "sections.csv", "model.json", "a.png"):
        (tmp_path / name).write_text("mine")
    code, _, stderr = labapp(*command.split())
    assert code == 2
    assert f": {option}: is " in stderr
    files = [path for path in tmp_path.iterdir() if path.is_file()]
    assert [path.read_text() for path in files] == ["mine"] * 5


def test_algorithm_without_irs_is_rejected(labapp: Run, folder: Path, tmp_path: Path) -> None:
    code, _, stderr = labapp(
        "reconstruct", folder, "--setup", SETUP, "--out", tmp_path / "o", "--algorithm", "epa-r"
    )
    assert code == 2
    assert "--algorithm: algorithm: epa-r; expected scheme irs" in stderr


def test_detect_reports_an_image_without_dots(labapp: Run, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "flat.png"), np.full((60, 80), 9, np.uint8))
    code, stdout, _ = labapp("detect", tmp_path / "flat.png", "--out", tmp_path / "d.csv")
    assert code == 1
    assert stdout.startswith("0 dots")
    assert table(tmp_path / "d.csv") == []


@pytest.fixture
def two_sizes(tmp_path: Path) -> Path:
    """An image of 40 dots of 5 px, each with a spot of 1 px in its centre."""
    v, u = np.mgrid[:240, :380]
    frame = np.random.default_rng(1).normal(20, 1, u.shape)
    for at_v, at_u in np.ndindex(5, 8):
        square = (u - 37 - 44 * at_u) ** 2 + (v - 33 - 44 * at_v) ** 2
        frame += 80 * np.exp(-square / 50) + 120 * np.exp(-square / 2)
    path = tmp_path / "two_sizes.png"
    cv2.imwrite(str(path), np.clip(frame, 0, 255).astype(np.uint8))
    return path


def test_detect_uses_the_given_size(labapp: Run, tmp_path: Path, two_sizes: Path) -> None:
    peaks = {}
    for size in ("1.2", "5"):
        out = tmp_path / "dots.csv"
        code, stdout, stderr = labapp("detect", two_sizes, "--size", size, "--out", out)
        assert (code, stderr) == (0, "")
        assert stdout.startswith("40 dots, 40 with")
        peaks[size] = np.median([float(row["snr"]) for row in table(out)])
    assert peaks["1.2"] != pytest.approx(peaks["5"], rel=0.1)


@pytest.mark.parametrize("size", ["0", "-2", "0.4", "21", "nan", "inf", "large"])
def test_detect_rejects_an_impossible_size(
    labapp: Run, tmp_path: Path, two_sizes: Path, size: str
) -> None:
    out = tmp_path / "dots.csv"
    code, _, stderr = labapp("detect", two_sizes, "--size", size, "--out", out)
    assert code == 2
    assert "--size" in stderr
    assert size in stderr
    assert not out.exists()


def test_detect_reports_dots_without_rows(labapp: Run, tmp_path: Path) -> None:
    v, u = np.mgrid[:120, :160]
    frame = np.random.default_rng(2).normal(20, 1, u.shape)
    for at in np.random.default_rng(3).uniform(15, 105, (5, 2)):
        frame += 90 * np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / 8)
    cv2.imwrite(str(tmp_path / "few.png"), np.clip(frame, 0, 255).astype(np.uint8))
    code, stdout, stderr = labapp("detect", tmp_path / "few.png", "--out", tmp_path / "d.csv")
    assert code == 1
    assert "too-few-dots" in stderr
    assert ", none with a row and a column" in stdout
    assert len(table(tmp_path / "d.csv")) == 5


def test_calibrate_laser_prints_and_writes_its_values(labapp: Run, tmp_path: Path) -> None:
    """A laser 90 mm away at 30° with a 10° fan gives l₂ = 18.561 and l₃ = 7.874 mm."""
    setup = tmp_path / "new.toml"
    lengths = "--l1 13.675 --l1 13.675 --l2 18.561 --l2 18.561 --l3 7.874 --l3 7.874".split()
    code, stdout, stderr = labapp("calibrate", "laser", *lengths, "--setup", setup)
    assert code == 0, stderr
    printed = [float(number) for number in re.findall(r"([\d.]+) ±", stdout)]
    assert printed == pytest.approx([30, 90, 45], abs=0.01)
    written = tomllib.loads(setup.read_text())
    laser = written.pop("laser")
    assert not written
    assert (laser["projection_angle_deg"], laser["distance_mm"]) == pytest.approx(
        (30, 90), abs=0.01
    )
    printed_sigmas = [float(number) for number in re.findall(r"± ([\d.]+)", stdout)][:2]
    sigmas = [laser["projection_angle_deg_sigma"], laser["distance_mm_sigma"]]
    assert sigmas == pytest.approx(printed_sigmas, abs=1e-3)
    correlation = laser["angle_distance_correlation"]
    assert f"correlation      {correlation:+.2f}" in stdout
    assert f"{setup}: pattern: missing" in stderr


@pytest.mark.parametrize(
    "lengths",
    [
        "--l1 18.54 --l2 18.54 --l3 18.54",  # 90°
        "--l1 0.01366 --l2 0.01854 --l3 0.00786",  # in m: ± 369°
        "--l1 13660 --l2 18540 --l3 7860",
    ],
)
def test_impossible_laser_is_not_written_into_the_setup(
    labapp: Run, tmp_path: Path, lengths: str
) -> None:
    setup = tmp_path / "setup.toml"
    setup.write_bytes(SETUP.read_bytes())
    assert labapp("calibrate", "laser", *lengths.split(), "--setup", setup)[0] == 2
    assert setup.read_bytes() == SETUP.read_bytes()


def test_frames_of_another_size_leave_earlier_results(labapp: Run, tmp_path: Path) -> None:
    out, setup = tmp_path / "out", tmp_path / "setup.toml"
    setup.write_bytes(SETUP.read_bytes())
    command = ["reconstruct", SAMPLE / "calibration.png", "--setup", setup, "--out", out]
    labapp(*command)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    text = setup.read_text("utf-8")
    setup.write_text(text.replace("[image_calibration]", "[image_calibration]\nframe_px = [9, 9]"))
    code, _, stderr = labapp(*command)
    assert code == 2
    assert "calibration.png: size" in stderr
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_setup_is_calibrated_after_both_calibrations(labapp: Run, tmp_path: Path) -> None:
    from labapp.config.setup import read_setup

    setup = tmp_path / "setup.toml"
    setup.write_bytes(SETUP.read_bytes())
    lengths = "--l1 4.64 --l1 4.68 --l2 6.26 --l2 6.21 --l3 2.75 --l3 2.78".split()
    options = ["--fan-angle-sigma", 0.05, "--resolution", 0.01, "--setup", setup]
    assert labapp("calibrate", "laser", *lengths, *options)[0] == 0
    assert read_setup(setup).rig.uncertainty.status == "entered"
    picture = SAMPLE / "calibration.png"
    assert labapp("calibrate", "plane", picture, "--unit-mm", 6.35, "--setup", setup)[0] == 0
    assert read_setup(setup).rig.uncertainty.status == "calibrated"


@pytest.mark.parametrize("l1", ["nan", "-1", "3", "x"])
def test_impossible_lengths_are_rejected(labapp: Run, l1: str) -> None:
    code, _, stderr = labapp(*f"calibrate laser --l1 {l1} --l2 18.561 --l3 7.874".split())
    assert code == 2
    assert "Traceback" not in stderr


def test_calibrate_plane_writes_its_values_to_the_setup(labapp: Run, tmp_path: Path) -> None:
    setup = tmp_path / "setup.toml"
    setup.write_text(SETUP.read_text())
    picture = SAMPLE / "calibration.png"
    code, stdout, stderr = labapp(
        "calibrate", "plane", picture, "--unit-mm", 6.35, "--setup", setup
    )
    assert (code, stderr) == (0, "")
    assert stdout.count("±") == 6
    assert "mm off (95 %)" in stdout  # the bound far from the marks
    assert "used       affine, 15 marks. No perspective" in stdout
    assert stdout.count("residual 0.0") == 2
    assert "6.35 mm between flags" in stdout
    assert "scale      5.67" in stdout
    from labapp.config.setup import read_setup

    corners = np.array([[0.0, 0.0], [480, 0], [0, 640], [480, 640]])
    corners_mm = read_setup(setup).calibration.to_plane(corners)
    np.testing.assert_allclose(
        corners_mm, read_setup(SETUP).calibration.to_plane(corners), atol=0.15
    )
    assert setup.read_text().startswith(SETUP.read_text().split("[image_calibration]")[0])
    other = tmp_path / "other.png"
    cv2.imwrite(str(other), np.zeros((240, 320), np.uint8))
    code, _, complained = labapp(
        "reconstruct", other, "--setup", setup, "--out", tmp_path / "results"
    )
    assert code == 2
    assert "320×240" in complained
    assert "480×640" in complained


def test_calibrate_plane_assumes_the_target_of_labapp(labapp: Run, tmp_path: Path) -> None:
    setup = tmp_path / "setup.toml"
    setup.write_text(SETUP.read_text())
    code, stdout, _ = labapp("calibrate", "plane", SAMPLE / "calibration.png", "--setup", setup)
    assert code == 0
    assert "6.35 mm between flags" in stdout
    written = tomllib.loads(setup.read_text())["image_calibration"]
    for name in ("origin_px", "x_axis_px", "z_axis_px"):
        (line,) = (line for line in stdout.splitlines() if line.startswith(name))
        u, v = written[name]
        assert f"{u:.3f}, {v:.3f} ± {written[f'{name}_sigma']:.3f} px" in line
    assert f"x_axis_mm  {written['x_axis_mm']:.4f} mm" in stdout


def test_calibrate_plane_uses_the_lens_of_a_setup_with_a_byte_order_mark(
    labapp: Run, tmp_path: Path
) -> None:
    lens = "[camera_lens]\nfocal_px = [900, 900]\ncenter_px = [240, 320]\n"
    lens += "distortion = [-0.3, 0, 0, 0, 0]\n"
    found = []
    for start, more in (("", ""), ("", lens), ("\ufeff", lens)):
        setup = tmp_path / "setup.toml"
        setup.write_text(f"{start}{SETUP.read_text('utf-8')}{more}", "utf-8")
        code, stdout, stderr = labapp(
            "calibrate", "plane", SAMPLE / "calibration.png", "--setup", setup
        )
        assert code == 0, stderr
        found.append(stdout)
    without_lens, with_lens, with_mark = found
    assert with_mark == with_lens != without_lens


@pytest.mark.parametrize(
    ("keys", "key"),
    [
        ("focal_px = [900, 900]\ncenter_px = [240, 320]", "distortion: missing"),
        ("distortion = [-0.3, 0, 0, 0, 0]", "center_px: missing"),
        (
            "focal_px = [900, -900]\ncenter_px = [240, 320]\ndistortion = [0, 0, 0, 0, 0]",
            "focal_px: [900, -900]",
        ),
        ("focal_pixel = [900, 900]", "focal_pixel: unknown key"),
    ],
)
def test_calibrate_plane_rejects_an_incomplete_lens(
    labapp: Run, tmp_path: Path, keys: str, key: str
) -> None:
    setup = tmp_path / "setup.toml"
    before = f"{SETUP.read_text('utf-8')}[camera_lens]\n{keys}\n"
    setup.write_text(before, "utf-8")
    code, _, stderr = labapp("calibrate", "plane", SAMPLE / "calibration.png", "--setup", setup)
    assert code == 2
    assert f"{setup}: camera_lens.{key}" in stderr
    assert setup.read_text("utf-8") == before


def test_calibrate_plane_accepts_uncertainties_without_a_lens(labapp: Run, tmp_path: Path) -> None:
    setup = tmp_path / "setup.toml"
    keys = "[camera_lens]\ndistortion_percent_sigma = 0.2\n"
    setup.write_text(SETUP.read_text("utf-8") + keys, "utf-8")
    code, _, stderr = labapp("calibrate", "plane", SAMPLE / "calibration.png", "--setup", setup)
    assert code == 0, stderr


@pytest.mark.parametrize(
    ("start", "problem"),
    [
        ("# 30° to the work piece\n".encode("latin-1"), "encoding: not UTF-8"),
        (b"a = " + 5000 * b"9" + b"\n", "syntax: "),
    ],
)
def test_calibrate_plane_rejects_a_setup_that_is_not_text_or_not_toml(
    labapp: Run, tmp_path: Path, start: bytes, problem: str
) -> None:
    setup = tmp_path / "setup.toml"
    setup.write_bytes(start + SETUP.read_bytes())
    code, _, stderr = labapp("calibrate", "plane", SAMPLE / "calibration.png", "--setup", setup)
    assert code == 2
    assert problem in stderr


@pytest.mark.parametrize("unit", ["0", "-1", "nan", "inf"])
def test_impossible_unit_is_rejected(labapp: Run, unit: str) -> None:
    code, _, stderr = labapp("calibrate", "plane", SAMPLE / "calibration.png", "--unit-mm", unit)
    assert code == 2
    assert "--unit-mm" in stderr


def test_picture_without_a_target_is_reported(labapp: Run, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "flat.png"), np.full((200, 200), 90, np.uint8))
    code, _, stderr = labapp("calibrate", "plane", tmp_path / "flat.png")
    assert code == 1
    assert "flat.png: no-target: " in stderr


def board_picture(path: Path, name: str) -> Path:
    """Write the picture of a board through a lens with a distortion of 1 %."""
    from labapp.core.calibration.boards import BOARDS
    from labapp.simulation.calibration.target import TargetLook, render_target
    from labapp.simulation.camera import Lens
    from tests.inked_board import InkedBoard
    from tests.posed_view import PosedView

    lens = Lens(1000.0, k1=-0.06)
    view = PosedView.at((40.0, 36.0), 5.0, turned_deg=(1.0, -2.0, 1.3), lens=lens)
    rng = np.random.default_rng(1)
    cv2.imwrite(str(path), render_target(InkedBoard(BOARDS[name]), view, TargetLook(), rng))
    return path


def test_board_calibrates_lens_and_plane_of_a_setup(labapp: Run, tmp_path: Path) -> None:
    setup = tmp_path / "setup.toml"
    setup.write_text(SETUP.read_text())
    picture = board_picture(tmp_path / "board.png", "charuco_4_inch")
    code, stdout, stderr = labapp("calibrate", "plane", picture, "--setup", setup)
    assert (code, stderr) == (0, "")
    assert "charuco_4_inch" in stdout
    from labapp.config.setup import read_setup
    from labapp.config.setup_text import lens_of

    calibrated = read_setup(setup)
    assert calibrated.calibration.lens == lens_of(setup.read_text())
    assert calibrated.calibration.lens is not None
    assert calibrated.calibration.lens.distortion[0] < 0
    assert calibrated.rig.uncertainty is not None
    assert "camera_lens.distortion_percent" not in calibrated.rig.uncertainty.assumed


@pytest.mark.parametrize(
    ("board", "field"), [("charuco_letter_a4", "board"), ("charuco:2x2:8", "board")]
)
def test_wrong_board_is_rejected(labapp: Run, tmp_path: Path, board: str, field: str) -> None:
    picture = board_picture(tmp_path / "board.png", "charuco_4_inch")
    code, _, stderr = labapp("calibrate", "plane", picture, "--board", board)
    assert code == 2
    assert f"{field}: " in stderr


@pytest.mark.parametrize("option", ["--unit-mm", "--square-mm"])
def test_length_of_another_target_is_rejected(labapp: Run, tmp_path: Path, option: str) -> None:
    board = board_picture(tmp_path / "board.png", "charuco_4_inch")
    picture = board if option == "--unit-mm" else SAMPLE / "calibration.png"
    setup = tmp_path / "setup.toml"
    code, stdout, stderr = labapp("calibrate", "plane", picture, option, 8.05, "--setup", setup)
    assert (code, stdout, setup.exists()) == (2, "", False)
    assert f"{option}: length: 8.05; " in stderr


# --- help -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "command", ["", "reconstruct", "detect", "calibrate laser", "calibrate plane", "demo"]
)
def test_help_states_units(labapp: Run, command: str) -> None:
    code, stdout, _ = labapp(*command.split(), "--help")
    assert code == 0
    if command not in ("demo", ""):
        assert "mm" in stdout or "px" in stdout


@pytest.mark.parametrize("command", ["", "session", "analyze", "calibrate"])
def test_help_does_not_truncate_command_summaries(labapp: Run, command: str) -> None:
    _, stdout, _ = labapp(*command.split(), "--help")
    listed = stdout.partition("Commands:")[2]
    assert listed
    assert "..." not in listed


def test_help_names_arguments_and_kinds_of_values() -> None:
    commands, count = [("labapp", get_command(app))], 0
    for name, one in commands:
        context = one.context_class(one, info_name=name)
        commands += [(f"{name} {sub}", of) for sub, of in getattr(one, "commands", {}).items()]
        for parameter in one.params:
            first, about = parameter.get_help_record(context)
            assert about, (name, first)
            assert not re.search(r"[<>{}]|list\[| range", first), (name, first)
            if isinstance(parameter, typer.core.TyperArgument):
                (piece,) = parameter.get_usage_pieces(context)
                assert re.fullmatch(r"\[?[A-Z]+(\.toml)?(\.\.\.)?\]?", piece), (name, piece)
            count += 1
    assert count > 150


def test_version_is_printed(labapp: Run) -> None:
    code, stdout, _ = labapp("--version")
    assert (code, stdout) == (0, "labapp 1.0.0\n")


@pytest.mark.parametrize(
    ("start", "heavy"),
    [
        (
            "import labapp.cli",
            {"numpy", "scipy", "cv2", "rich", "pyvista", "matplotlib"}
            | {"filelock", "importlib.metadata", "labapp.cli.session"},
        ),
        (
            "from labapp import Session",
            {"scipy", "cv2", "av", "numba", "h5py", "matplotlib", "labapp.core.pipeline"},
        ),
        (
            "import labapp.session.frames, labapp.session.results.measured",
            {"scipy.linalg", "scipy.spatial", "scipy.special", "av", "numba", "h5py", "matplotlib"},
        ),
    ],
)
def test_heavy_modules_are_imported_only_when_needed(start: str, heavy: set[str]) -> None:
    """Help and scripts must start quickly."""
    loaded = subprocess.run(
        [sys.executable, "-c", f"{start}; import sys; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    ).stdout.split()
    assert not heavy & set(loaded)
