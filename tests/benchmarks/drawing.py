"""Time to draw a change: the timeline, curves, and dragged dots.

Run as ``QT_QPA_PLATFORM=offscreen python tests/benchmarks/drawing.py``. Each is compared with a
plain label of the same size, drawn in the same run.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
from PySide6.QtWidgets import QApplication, QLabel, QWidget

from labapp.core.images.dots import Dots
from labapp.core.rows.correction import Correction
from labapp.core.rows.lattice import Lattice
from labapp.gui.curves import Axis, Curve, Mark
from labapp.gui.pages.dots.overlay import DotsOverlay
from labapp.gui.shell.window import TICKS
from labapp.gui.views.picture import PictureView
from labapp.gui.views.plots import PlotStack
from labapp.gui.widgets.timeline import Timeline

FRAMES = 10_000
TIMES = 30
KEPT: list[QWidget] = []
"""Windows with pyqtgraph are kept until the process ends: some crash when they are destroyed."""


def median_ms(widget: QWidget, change: Callable[[int], object]) -> float:
    """Return the median time of a change and of drawing it, ms."""
    KEPT.append(widget)
    widget.show()
    widget.grab()
    times_ms = []
    for step in range(TIMES):
        start_s = time.perf_counter()
        change(step)
        widget.grab()
        times_ms.append(1000 * (time.perf_counter() - start_s))
    return statistics.median(times_ms)


def timeline() -> tuple[QWidget, Callable[[int], object]]:
    """Return a timeline and a change of every frame's state."""
    widget, kinds = Timeline(TICKS), np.arange(FRAMES) % 5
    widget.resize(1900, 80)

    def change(step: int) -> None:
        widget.set_frames(np.arange(FRAMES), np.zeros(FRAMES), np.roll(kinds, step))
        widget.set_frame(step * 300)

    return widget, change


def curves() -> tuple[QWidget, Callable[[int], object]]:
    """Return a plot and a change which pans four curves together."""
    widget, at_s = PlotStack("Trends"), np.arange(FRAMES) / 10
    widget.resize(800, 600)
    four_curves = [
        Curve(
            *(name, "mm", at_s, np.sin(at_s)),
            key=np.arange(FRAMES),
            mark=np.zeros(FRAMES, int),
            marks=(Mark("●", "measured"),),
        )
        for name in ("Width", "Length", "Height", "ARE")
    ]
    widget.show_curves(four_curves, Axis("Time", "s"))
    return widget, lambda step: widget._plots[0].setXRange(step, 100 + step * 25, padding=0)


def dots() -> tuple[QWidget, Callable[[int], object]]:
    """Return a picture of 400 dots and a change which drags some; 60 Hz is required."""
    widget = PictureView("Frame")
    widget.resize(700, 560)
    widget.show_picture(np.zeros((480, 480), np.uint8))
    row, column = (number.ravel() for number in np.mgrid[1:21, 1:21])
    one = np.ones(len(row))
    lattice = Lattice(row, column, (10, 10), (), frozenset({3, 4}))
    correction = Correction.of(
        Dots(20.0 * column, 450 - 20.0 * row, one, one, one, one, one), lattice
    )
    overlay, chosen = DotsOverlay(widget), np.arange(80, 140)
    before = correction.dots.image_px

    def change(step: int) -> None:
        after = before.copy()
        after[chosen] += step, -step
        overlay.show(correction, after, chosen, np.empty((0, 2)))

    return widget, change


def main() -> None:
    app = QApplication(sys.argv)
    for words, make in (
        (f"timeline of {FRAMES} frames", timeline),
        (f"4 curves of {FRAMES} frames", curves),
        ("400 dots, 60 of them dragged", dots),
    ):
        widget, change = make()
        label = QLabel("0")
        label.resize(widget.size())
        change_ms = median_ms(widget, change)
        label_ms = median_ms(label, lambda step, label=label: label.setText(str(step)))
        print(
            f"{words:<32}{change_ms:8.2f} ms   {change_ms / label_ms:6.1f} × a label of this size"
        )
    app.quit()


if __name__ == "__main__":
    main()
