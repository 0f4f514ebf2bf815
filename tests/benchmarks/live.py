"""Long runs of the live camera: filming, measuring and recording, with and without faults.

Run as ``xvfb-run -a -s "-screen 0 1366x768x24" python tests/benchmarks/live.py [MINUTES]
[FRAMES_A_SECOND] [plain] [faults] [FOLDER]``: 1 minute, 200 frames/s, both, a temporary folder. A
minute of 480×640 px at 200 frames/s takes 3.7 GB there.

The simulated camera films a pool, with the number of each frame in it. The frames delivered, and
their times, are recorded when they are read, and are the truth for the counts of the window and of
the recording, for the window's messages, and for the file, every frame of which is compared. Each
figure is printed with the load of the machine.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("LIBGL_ALWAYS_SOFTWARE", "1")

import contextlib
import csv
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from filming import (
    Agenda,
    Disk,
    FilmedDevice,
    compare,
    how_many,
    moments,
    number_in,
    times_told,
)
from PySide6.QtCore import QEvent, QObject, Qt
from PySide6.QtWidgets import QApplication
from stall_meter import run_for, run_until

from labapp.gui.live import live as live_module
from labapp.gui.live import view as live_view
from labapp.gui.preferences import Preferences
from labapp.gui.shell.commands import make_window
from labapp.media.cameras import CameraFrame
from labapp.media.recording.nut import NutWriter
from labapp.media.recording.recorder import Recorder
from labapp.media.recording.take_files import Take
from labapp.run.live_measuring import LiveMeasuring
from labapp.session.samples import sample_folder
from labapp.session.session import Session
from tests.media.cameras.faulty import Faults

LEAST_UPDATES = 20.0
"""Least updates of the window per second, in every minute."""

FLAT = 1.03
"""Largest ratio of the memory in the last third of the time to that in the second third."""

STALL_S, STALLS = 5.0, 3
"""Duration and number of stalls of the disk."""

DISCONNECTS, GARBAGE, NOISE, SEED = 50, 0.0075, 0.0025, 4803
"""Garbage is truncated or of another size or type; noise is a complete frame without dots."""

PARTS = ("plain", "faults")


class Sample(NamedTuple):
    """Counts at one time; frames are counted from the beginning.

    Parameters
    ----------
    at_s
        `time.monotonic`.
    made, given, taken, written, lost
        Frames made by the camera, given to its reader, taken by the window's feed, written to the
        file, and lost by the recorder.
    waiting_mb
        Size of the frames waiting for the disk, or for a trigger.
    measured, good, cold
        Frames measured, those with a surface, and those measured without following.
    age_s
        Age of the frame of the newest figures.
    updates, longest_s
        Frames painted; the longest time between two since the previous sample.
    window_mb, measuring_mb
        Resident memory of the window's process, and of its child processes.
    busy_s
        Processor time of all processes.
    """

    at_s: float
    made: int
    given: int
    taken: int
    written: int
    lost: int
    waiting_mb: float
    measured: int
    good: int
    cold: int
    age_s: float
    updates: int
    longest_s: float
    window_mb: float
    measuring_mb: float
    busy_s: float


class MeasureCounts:
    """Counts the measured frames."""

    frames = good = cold = newest = 0
    noise: ClassVar[list[tuple[int, str]]] = []
    """Numbers of the measured frames of noise, and their statuses."""

    @classmethod
    def counted(
        cls, measure: Callable[..., Any], is_noise: Callable[[int], bool]
    ) -> Callable[..., Any]:
        """Return the function with counting."""

        def counting(measuring: LiveMeasuring, frame: CameraFrame, *given: Any) -> Any:
            result = measure(measuring, frame, *given)
            if result is None:  # the frame was skipped
                return result
            status = result.measurement.status
            cls.frames += 1
            cls.good += status == "ok"
            cls.cold += result.track_lost is not None
            cls.newest = number_in(frame.image)
            if is_noise(cls.newest):
                cls.noise.append((cls.newest, status))
            return result

        return counting


class PaintCounter(QObject):
    """Counts how often a picture is painted with another frame."""

    def __init__(self, view: Any, viewport: QObject) -> None:
        super().__init__(viewport)
        self.updates, self._shown, self._view = 0, 0, view
        self._longest_s, self._last_s = 0.0, time.monotonic()
        viewport.installEventFilter(self)

    def eventFilter(self, _: QObject, event: QEvent) -> bool:  # noqa: N802 - Qt calls it so
        if event.type() == QEvent.Type.Paint and self._view.updates != self._shown:
            self._shown, now_s = self._view.updates, time.monotonic()
            self._longest_s = max(self._longest_s, now_s - self._last_s)
            self._last_s = now_s
            self.updates += 1
        return False

    def longest_s(self) -> float:
        """Return the longest time between two updates since the last call."""
        longest_s = max(self._longest_s, time.monotonic() - self._last_s)
        self._longest_s = 0.0
        return longest_s


# --- resources of processes -------------------------------------------------------------------


def children() -> list[int]:
    """Return the ids of the child processes."""
    texts = [each.read_text() for each in Path("/proc/self/task").glob("*/children")]
    return [int(word) for words in texts for word in words.split()]


def resident_mb(process: int) -> float:
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    except OSError:  # it has ended
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def busy_s(process: int) -> float:
    try:
        words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def busy_threads() -> dict[str, float]:
    """Return the processor time of this process's threads by name, s."""
    names = {each.native_id: each.name for each in threading.enumerate()}
    times_s: dict[str, float] = {}
    for each in Path("/proc/self/task").iterdir():
        name = names.get(int(each.name), "others")
        with contextlib.suppress(OSError):  # it has ended
            words = (each / "stat").read_text().rpartition(")")[2].split()
            ticks = int(words[11]) + int(words[12])
            times_s[name] = times_s.get(name, 0.0) + ticks / os.sysconf("SC_CLK_TCK")
    return times_s


# --- the run ----------------------------------------------------------------------------------


class Run:
    """The window with its camera.

    Parameters
    ----------
    folder
        Folder of the recordings.
    seconds, rate_hz
        Duration, and frame rate.
    faulty
        Whether all faults occur.
    """

    def __init__(self, folder: Path, seconds: float, rate_hz: float, faulty: bool) -> None:
        self.seconds, self.rate_hz, self.faulty = seconds, rate_hz, faulty
        self.samples: list[Sample] = []
        self.notified: list[str] = []
        self.stalls = 0
        self._goes = threading.Event()
        self._goes.set()
        self._put_camera_in()
        shutil.copytree(sample_folder("gtaw"), folder / "run")
        self.window = make_window(Preferences(theme="dark"), folder / "preferences.json")
        self.window.apply_theme()
        self.window.resize(1366, 768)
        self.window.show()
        self.log: Any = self.window.log_panel
        self.log.model().rowsInserted.connect(self._record_messages)
        self.window.workspace.show(Session.open(folder / "run" / "gtaw.labsession"))
        self.window.show_step("capture")
        self.page: Any = self.window.page
        self.view = self.page.live_view
        self.painted = PaintCounter(self.view, self.page.picture_view.canvas.viewport())

    def _put_camera_in(self) -> None:
        """Replace the window's camera and disk by those of `filming`."""
        pool_camera = live_view.pool_camera
        most = round((self.seconds + 600) * self.rate_hz)

        def filmed(text: str, progress: Any) -> FilmedDevice:
            # As many pictures as in the same time, so that the oscillation is unchanged.
            rate = f"frames = {round(self.rate_hz / 5)}\nframe_rate_hz = {self.rate_hz:.1f}"
            rate += '\nformat = "tif"'  # a video holds no rate above 1000 Hz
            text = re.sub(r"frames = \d+\nframe_rate_hz = [\d.]+", rate, text)
            self.device = FilmedDevice(pool_camera(text, progress).picture, self.rate_hz, most)
            return self.device

        def writer(path: Path, *given: Any) -> NutWriter:
            return NutWriter(path, *given, file=Disk(path, self._goes))

        live_view.pool_camera = filmed
        live_module.Recorder = partial(Recorder, writer=writer)
        counted = MeasureCounts.counted(LiveMeasuring.measure, lambda k: self.device.is_noise[k])
        LiveMeasuring.measure = counted

    def _record_messages(self, _: object, first: int, last: int) -> None:
        self.notified += [self.log.item(row).text() for row in range(first, last + 1)]

    def _stall(self) -> None:
        self._goes.clear()
        time.sleep(STALL_S)
        self._goes.set()
        self.stalls += 1

    def _agenda(self) -> Agenda:
        """Return disconnects and stalls of the disk at times given by the seed."""
        if not self.faulty:
            return Agenda([])
        random = np.random.default_rng(SEED)
        step_s = self.seconds / DISCONNECTS
        out = [
            (at_s, partial(self.device.unplug, random.uniform(0.2, max(0.25, min(3, step_s / 4)))))
            for at_s in moments(self.seconds, DISCONNECTS, random)
        ]
        count = min(STALLS, int(self.seconds / (4 * STALL_S)))
        # Each in its own thread, so that a disconnect can occur during a stall.
        stalls = [
            (at_s, threading.Thread(target=self._stall, daemon=True).start)
            for at_s in (moments(self.seconds, count, random) if count else [])
        ]
        return Agenda([*out, *stalls])

    def do(self) -> Take:
        """Film, measure and record, with a sample each second."""
        self.view.start()
        run_until(lambda: self.view.updates > 2, 120)
        self.live = self.view.live
        run_until(lambda: MeasureCounts.good > 1, 120)
        run_for(2.0)
        self.painted.updates = 0
        self.view.trigger()
        self.begun_s = time.monotonic()
        if self.faulty:
            self.device.spoil(Faults(garbage=GARBAGE, seed=SEED), NOISE)
        self._sample()
        busy = busy_threads()
        ended = threading.Event()
        sampling = threading.Thread(target=self._sample_on, args=(ended,), daemon=True)
        sampling.start()
        with self._agenda():
            run_for(self.seconds)
        self.shares = {
            name: (after_s - busy.get(name, 0.0)) / self.seconds
            for name, after_s in busy_threads().items()
        }
        ended.set()
        sampling.join()
        if remaining := (len(self.samples) - 1) % 60:
            self.print_minute(self.samples[-remaining - 1 :])
        take: Take = self.live.takes[-1]
        self.device.faults = Faults()
        run_for(1.5)  # frequent events are reported once a second
        self.ended_s = time.monotonic()
        self.view.trigger()
        self.view.stop()
        run_until(lambda: not self.window.workspace.tasks.active, 120)
        run_for(0.5)
        return take

    def _sample_on(self, ended: threading.Event) -> None:
        while not ended.wait(max(0.0, self.samples[-1].at_s + 1 - time.monotonic())):
            self._sample()
            if len(self.samples) % 60 == 1:
                self.print_minute(self.samples[-61:])

    def _sample(self) -> None:
        truth, take = self.device.truth, self.live.takes[-1]
        given, now_s = truth.frames, time.monotonic()
        place = int(np.searchsorted(truth.numbers[:given], MeasureCounts.newest))
        mine, others = os.getpid(), children()
        self.samples.append(
            Sample(
                now_s,
                self.device.taken,
                given,
                self.live.feed.counts.frames,
                take.frames,
                take.lost,
                self.live._recorders[-1].waiting_mb,
                MeasureCounts.frames,
                MeasureCounts.good,
                MeasureCounts.cold,
                now_s - truth.arrived_s[min(place, given - 1)],
                self.painted.updates,
                self.painted.longest_s(),
                resident_mb(mine),
                sum(resident_mb(each) for each in others),
                sum(busy_s(each) for each in (mine, *others)),
            )
        )

    # --- output -------------------------------------------------------------------------------

    def print_minute(self, samples: Sequence[Sample]) -> None:
        """Print a row of the table for the samples of a minute."""
        if len(self.samples) <= 61:
            print(
                "  min   made  given  taken written lost waiting  measured  by itself,without"
                "  age,most  updates,least longest  window measuring  cores load\n"
                "                                          at most  a second          surface"
                "         s       a second       s      MB        MB"
            )
        first, last = samples[0], samples[-1]
        lasted_s = last.at_s - first.at_s
        made = np.subtract(last[1:6], first[1:6]).astype(int).tolist()
        measured, good = last.measured - first.measured, last.good - first.good
        ages = [each.age_s for each in samples[1:]]
        least = min(self.rates(samples), default=0.0)
        print(
            f"{(last.at_s - self.begun_s) / 60:5.1f} {made[0]:6} {made[1]:6} {made[2]:6} "
            f"{made[3]:7} {made[4]:4} {max(each.waiting_mb for each in samples):4.0f} MB "
            f"{measured / lasted_s:9.1f} {last.cold - first.cold:10},{measured - good:7} "
            f"{np.median(ages):4.1f},{max(ages):4.1f} "
            f"{self.rates(samples, len(samples) - 1)[0]:8.1f},{least:5.1f} "
            f"{max(each.longest_s for each in samples[1:]):7.2f} {last.window_mb:7.0f} "
            f"{last.measuring_mb:9.0f} {(last.busy_s - first.busy_s) / lasted_s:6.2f} "
            f"{os.getloadavg()[0]:4.1f}",
            flush=True,
        )

    def rates(self, samples: Sequence[Sample], over: int = 1) -> list[float]:
        """Return updates per second while frames arrived, over ``over`` samples each."""
        pairs = zip(samples[::over], samples[over::over], strict=False)
        return [
            (b.updates - a.updates) * self.rate_hz / (b.made - a.made)
            for a, b in pairs
            if b.made - a.made > self.rate_hz / 2
        ]

    def judge(self, take: Take) -> bool:
        """Compare all counts and messages with the truth; print a line per requirement."""
        truth, counts, all_right = self.device.truth, self.live.feed.counts, []
        shares = sorted(self.shares.items(), key=lambda each: -each[1])
        share_text = ", ".join(f"{name} {share:.2f}" for name, share in shares if share > 0.005)
        print(f"    of a core: {share_text}")

        def line(right: bool, words: str) -> None:
            all_right.append(right)
            print(f"    {'right' if right else 'WRONG'}  {words}", flush=True)

        unread = self.device.taken - truth.frames - truth.broken
        line(unread == 0, f"{self.device.taken} frames made, {unread} not read in time")
        line(
            (counts.frames, counts.broken, counts.lost) == (truth.frames, truth.broken, truth.lost),
            f"{truth.frames} whole and {truth.broken} broken given, disconnected {truth.lost} "
            f"times; the window counts {counts.frames}, {counts.broken} and {counts.lost}, "
            f"{counts.dropped} dropped",
        )
        line(take.lost == 0 and not take.trouble, f"{take.summary.words} {take.trouble}")
        found = compare(take.path, self.device, self.begun_s, self.ended_s)
        line(
            found.right and found.frames == take.frames,
            f"{found.frames} in the file: {found.missing} missing, {found.strange} twice or in "
            f"another order, {found.wrong} with another content, times {found.off_us:.1f} µs off",
        )
        self._judge_memory(line)
        least = min(self.rates(self.samples, min(60, len(self.samples) - 1)))
        line(
            least >= LEAST_UPDATES,
            f"{least:.1f} updates a second that frames came, in the slowest minute",
        )
        measured = self.samples[-1].measured - self.samples[0].measured
        rate = measured / (self.samples[-1].at_s - self.samples[0].at_s)
        line(measured > 0, f"{measured} measured, {rate:.1f} a second")
        fooled = [k for k, status in MeasureCounts.noise if status == "ok"]
        line(
            not fooled,
            f"{len(MeasureCounts.noise)} of noise, surfaces given to them: {len(fooled)}",
        )
        self._judge_words(take, line)
        return all(all_right)

    def _judge_memory(self, line: Any) -> None:
        third = len(self.samples) // 3
        for name in ("window_mb", "measuring_mb"):
            values = [getattr(each, name) for each in self.samples]
            began, mid, end = (np.median(values[k * third : (k + 1) * third]) for k in range(3))
            most = max(values)
            words = f"{name}: {began:.0f}, {mid:.0f}, {end:.0f} in thirds of the time, at most"
            line(end <= FLAT * mid, f"{words} {most:.0f}")

    def _judge_words(self, take: Take, line: Any) -> None:
        """Check that every fault is in the window's messages and in the recording's notes."""
        truth = self.device.truth
        with take.notes.open(encoding="utf-8", newline="") as file:
            noted = [row["what"] for row in csv.DictReader(file)]
        for where, reported in (("messages", times_told(self.log.texts())), ("notes", noted)):
            expected = {
                "was unplugged": truth.lost,
                "it is back after": truth.lost,
                "incomplete, discarded": truth.broken,
            }
            # The disk of a busy computer may also stall by itself.
            least = {"MB are queued in memory": self.stalls, "writing has caught up": self.stalls}
            counts = {words: how_many(reported, words) for words in (*expected, *least)}
            right = all(counts[each] == count for each, count in expected.items())
            right &= all(counts[each] >= count for each, count in least.items())
            words = ", ".join(
                f"“{each}” {counts[each]} of {n}" for each, n in (expected | least).items()
            )
            line(right, f"{where}: {words}")


def run(folder: Path, seconds: float, rate_hz: float, part: str) -> bool:
    """Run one part, in its own process."""
    for variable in ("XDG_STATE_HOME", "XDG_CONFIG_HOME", "XDG_DOCUMENTS_DIR"):
        os.environ[variable] = str(folder / "home")
    app = QApplication(["labapp"])
    print(f"{part}: {seconds / 60:g} min, {rate_hz:g} frames/s, load {os.getloadavg()[0]:.1f}")
    live_run = Run(folder, seconds, rate_hz, part == "faults")
    right = live_run.judge(live_run.do())
    live_run.window.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose, False)
    live_run.window.close()
    app.processEvents()
    return right


def main(arguments: Sequence[str]) -> int:
    numbers = [float(each) for each in arguments if re.fullmatch(r"[\d.]+", each)]
    minutes, rate_hz = [*numbers, *(1.0, 200.0)[len(numbers) :]]
    parts = [each for each in arguments if each in PARTS] or list(PARTS)
    folders = [each for each in arguments if each not in PARTS and Path(each).is_dir()]
    with tempfile.TemporaryDirectory(dir=folders[0] if folders else None) as name:
        if len(parts) == 1:
            return not run(Path(name), 60 * minutes, rate_hz, parts[0])
    ends = [
        subprocess.run(
            [sys.executable, __file__, str(minutes), str(rate_hz), part, *folders], check=False
        )
        for part in parts
    ]
    return any(each.returncode for each in ends)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
