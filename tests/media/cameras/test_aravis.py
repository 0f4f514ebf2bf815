"""GenICam cameras, with the fake GigE Vision camera of Aravis on the loopback interface."""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from filelock import FileLock

from labapp.errors import InputError
from labapp.media import open_source
from labapp.media.cameras import (
    CameraError,
    CameraFrame,
    CameraLost,
    CameraSettings,
    Feed,
    aravis,
    find_cameras,
    genicam,
    open_camera,
)
from labapp.media.recording.recorder import Plan, Recorder
from tests.conftest import skip_or_fail
from tests.media.cameras.watching import Events
from tests.waiting import wait_until

FAKE = Path(__file__).with_name("fake_gige.py")
ID = "aravis:Aravis-Fake-LAB1"

Plug = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def plug() -> Iterator[Plug]:
    """Start fake cameras, which are killed at the end.

    A machine has only one address for it, so tests in other processes wait.
    """
    try:
        ctypes.CDLL(genicam.LIBRARY)
    except OSError:
        skip_or_fail(f"{genicam.LIBRARY} is not installed")
    running: list[subprocess.Popen[str]] = []

    def start(lost: float = 0.0) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, FAKE, "127.0.0.1", "LAB1", str(lost)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        running.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "running\n"
        return process

    with FileLock(Path(tempfile.gettempdir(), "labapp_fake_gige.lock")):
        yield start
        for process in running:
            process.kill()
            process.communicate()


def test_camera_is_found_recorded_killed_and_reconnected(plug: Plug, tmp_path: Path) -> None:
    fake = plug()
    cameras, problems = find_cameras()
    assert not problems
    assert [(info.name, info.kind) for info in cameras if info.id == ID] == [
        ("Aravis Fake", "GigE Vision")
    ]
    events = Events()
    frames: list[CameraFrame] = []
    settings_to_apply = CameraSettings(region=(0, 0, 128, 96), rate_hz=100, exposure_us=2000)
    with (
        Recorder(lambda: tmp_path / "run.nut", Plan(), 8, 100, events.append) as recorder,
        Feed(
            ID, lambda: open_camera(ID), recorder.take, events.append, settings_to_apply
        ) as running,
    ):
        take = recorder.trigger()
        earlier = running.counts.frames
        wait_until(lambda: running.counts.frames >= earlier + 50)
        fake.kill()
        wait_until(lambda: running.state == "lost")
        before = running.counts.frames
        plug()
        wait_until(lambda: running.counts.frames >= before + 50)
        frames.append(running.camera.read(1.0) or pytest.fail("no frame"))
        settings = running.camera.settings
    assert frames[0].image.shape == (96, 128)
    assert (settings.region, settings.rate_hz) == ((0, 0, 128, 96), 100)
    assert running.counts.lost == 1
    reported = events.words()
    assert "does not answer any more. Trying to get it back" in reported
    assert "it is back after" in reported
    # The frames before and after are in one recording, with the gap in time.
    assert (take.trouble, take.lost) == ("", 0)
    with open_source(take.path) as video:
        assert len(video) == take.frames >= before - earlier + 50
        times_s = [frame.time_s for frame in video if frame.time_s is not None]
        assert video.frame(0).image.std() > 0
    steps_s = np.diff(times_s)
    assert (steps_s > 0).all()
    assert np.median(steps_s) == pytest.approx(0.01, rel=0.1)
    assert steps_s.max() > 1


def test_frame_with_missing_packets_is_discarded_and_counted(plug: Plug) -> None:
    plug(0.03)
    events = Events()
    frames: list[CameraFrame] = []
    settings = CameraSettings(region=(0, 0, 128, 96), rate_hz=100)
    with Feed(ID, lambda: open_camera(ID), frames.append, events.append, settings) as running:
        wait_until(lambda: running.counts.broken >= 10 and len(frames) >= 50)
    counts = running.counts
    assert (counts.frames, counts.lost) == (len(frames), 0)
    # The picture of the fake camera is a ramp modulo 255, which a missing packet interrupts.
    for frame in frames:
        for axis in (0, 1):
            assert set(np.unique(np.diff(frame.image.astype(int), axis=axis))) <= {1, -254}
    gaps = int((np.diff([frame.number for frame in frames]) - 1).sum())
    assert gaps <= counts.broken + counts.dropped
    assert "incomplete, discarded" in events.words()


def test_settings_are_read_back_or_rejected(plug: Plug) -> None:
    plug()
    with open_camera(ID) as camera:
        applied = camera.apply(
            CameraSettings(exposure_us=5000, gain_db=3, rate_hz=50, region=(16, 8, 256, 128))
        )
        assert applied == CameraSettings(
            exposure_us=5000, gain_db=3, rate_hz=50, region=(16, 8, 256, 128), trigger="free"
        )
        with pytest.raises(InputError, match=r"exposure_us: 1; expected from 10 to 1e\+07 \(µs\)"):
            camera.apply(CameraSettings(exposure_us=1))
        with pytest.raises(InputError, match="within 2048×2048 px"):
            camera.apply(CameraSettings(region=(2000, 0, 100, 100)))
        with pytest.raises(InputError, match=r"rate_hz: 1000000.0; expected from 0.1 to 1000 "):
            camera.apply(CameraSettings(exposure_us=900, region=(0, 0, 64, 64), rate_hz=1e6))
        assert camera.settings == applied
        # The camera has only the input Line0; it reports a missing input only in the mode that
        # waits for it.
        assert camera.limits.triggers == ("free", "software", "line")
        assert camera.apply(CameraSettings(trigger="line")).trigger == "line"
        assert camera.apply(CameraSettings(trigger="free")) == applied
        camera._line = b"Line1"
        with pytest.raises(CameraError, match="Line1"):
            camera.apply(
                CameraSettings(
                    exposure_us=900, gain_db=1, rate_hz=20, region=(0, 0, 64, 64), trigger="line"
                )
            )
        assert camera.settings == applied
        assert camera.apply(CameraSettings(trigger="software")).trigger == "software"
        with pytest.raises(CameraError, match="used by another program"):
            open_camera(ID)


def test_software_trigger_takes_a_frame(plug: Plug) -> None:
    plug()
    with open_camera(ID) as camera:
        camera.apply(CameraSettings(region=(0, 0, 64, 48), rate_hz=100, trigger="software"))
        camera.start()
        assert camera.read(0.2) is None
        for _ in range(3):
            camera.trigger()
            frame = camera.read(5.0)
            assert frame is not None
            assert frame.image.shape == (48, 64)
            assert camera.read(0.1) is None
        camera.stop()
        assert camera.apply(CameraSettings(trigger="free")).trigger == "free"
        camera.start()
        assert all(camera.read(5.0) for _ in range(3))


def test_feed_triggers_frames(plug: Plug) -> None:
    plug()
    frames: list[CameraFrame] = []
    settings = CameraSettings(region=(0, 0, 64, 48), trigger="software")
    with Feed(ID, lambda: open_camera(ID), frames.append, settings=settings) as feed:
        for count in range(1, 4):
            feed.trigger()
            wait_until(lambda count=count: len(frames) == count)
        assert feed.counts.dropped == 0


def test_missing_camera_is_reported(plug: Plug) -> None:
    with pytest.raises(CameraLost, match="aravis:Nobody-1 is not connected"):
        open_camera("aravis:Nobody-1")


def test_missing_aravis_is_reported_with_the_package_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(genicam, "LIBRARY", "libaravis-of-no-system.so.9")
    monkeypatch.setattr(aravis, "aravis", genicam.Aravis)
    _, problems = find_cameras()
    assert [problem.partition(":")[2] for problem in problems] == [
        " sudo apt install --no-install-recommends libaravis-0.8-0"
    ]


def test_frame_numbers_continue_after_16_bit_overflow() -> None:
    stream = aravis._Stream(0)
    ids = [65533, 65534, 65535, 1, 2, 4, 65535, 1]
    numbers = [stream.number(id) - 65533 for id in ids]
    assert numbers == [0, 1, 2, 3, 4, 6, 65537, 65538]
