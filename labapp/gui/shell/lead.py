"""The substitute for a page without content: what it will show, and the actions to get there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from PySide6.QtCore import QPointF, QRectF, Qt, Signal
from PySide6.QtGui import QColor, QPainter, QPaintEvent, QPalette, QPen, QPolygonF
from PySide6.QtWidgets import QGridLayout, QPushButton, QWidget

from labapp.core.values import FloatArray
from labapp.gui.shell.actions import ACTIONS
from labapp.gui.shell.steps import Lead, Offer
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.labels import Message, set_font, wrapping_label
from labapp.gui.widgets.layouts import hbox, vbox

WORDS_PX = 340
PICTURE_PX = (240, 144)
"""Width of the text; size of the picture."""


def action_button(name: str, do: Callable[[str], object]) -> QPushButton:
    """A button with the text of an action of the window; ``do`` is called with its name."""
    action = next(each for each in ACTIONS if each.name == name)
    tip = f"{action.tip} ({action.key})" if action.key else action.tip
    return button(action.text, tip, lambda: do(name))


def action_grid(names: Sequence[str], do: Callable[[str], object]) -> QWidget:
    """Buttons of actions in two columns."""
    made = QWidget()
    grid = QGridLayout(made)
    grid.setContentsMargins(0, 0, 0, 0)
    for k, name in enumerate(names):
        pressed = action_button(name, do)
        pressed.setMinimumWidth(1)  # so that it fits into a narrow panel, too
        grid.addWidget(pressed, k // 2, k % 2)
    return made


class EmptyState(QWidget):
    """Substitute for a page that has nothing to show yet."""

    action_requested = Signal(str)
    """A button was pressed: the name of the window's action."""

    def __init__(self) -> None:
        super().__init__()
        self.setFocusPolicy(Qt.FocusPolicy.ClickFocus)  # otherwise it has no place in the tab order
        self._shown: tuple[str, Lead] | None = None
        self.picture = _Picture()
        self.words = wrapping_label()
        self.words.setAlignment(Qt.AlignmentFlag.AlignCenter)
        self.answer = Message(2)
        self.buttons: list[QPushButton] = []
        self._column = vbox()
        inner = QWidget()
        inner.setMaximumWidth(WORDS_PX)
        picture = hbox(1, self.picture, 1)
        vbox(2, picture, self.words, self._column, self.answer, 3, of=inner).setSpacing(8)
        hbox(1, (inner, 100), 1, of=self)

    def show_lead(self, key: str, lead: Lead) -> None:
        """Show what a step will show, and the buttons that lead there, the first one bold."""
        if self._shown == (key, lead):
            return
        self._shown = key, lead
        self.picture.show_step(key)
        self.words.setText(lead.words)
        for each in self.buttons:
            each.hide()  # Qt deletes it only later
            each.deleteLater()
        self.buttons = [self._button(each) for each in lead.actions]
        for k, made in enumerate(self.buttons):
            set_font(made, bold=k == 0)
            made.setDefault(k == 0)
            made.setMinimumHeight(made.fontMetrics().height() * (2 if k == 0 else 1) + 8)
            self._column.addWidget(made)
        for one, following in pairwise((self, *self.buttons)):
            QWidget.setTabOrder(one, following)  # otherwise they come last in the window

    def _button(self, offer: str | Offer) -> QPushButton:
        if isinstance(offer, Offer):
            return button(offer.text, offer.tip, offer.do)
        return action_button(offer, self.action_requested.emit)


class _Picture(QWidget):
    """A small drawing of the content of a step."""

    def __init__(self) -> None:
        super().__init__()
        self._key = ""
        self.setFixedSize(*PICTURE_PX)

    def show_step(self, key: str) -> None:
        self._key = key
        self.update()

    def paintEvent(self, _event: QPaintEvent) -> None:
        strokes = PICTURES.get(self._key, _frame_strokes)()
        ink = self.palette().color(QPalette.ColorRole.Text)
        accent = self.palette().color(QPalette.ColorRole.Highlight)
        ink.setAlphaF(0.45)
        with QPainter(self) as painter:
            painter.setRenderHint(QPainter.RenderHint.Antialiasing)
            for points, is_accent, dots in strokes:
                _draw(painter, points, accent if is_accent else ink, dots)


Stroke = tuple[FloatArray, bool, bool]
"""Points, shape (n, 2), in a box of 100 × 60; whether in the accent colour; whether as dots."""


def _draw(painter: QPainter, points: FloatArray, color: QColor, dots: bool) -> None:
    scale = PICTURE_PX[0] / 100
    places = [QPointF(x * scale, y * scale) for x, y in points.tolist()]
    if dots:
        painter.setPen(Qt.PenStyle.NoPen)
        painter.setBrush(color)
        for place in places:
            painter.drawEllipse(QRectF(place.x() - 3, place.y() - 3, 6, 6))
    else:
        painter.setPen(QPen(color, 2))
        painter.drawPolyline(QPolygonF(places))


def _line(*points: tuple[float, float]) -> FloatArray:
    return np.array(points, float)


def _frame_strokes() -> list[Stroke]:
    """A frame of a film with the play symbol."""
    film = _line((18, 6), (82, 6), (82, 54), (18, 54), (18, 6))
    return [(film, False, False), (_line((43, 20), (60, 30), (43, 40), (43, 20)), True, False)]


def _dots_strokes() -> list[Stroke]:
    strokes: list[Stroke] = []
    for k in range(4):
        x = np.linspace(-1, 1, 5 + 2 * k)
        row = np.stack([50 + (14 + 9 * k) * x, 12 + 12 * k + 7 * x**2], axis=-1)
        strokes += [(row, False, False), (row, True, True)]
    return strokes


def _surface_strokes() -> list[Stroke]:
    angle = np.linspace(0, 2 * np.pi, 61)
    rings: list[Stroke] = [
        (np.stack([50 + 38 * r * np.cos(angle), 42 - 26 * (1 - r**2) + 13 * r * np.sin(angle)], -1),
         r < 1, False)
        for r in (1.0, 0.8, 0.55, 0.3)
    ]  # fmt: skip
    return rings


def _trends_strokes() -> list[Stroke]:
    x = np.linspace(14, 92, 60)
    axes = _line((12, 6), (12, 54), (94, 54))
    curves = [18 + 4 * np.sin(x / 6), 34 + 7 * np.sin(x / 9 + 1)]
    return [(axes, False, False), *((np.stack([x, y], -1), True, False) for y in curves)]


def _export_strokes() -> list[Stroke]:
    sheets = [_line((20 + d, 10 - d), (52 + d, 10 - d), (52 + d, 50 - d), (20 + d, 50 - d),
                    (20 + d, 10 - d)) for d in (0, 5)]  # fmt: skip
    rows = [_line((26, y), (46, y)) for y in (20, 28, 36)]
    arrow = [_line((64, 30), (88, 30)), _line((80, 23), (88, 30), (80, 37))]
    return [
        *((each, False, False) for each in (*sheets, *rows)),
        *((each, True, False) for each in arrow),
    ]


def _plane_strokes() -> list[Stroke]:
    axes = _line((24, 6), (24, 50), (90, 50))
    marks = [(x, 50.0) for x in range(36, 90, 12)] + [(24.0, y) for y in range(14, 44, 12)]
    return [(axes, False, False), (_line((24, 50), *marks), True, True)]


def _mirror_strokes() -> list[Stroke]:
    x = np.linspace(30, 70, 30)
    cap = np.stack([x, 50 - 12 * np.sqrt(1 - ((x - 50) / 20) ** 2)], axis=-1)
    rays = [_line((86, 6), (50 + d, 40), (14 + d, 6)) for d in (-8, 0, 8)]
    return [
        (_line((8, 50), (92, 50)), False, False),
        (cap, False, False),
        *((ray, True, False) for ray in rays),
    ]


PICTURES: dict[str, Callable[[], list[Stroke]]] = {
    "dots": _dots_strokes,
    "surface": _surface_strokes,
    "trends": _trends_strokes,
    "export": _export_strokes,
    "plane": _plane_strokes,
    "bench_check": _mirror_strokes,
}
"""Drawings by the key of the step; all others have a frame of a film."""
