from __future__ import annotations

import csv
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from labapp.media import open_source
from labapp.media.cameras import (
    KINDS,
    CameraError,
    CameraInfo,
    CameraKind,
    CameraLost,
    SimulatedDevice,
)
from labapp.media.recording.take_files import Take
from labapp.session.session import Session
from labapp.simulated.cameras import simulated_device
from tests.conftest import INTERRUPTIBLE, Run
from tests.waiting import wait_until

ROOT = Path(__file__).resolve().parent.parent
SAMPLE = ROOT / "sample_sessions/gtaw/recording.avi"
CAMERA = f"simulated:{SAMPLE}"


def test_recording_contains_the_frames_of_the_camera(tmp_path: Path, labapp: Run) -> None:
    out = tmp_path / "run.nut"
    code, stdout, stderr = labapp("record", CAMERA, "--out", out, "--seconds", 0.5, "--rate", 60)
    assert (code, stderr.splitlines()[0]) == (0, "run.nut: recording")
    with open_source(out) as video, open_source(SAMPLE) as sample:
        assert stdout == f"{len(video)} frames in {out}\n"
        assert 10 < len(video) < 60
        # The sample is played from its first frame; the recorder starts a little later.
        first = next(
            k for k in range(20) if np.array_equal(sample.frame(k).image, video.frame(0).image)
        )
        for k in range(3):
            assert np.array_equal(video.frame(k).image, sample.frame(first + k).image)
        assert video.frame_rate_hz == 60
    with (tmp_path / "run-notes.csv").open(newline="") as file:
        assert next(csv.DictReader(file))["what"].startswith("trigger")


def test_recording_is_imported_into_a_session(tmp_path: Path, labapp: Run) -> None:
    Session.create(tmp_path / "a.labsession").close()
    code, stdout, _ = labapp(
        *("record", CAMERA, "--session", tmp_path / "a.labsession", "--seconds", "0.3"),
        *("--every", "2", "--codec", "ffv1", "--region", "0", "0", "64", "48"),
    )
    assert code == 0
    assert stdout.endswith(f"Imported into {tmp_path / 'a.labsession'}\n")
    with Session.open(tmp_path / "a.labsession", read_only=True) as session:
        recording = session.recording
        assert recording is not None
        assert (recording.columns, recording.rows) == (64, 48)
        assert recording.path.startswith("recording-")
        assert len(session.frames) == recording.frames > 0


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_recording_is_complete(tmp_path: Path, signal_number: signal.Signals) -> None:
    out = tmp_path / "run.nut"
    environment = os.environ | {"XDG_STATE_HOME": str(tmp_path)}
    command = [sys.executable, "-c", INTERRUPTIBLE, "record", CAMERA, "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        wait_until(lambda: out.exists() and out.stat().st_size >= 1_000_000)
        process.send_signal(signal_number)
        assert process.stdout is not None
        stdout = process.stdout.read()
    assert process.returncode == 0
    with open_source(out) as video:
        assert stdout.startswith(f"{len(video)} frames in ")
        assert not video.warnings


def test_unsuitable_session_is_rejected_before_recording(
    tmp_path: Path, labapp: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def film(*_: object) -> Take:
        pytest.fail("it was filmed")

    monkeypatch.setattr("labapp.cli.cameras._film", film)
    measured = shutil.copytree(SAMPLE.parent, tmp_path / "run") / "gtaw.labsession"
    in_use = tmp_path / "a.labsession"
    damaged = tmp_path / "b.labsession"
    damaged.write_bytes(b"no session")
    with Session.open(measured, read_only=True) as session:
        assert session.measured_by
    with Session.create(in_use):
        for path, expected in (
            (measured, "frames of recording.avi are measured or corrected in it"),
            (in_use, "another program"),
            (damaged, "b.labsession"),
        ):
            code, stdout, stderr = labapp("record", CAMERA, "--session", path, "--seconds", "0.1")
            assert (code, stdout) == (2, "")
            assert expected in stderr
    assert not list(tmp_path.rglob("*.nut"))


def test_impossible_recordings_are_rejected(tmp_path: Path, labapp: Run) -> None:
    out = tmp_path / "run.nut"
    (tmp_path / "there.nut").write_text("mine")
    for arguments, expected in (
        (("webcam", "--out", out), f"webcam: camera: webcam; expected {KINDS[0].form} or "),
        (("uvc:77", "--out", out), "uvc:77: camera: uvc:77 is not connected; expected a camera"),
        ((CAMERA,), "either --out or --session"),
        ((CAMERA, "--out", out, "--session", out), "either --out or --session"),
        ((CAMERA, "--session", tmp_path / "no.labsession"), "does not exist"),
        ((CAMERA, "--out", out.with_suffix(".avi")), "; expected a file that ends in .nut"),
        ((CAMERA, "--out", out, "--rate", "0"), "rate_hz: 0.0; expected from 0.1 to 10000"),
        ((CAMERA, "--out", out, "--exposure", "5"), "exposure_us: 5.0; expected nothing"),
        ((CAMERA, "--out", tmp_path / "there.nut"), "recording: is there already"),
        ((CAMERA, "--out", tmp_path / "no" / "a.nut"), "No such file or directory"),
        (("simulated:nothing.avi", "--out", out), "No such file or directory"),
    ):
        code, stdout, stderr = labapp("record", *arguments, "--seconds", "30")
        assert code == 2
        assert expected in stderr
        assert not stdout or stdout.startswith("0 frames")
    assert not list(tmp_path.glob("run*"))
    assert (tmp_path / "there.nut").read_text() == "mine"


def test_cameras_are_listed_with_their_settings(
    labapp: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = simulated_device(SAMPLE)
    busy = CameraInfo("uvc:3", "Webcam", "USB video")

    def open_camera(id: str):
        if id == busy.id:
            raise CameraLost("Webcam is used by another program: close that")
        return device.open()

    monkeypatch.setattr(
        "labapp.media.cameras.find_cameras", lambda: ([device.info, busy], ["No Aravis"])
    )
    monkeypatch.setattr("labapp.media.cameras.open_camera", open_camera)
    code, stdout, stderr = labapp("cameras")
    assert (code, stderr) == (0, "No Aravis\n")
    assert stdout.splitlines()[:6] == [
        f"{CAMERA}  simulated recording.avi (simulated)",
        "    picture   480×640 px, 8 bit, any region",
        "    exposure  cannot be set",
        "    gain      cannot be set",
        "    rate      0.1 to 10000 frames/s, now 60",
        "    trigger   free, software",
    ]
    assert "Webcam is used by another program" in stdout
    monkeypatch.setattr("labapp.media.cameras.find_cameras", lambda: ([], []))
    code, stdout, stderr = labapp("cameras")
    assert (code, stderr.partition(",")[0]) == (0, "No camera is connected")
    assert stdout.startswith("simulated:FILE")


def test_scenario_is_played_forwards_and_backwards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("labapp.simulated.cameras.FRAMES", 3)
    progress: list[tuple[int, int]] = []
    scenario = ROOT / "resources/simulations/cap.toml"
    device = simulated_device(scenario, lambda _, done, total: progress.append((done, total)))
    frames = [device.picture(k) for k in range(9)]
    assert progress[-1] == (3, 3)
    for k, same in ((3, 1), (4, 0), (5, 1), (8, 0)):
        assert np.array_equal(frames[k], frames[same])
    assert not np.array_equal(frames[0], frames[1])


def test_added_camera_kind_is_listed_and_recorded(
    tmp_path: Path, labapp: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    still = SimulatedDevice("still", lambda _: np.full((24, 32), 7, np.uint8))

    def absent() -> list[CameraInfo]:
        raise CameraError("No driver of Toys")

    kinds = [
        CameraKind("toy:NUMBER", absent, lambda _: still.open()),
        CameraKind(
            "still:NAME",
            lambda: [CameraInfo("still:1", "Still picture", "a toy")],
            lambda id: still.open(),
        ),
    ]
    monkeypatch.setattr("labapp.media.cameras.KINDS", kinds)
    code, stdout, stderr = labapp("cameras")
    assert (code, stderr) == (0, "No driver of Toys\n")
    assert stdout.splitlines()[:2] == [
        "still:1  Still picture (a toy)",
        "    picture   32×24 px, 8 bit, any region",
    ]
    out = tmp_path / "a.nut"
    code, stdout, _ = labapp("record", "still:1", "--out", out, "--seconds", 0.3)
    assert code == 0
    with open_source(out) as video:
        assert stdout.startswith(f"{len(video)} frame")
        assert (video.frame(0).image == 7).all()
    code, _, stderr = labapp("record", "uvc:0", "--out", tmp_path / "b.nut", "--seconds", 0.3)
    assert code == 2
    assert "expected toy:NUMBER or still:NAME, as labapp cameras lists them" in stderr


def test_every_camera_kind_is_documented() -> None:
    text = (ROOT / "docs/cameras.md").read_text("utf-8")
    assert all(f"| `{kind.prefix}" in text for kind in KINDS)
