"""How long a change of what is drawn takes to be seen: the timeline, curves, dots that are dragged.

Run as ``QT_QPA_PLATFORM=offscreen python tests/benchmarks/drawing.py``. Each is told beside a plain
label of the same size, drawn in the same run.
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
"""Windows with pyqtgraph live to the end of the process: some crash when they are destroyed."""


def median_ms(widget: QWidget, change: Callable[[int], object]) -> float:
    """Median time of a change and the picture after it, ms."""
    KEPT.append(widget)
    widget.show()
    widget.grab()
    took = []
    for step in range(TIMES):
        began = time.perf_counter()
        change(step)
        widget.grab()
        took.append(1000 * (time.perf_counter() - began))
    return statistics.median(took)


def timeline() -> tuple[QWidget, Callable[[int], object]]:
    """Every frame stands otherwise than before."""
    made, kinds = Timeline(TICKS), np.arange(FRAMES) % 5
    made.resize(1900, 80)

    def change(step: int) -> None:
        made.set_frames(np.arange(FRAMES), np.zeros(FRAMES), np.roll(kinds, step))
        made.set_frame(step * 300)

    return made, change


def curves() -> tuple[QWidget, Callable[[int], object]]:
    """Four curves are panned together."""
    made, at_s = PlotStack("Trends"), np.arange(FRAMES) / 10
    made.resize(800, 600)
    many = [
        Curve(
            *(name, "mm", at_s, np.sin(at_s)),
            key=np.arange(FRAMES),
            mark=np.zeros(FRAMES, int),
            marks=(Mark("●", "measured"),),
        )
        for name in ("Width", "Length", "Height", "ARE")
    ]
    made.show_curves(many, Axis("Time", "s"))
    return made, lambda step: made._plots[0].setXRange(step, 100 + step * 25, padding=0)


def dots() -> tuple[QWidget, Callable[[int], object]]:
    """Four hundred dots follow the hand; 60 Hz is wanted."""
    made = PictureView("Frame")
    made.resize(700, 560)
    made.show_picture(np.zeros((480, 480), np.uint8))
    row, column = (number.ravel() for number in np.mgrid[1:21, 1:21])
    one = np.ones(len(row))
    lattice = Lattice(row, column, (10, 10), (), frozenset({3, 4}))
    correction = Correction.of(
        Dots(20.0 * column, 450 - 20.0 * row, one, one, one, one, one), lattice
    )
    overlay, chosen = DotsOverlay(made), np.arange(80, 140)
    before = correction.dots.image_px

    def change(step: int) -> None:
        after = before.copy()
        after[chosen] += step, -step
        overlay.show(correction, after, chosen, np.empty((0, 2)))

    return made, change


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
        took = median_ms(widget, change)
        plain = median_ms(label, lambda step, label=label: label.setText(str(step)))
        print(f"{words:<32}{took:8.2f} ms   {took / plain:6.1f} × a label of this size")
    app.quit()


if __name__ == "__main__":
    main()
