"""Speed of the app: start, opening, scrubbing, 3-D updates, and the longest GUI stalls.

Run as ``xvfb-run -a -s "-screen 0 1920x1080x24" python tests/benchmarks/app.py [frames] [part …]``
with the parts ``start``, ``scrub``, ``import`` and ``measure``; by default all of them. Each figure
is printed with a simple reference timed in the same run, and with the load of the machine, as
machines differ and are busy.

Frames are those of the GTAW sample, followed by dark ones: a fit takes seconds, a dark frame almost
no time, so that results arrive at the highest possible rate. Before measuring, every frame has one
of the sample's results.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("LIBGL_ALWAYS_SOFTWARE", "1")

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from large_session import SAMPLE, write_recording
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QApplication, QLabel, QMainWindow
from stall_meter import StallMeter, run_for, run_until

from labapp.gui.preferences import Preferences
from labapp.gui.shell.commands import make_window
from labapp.gui.shell.steps import STEPS
from labapp.gui.shell.window import MainWindow
from labapp.gui.views.view3d_kinds import OffscreenView
from labapp.session.session import Session

STARTS = 5
SCRUB_S = 4.0
MOST_MS = 50.0
"""No call may block the GUI thread for longer."""

BRIGHT = 300
"""Number of frames of the recording that show dots."""

CHILD = Path(__file__).with_name("app_start.py")
PARTS = ("start", "scrub", "import", "measure")


def print_figure(name: str, value: str, beside: str, bar: str) -> None:
    print(f"{name:<34}{value:>14}   {beside:<44}{bar:<22} load {os.getloadavg()[0]:.1f}")
    sys.stdout.flush()


# --- start and opening ------------------------------------------------------------------------


def started(*arguments: object) -> dict[str, float]:
    """Return the seconds from the start of a program to the events that it prints."""
    started_s = time.monotonic()
    process = subprocess.run(
        [sys.executable, CHILD, str(started_s), *map(str, arguments)],
        capture_output=True,
        text=True,
        check=True,
    )
    pairs = [line.split() for line in process.stdout.splitlines()]
    return {name: float(value) for name, value in pairs}


def start(folder: Path) -> None:
    shutil.copytree(SAMPLE, folder / "gtaw")
    sample = folder / "gtaw" / "gtaw.labsession"
    runs: dict[str, list[dict[str, float]]] = {"bare": [], "app": [], "file": [], "later": []}
    started("bare")
    for _ in range(STARTS):
        runs["bare"].append(started("bare"))
        runs["app"].append(started("app"))
        runs["file"].append(started("file", sample))
        runs["later"].append(started("later", sample))

    def median(kind: str, name: str) -> float:
        return float(np.median([run[name] for run in runs[kind]]))

    bare = median("bare", "usable")
    for name, kind, event, bar in (
        ("start to usable window", "app", "usable", "wanted ≤ 2.5 s"),
        ("start with the sample, to 3-D", "file", "drawn", "wanted ≤ 4.0 s"),
        ("open the sample later, to 3-D", "later", "drawn", "wanted ≤ 1.5 s"),
    ):
        took_s, cpu_s = median(kind, event), median(kind, f"{event}_cpu")
        beside = f"{cpu_s:.2f} s of processor; {took_s / bare:.1f} × a bare Qt window"
        print_figure(name, f"{took_s:.2f} s", beside, bar)


# --- the session ------------------------------------------------------------------------------


def sample_pictures() -> list[np.ndarray]:
    video = cv2.VideoCapture(str(SAMPLE / "recording.avi"))
    pictures = []
    while (read := video.read())[0]:
        pictures.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY))
    return pictures


def make_recording(path: Path, frames: int) -> None:
    bright = sample_pictures()
    dark = [np.full_like(bright[0], level) for level in range(10)]
    write_recording(
        path,
        (bright[k % len(bright)] if k < BRIGHT else dark[k % len(dark)] for k in range(frames)),
    )


def fill(session: Session) -> None:
    """Give every frame one of the sample's results."""
    with Session.open(SAMPLE / "gtaw.labsession", read_only=True) as sample:
        results = [sample.result(int(k)) for k in sample.frames]
        session.set_setup(sample.setup_text)
        session.set_settings(sample.settings)
    basis = session._basis()
    assert basis is not None
    with session._database.transaction():
        for number in session.frames.tolist():
            result = results[number % len(results)]
            assert result is not None
            session._results.put(number, result.measurement, basis, None)


def new_window(folder: Path) -> MainWindow:
    window = make_window(Preferences(theme="dark"), folder / "preferences.json")
    window.apply_theme()
    window.resize(1600, 1000)
    window.show()
    run_for(0.3)
    return window


# --- scrubbing and 3-D ------------------------------------------------------------------------


def is_drawn(view: Any) -> bool:
    """Return whether a 3-D view has drawn its scene."""
    if isinstance(view, OffscreenView):
        return view._picture is not None
    return not view._late.isActive()


def shown_by(window: MainWindow) -> Callable[[], bool]:
    """Return a condition: the current page has drawn the current frame."""
    page: Any = window.page
    space = window.workspace
    if page.key == "dots":
        return lambda: page.seen is not None and page.seen.frame == space.frame
    if page.key == "capture":
        return lambda: page._seen == (None, space.frame)
    if page.key == "surface":
        return lambda: page.surface_state.result.frame == space.frame and is_drawn(page.view)
    return lambda: True


def rate(step: Callable[[int], None], seconds: float = SCRUB_S) -> float:
    step(0)
    start_s, done = time.perf_counter(), 0
    while time.perf_counter() - start_s < seconds:
        done += 1
        step(done)
    return done / (time.perf_counter() - start_s)


def scrub(window: MainWindow, session: Session) -> None:
    numbers = np.random.default_rng(1).integers(0, BRIGHT, 10_000).tolist()
    decoding_rate = rate(lambda k: session.frame(numbers[k]) and None)
    print(f"{len(session.frames)} frames; decoding alone: {decoding_rate:.0f} frames/s")
    for key in ("capture", "dots", "surface", "trends"):
        window.show_step(key)
        run_until(shown_by(window))
        run_for(1.5)

        def step(k: int) -> None:
            window.timeline.scrubber.go_to(numbers[k])
            run_until(shown_by(window))
            QApplication.processEvents()  # draws the updates

        cpu_s = time.process_time()
        with StallMeter() as meter:
            frame_rate = rate(step)
        cpu_s = (time.process_time() - cpu_s) / (frame_rate * SCRUB_S) * 1000
        beside = f"{frame_rate / decoding_rate:.2f} of decoding; {cpu_s:.0f} ms of processor each"
        print_figure(f"scrubbing, {key}", f"{frame_rate:.1f} /s", beside, "wanted ≥ 30 /s")
        print_stalls(meter, 1)
    window.show_step("surface")
    run_until(shown_by(window))
    draw(window)


def draw(window: MainWindow) -> None:
    """Time how often another surface can be built and drawn in the 3-D view."""
    page: Any = window.page
    scenes = []
    for number in range(10):
        window.workspace.show_frame(number)
        run_until(shown_by(window))
        scenes.append(page.view.scene)
    plotter = page.view._drawing.plotter
    render_rate = rate(lambda _: plotter.render() and None)

    def step(k: int) -> None:
        page.view.show_scene(scenes[k % len(scenes)])
        run_until(lambda: is_drawn(page.view))
        QApplication.processEvents()

    update_rate = rate(step)
    size = plotter.window_size
    beside = f"{update_rate / render_rate:.2f} of bare renders, {size[0]}×{size[1]} px"
    print_figure("3-D updates", f"{update_rate:.1f} /s", beside, "wanted ≥ 20 /s")


# --- long work --------------------------------------------------------------------------------


def print_stalls(meter: StallMeter, count: int) -> None:
    for stall in meter.longest[:count]:
        print(f"      {stall.wall_ms:6.1f} ms ({stall.cpu_ms:.0f} of processor)  {stall.calls}")
    sys.stdout.flush()


def print_longest(name: str, meter: StallMeter, beside: str) -> None:
    longest = meter.longest
    wall_ms = longest[0].wall_ms if longest else 0.0
    over = sum(stall.wall_ms > MOST_MS for stall in longest)
    cpu_ms = max((stall.cpu_ms for stall in longest), default=0.0)
    beside = f"of processor {cpu_ms:.0f} ms; {over} over {MOST_MS:g}; {beside}"
    print_figure(name, f"{wall_ms:.0f} ms", beside, f"wanted ≤ {MOST_MS:g} ms")
    print_stalls(meter, 4)


def idle(folder: Path) -> None:
    """Measure the stalls of an idle window while another process is busy, as a reference."""
    busy_process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    window = QMainWindow()
    window.setCentralWidget(QLabel("nothing"))
    window.show()
    try:
        with StallMeter() as meter:
            run_for(5)
    finally:
        busy_process.kill()
        busy_process.wait()
        window.close()
    print_longest("a bare window, another busy", meter, "5 s")


def import_recording(window: MainWindow, recording: Path, frames: int) -> None:
    """Import on the recording page while browsing frames: cancel, then import to the end."""
    window.show_step("capture")
    page: Any = window.page
    tasks = window.workspace.tasks
    page.take(recording)
    run_until(lambda: page.preview is not None)
    run_until(lambda: not tasks.active)
    for how, part in (("cancelled", 0.3), ("to its end", 2.0)):
        start_s = time.perf_counter()
        with StallMeter() as meter:
            page.import_chosen()
            task = page._importing
            steps = 0
            while task in tasks.active:
                run_for(0.05)
                steps += 1
                page.slider.setValue((steps * 37) % frames)
                if task.total and task.done > part * task.total:
                    task.cancel()
            run_until(lambda: not tasks.active)
        took_s = time.perf_counter() - start_s
        print_longest(f"importing, {how}", meter, f"{took_s / frames * 1000:.1f} ms a frame")
        imported = 0 if window.workspace.session is None else len(window.workspace.session.frames)
        print(f"      {task.done} of {task.total} done; the session holds {imported} frames")


def measure_while_browsing(window: MainWindow, part: Sequence[int], most: int) -> int:
    """Measure at most ``most`` frames while browsing others; return the number done."""
    space = window.workspace
    space.measure(part)
    task = space.measuring
    assert task is not None
    steps = 0
    while task in space.tasks.active:
        run_for(0.1)
        steps += 1
        space.show_frame(steps % BRIGHT)
        if task.done > most:
            task.cancel()
    run_until(lambda: not space.tasks.active)
    return task.done


def measure(window: MainWindow, session: Session) -> None:
    """Measure on every page while browsing frames; cancel once, then continue to the end."""
    space = window.workspace
    dark = session.frames[BRIGHT:].tolist()
    keys = [step.key for step in STEPS]
    for key in keys:
        window.show_step(key)
        run_for(1.0)
    space.measure(dark[:200])  # starts the processes and fills caches
    run_until(lambda: not space.tasks.active, 120)
    share = len(dark) // len(keys)
    worst = StallMeter()
    start_s = time.perf_counter()
    for place, key in enumerate(keys):
        window.show_step(key)
        run_for(0.5)
        began_part = time.perf_counter()
        part = dark[place * share : (place + 1) * share]
        with StallMeter() as meter:
            done = measure_while_browsing(window, part, share // 2 if place == 0 else share)
            if done < share:
                print(f"      cancelled after {done} of {share}")
                measure_while_browsing(window, part[done:], share)
        took_s = time.perf_counter() - began_part
        print_longest(f"measuring, {key}", meter, f"{share / took_s:.0f} results/s")
        worst.stalls += meter.stalls
    took_s = time.perf_counter() - start_s
    print_longest(f"measuring {len(keys) * share}", worst, f"{took_s:.0f} s")
    statuses = session.overview().status
    wrong = [k for k in dark[: len(keys) * share] if statuses[k] == "ok"]
    print(f"      results that were not replaced: {len(wrong)}; problems: {session.problems()}")


def main(arguments: Sequence[str]) -> None:
    numbers = [int(each) for each in arguments if each.isdigit()]
    frames = numbers[0] if numbers else 10_000
    parts = [each for each in arguments if each in PARTS] or list(PARTS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for variable in ("XDG_STATE_HOME", "XDG_CONFIG_HOME", "XDG_DOCUMENTS_DIR"):
            os.environ[variable] = str(folder / "home")
        if "start" in parts:
            start(folder)
        if not set(parts) - {"start"}:
            return
        recording = folder / "large.avi"
        make_recording(recording, frames)
        app = QApplication.instance() or QApplication(["labapp"])
        assert isinstance(app, QApplication)
        idle(folder)
        window = new_window(folder)
        window.workspace.show(Session.create(folder / "large.labsession"))
        session = window.workspace.session
        assert session is not None
        if "import" in parts:
            import_recording(window, recording, frames)
        else:
            session.import_recording(recording)
        fill(session)
        window.workspace.changed.emit()
        if "scrub" in parts:
            scrub(window, session)
        if "measure" in parts:
            measure(window, session)
        window.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose, False)
        window.close()
        sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
