"""The live pool in 3-D, drawn as often as the window allows."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

from PySide6.QtWidgets import QWidget

from labapp.export.rendering.scene import Scene
from labapp.gui.live.figures import OLD_S
from labapp.gui.views.view3d import LOOKS
from labapp.gui.views.view3d_kinds import make_view3d
from labapp.gui.widgets.buttons import tool_button
from labapp.gui.widgets.layouts import hbox, vbox
from labapp.run.live_measuring import LiveResult
from labapp.run.live_watch import LiveWatch

LASTS_S = 1.0
"""Time for which a surface stays visible if the next frames cannot be measured. If none are
measured, it is `OLD_S`: after that it no longer describes the visible pool."""

ROOMY = 1.5
"""Largest range of a colour scale, relative to that needed for a surface, at which the scale is
kept, so that colours change less often."""

WAITING = "The surface appears here once the next frame is measured"


class LiveSurface(QWidget):
    """The surface of the newest frame, and the view of it."""

    def __init__(self) -> None:
        super().__init__()
        self.view = make_view3d("The live pool in 3-D")
        self.view.set_words(WAITING)
        self._shown_s = 0.0
        self._limits: tuple[float, float] | None = None
        looks = [
            tool_button(words, tip, partial(self.view.look, direction))
            for direction, (words, tip) in LOOKS.items()
        ]
        row = hbox(*looks, 1)
        row.setContentsMargins(8, 0, 8, 0)
        vbox(row, (self.view, 1), of=self)

    def follow(self, result: LiveResult | None, watch: LiveWatch) -> bool:
        """Show the newest drawn surface and request the next; returns whether there was one.

        ``result`` is the newest since the last call; None if there is none.
        """
        scene = watch.scene()
        watch.ask_for_scene()
        if scene is not None:
            self._limits = steady_limits(self._limits, scene.limits)
            self._show(replace(scene, limits=self._limits))
            self._shown_s = time.monotonic()
            return True
        age_s = time.monotonic() - self._shown_s
        found = None if result is None else result.measurement
        if found is not None and found.measures is None and age_s > LASTS_S:
            self.view.set_words(f"No surface ({found.status}): {found.reason}")
            self._show(None)
        elif self.view.scene is not None and age_s > OLD_S:
            self.clear()
        return False

    def clear(self) -> None:
        """Show nothing until the next surface."""
        self.view.set_words(WAITING)
        self._show(None)
        self._limits = None

    def release(self) -> None:
        """Show nothing, and release OpenGL."""
        self.clear()
        self.view.close_view()

    def _show(self, scene: Scene | None) -> None:
        self.view.show_scene(scene)
        self.view.repaint()  # immediately: its duration determines the time of the next


def steady_limits(
    former: tuple[float, float] | None, wanted: tuple[float, float]
) -> tuple[float, float]:
    """Ends of a colour scale for the next surface: the previous ones if they fit well."""
    if former is not None:
        holds = former[0] <= wanted[0] and wanted[1] <= former[1]
        if holds and former[1] - former[0] <= ROOMY * (wanted[1] - wanted[0]):
            return former
    room = (ROOMY - 1) / 4 * (wanted[1] - wanted[0])
    return wanted[0] - room, wanted[1] + room
