"""The steps at the left, each with its mark, and the panel with instructions at the right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from PySide6.QtCore import QPointF, QRectF, QSignalBlocker, QSize, Qt, Signal
from PySide6.QtGui import (
    QColor,
    QIcon,
    QPainter,
    QPalette,
    QPen,
    QPixmap,
    QPolygonF,
    QResizeEvent,
)
from PySide6.QtWidgets import (
    QFrame,
    QListWidget,
    QListWidgetItem,
    QScrollArea,
    QSizePolicy,
    QStackedWidget,
    QVBoxLayout,
    QWidget,
)

from labapp.gui.shell.steps import READ_ONLY, Mark, State, Step
from labapp.gui.theme import FollowsTheme, is_dark
from labapp.gui.widgets.labels import Message, plain_label, plain_tip, set_font, wrapping_label
from labapp.gui.widgets.layouts import fill, scrolled

ICON_PX = 18

NUMBER_PX = 14
"""Space around icon and number of a step."""

LEAST_PX = 320
"""Minimum width of the panel; a screen of 1024 px at 150 % is only 683 px wide."""

STATE_LINES = 2
"""Lines reserved for the state of a step, so that the panel below does not move."""

COLOURS = {
    Mark.TODO: ("#6b7480", "#929ba6"),
    Mark.READY: ("#0a6fc2", "#6db8f2"),
    Mark.DONE: ("#1d7f45", "#58c783"),
    Mark.ATTENTION: ("#b35300", "#f2a35e"),
}
"""Colours on a light and on a dark background."""

SIGNS = {Mark.TODO: "○", Mark.READY: "▶", Mark.DONE: "✓", Mark.ATTENTION: "▲"}

CHECK = ((0.22, 0.52), (0.42, 0.72), (0.78, 0.28))
ARROW = ((0.32, 0.2), (0.8, 0.5), (0.32, 0.8))
WARNING = ((0.5, 0.1), (0.93, 0.88), (0.07, 0.88))


def mark_icon(mark: Mark, dark: bool, selected: QColor | None = None) -> QIcon:
    """The mark's shape in its colour, or in another colour if its step is selected."""
    colour = QColor(COLOURS[mark][dark])
    icon = QIcon(_drawn(mark, colour, QColor("#22262a" if dark else "#ffffff")))
    if selected is not None:
        ground = QColor("#000000" if selected.lightness() > 128 else "#ffffff")
        icon.addPixmap(_drawn(mark, selected, ground), QIcon.Mode.Selected)
    return icon


def _drawn(mark: Mark, colour: QColor, ground: QColor) -> QPixmap:
    scale = 3  # sharp on a screen of any scaling
    pixmap = QPixmap(ICON_PX * scale, ICON_PX * scale)
    pixmap.fill(Qt.GlobalColor.transparent)
    with QPainter(pixmap) as painter:
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.scale(ICON_PX * scale, ICON_PX * scale)
        pen = QPen(colour, 0.1)
        pen.setCapStyle(Qt.PenCapStyle.RoundCap)
        pen.setJoinStyle(Qt.PenJoinStyle.RoundJoin)
        painter.setPen(pen)
        if mark is Mark.TODO:
            painter.drawEllipse(QRectF(0.22, 0.22, 0.56, 0.56))
        elif mark is Mark.DONE:
            painter.setPen(QPen(colour, 0.16, c=Qt.PenCapStyle.RoundCap))
            painter.drawPolyline(QPolygonF([QPointF(*point) for point in CHECK]))
        else:
            painter.setBrush(colour)
            corners = ARROW if mark is Mark.READY else WARNING
            painter.drawPolygon(QPolygonF([QPointF(*point) for point in corners]))
            if mark is Mark.ATTENTION:
                painter.setPen(QPen(ground, 0.1))
                painter.drawLine(QPointF(0.5, 0.38), QPointF(0.5, 0.6))
                painter.drawPoint(QPointF(0.5, 0.76))
    return pixmap


class StepList(FollowsTheme, QListWidget):
    """The steps that have a page."""

    chosen = Signal(str)
    """The operator chose a step: its key."""

    def __init__(self, steps: Sequence[Step]) -> None:
        super().__init__()
        self._states: Mapping[str, State] = {}
        self._steps: tuple[Step, ...] = ()
        self.setAccessibleName("Steps")
        self.setToolTip("The steps from the bench to the results: ↑ and ↓ choose one")
        self.setFrameShape(QFrame.Shape.NoFrame)
        self.setIconSize(QSize(ICON_PX, ICON_PX))
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Expanding)
        self.setSpacing(1)
        for _ in steps:
            item = QListWidgetItem()
            item.setSizeHint(QSize(0, self.fontMetrics().height() + 14))
            self.addItem(item)
        self.show_titles(steps)
        # On a small screen only numbers and marks are visible; the titles are in their tooltips.
        self.setMinimumWidth(self.fontMetrics().horizontalAdvance("10") + ICON_PX + NUMBER_PX)
        self.currentRowChanged.connect(self._told)
        self.follow_theme()

    def sizeHint(self) -> QSize:
        """Width of the longest title."""
        metrics = self.fontMetrics()
        texts = [metrics.horizontalAdvance(text) for text in self._texts()]
        return QSize(max([60, *texts]) + ICON_PX + 36, 200)

    def show_titles(self, steps: Sequence[Step]) -> None:
        """Show the same steps with their titles in the session."""
        self._steps = tuple(steps)
        is_narrow = self.isVisible() and self.width() < self.sizeHint().width()
        for row, text in enumerate(self._texts()):
            self.item(row).setText(str(row + 1) if is_narrow else text)

    def _texts(self) -> list[str]:
        return [f"{row}  {step.title}" for row, step in enumerate(self._steps, 1)]

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Show only numbers if there is no space for the titles."""
        super().resizeEvent(event)
        self.show_titles(self._steps)

    def show_states(self, states: Mapping[str, State]) -> None:
        """Show the state of every step."""
        self._states = states
        dark = is_dark(self.palette())
        selected = self.palette().color(QPalette.ColorRole.HighlightedText)
        for row, step in enumerate(self._steps):
            state, item = states[step.key], self.item(row)
            item.setIcon(mark_icon(state.mark, dark, selected))
            message = f"{row + 1} {step.title}: {state.mark.value}. {state.why}"
            item.setToolTip(plain_tip(message))
            item.setData(Qt.ItemDataRole.AccessibleTextRole, message)

    def take_colours(self) -> None:
        """Draw the marks in the colours of the theme."""
        if self._states:
            self.show_states(self._states)

    def show_step(self, key: str) -> None:
        """Select the step in view; none for the welcome page."""
        keys = [step.key for step in self._steps]
        with QSignalBlocker(self):
            self.setCurrentRow(keys.index(key) if key in keys else -1)

    def _told(self, row: int) -> None:
        if row >= 0:
            self.chosen.emit(self._steps[row].key)


class SidePanel(FollowsTheme, QWidget):
    """Instructions, state of the step, and the page's own panel, which can be scrolled."""

    def __init__(self) -> None:
        super().__init__()
        self._shown: State | None = None
        self.title = plain_label()
        set_font(self.title, scale=1.25)
        self.hint = wrapping_label()
        self.state = Message(STATE_LINES)
        self.read_only = wrapping_label(f"⚠ {READ_ONLY} until it is opened again for changes.")
        self.read_only.hide()
        for label in (self.hint, self.read_only):
            label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self.stack = QStackedWidget()
        self._areas: dict[QWidget, QScrollArea] = {}
        layout = QVBoxLayout(self)
        layout.setContentsMargins(10, 8, 6, 6)
        line = QFrame()
        line.setFrameShape(QFrame.Shape.HLine)
        line.setForegroundRole(QPalette.ColorRole.Mid)
        fill(layout, self.title, self.hint, self.state, self.read_only, line, (self.stack, 1))
        self.setMinimumWidth(LEAST_PX)
        self.follow_theme()

    def sizeHint(self) -> QSize:
        """Width of two columns of numbers: more with a larger font, as a table has names, too."""
        return QSize(max(350, 42 * self.fontMetrics().horizontalAdvance("0")), 500)

    def show_panel(self, panel: QWidget, step: Step) -> None:
        """Show a page's panel."""
        if panel not in self._areas:
            area = scrolled(panel, f"{step.title}: parameters and results")
            # If it came and went, line breaks would change and the widgets below would move.
            area.setVerticalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOn)
            self._areas[panel] = area
            self.stack.addWidget(area)
        self.stack.setCurrentWidget(self._areas[panel])
        self.title.setText(step.title)
        self.hint.setText(step.hint)

    def scroll_to_top(self) -> None:
        """Show the beginning of every panel, where it says what is in view."""
        for area in self._areas.values():
            area.verticalScrollBar().setValue(0)

    def show_state(self, state: State) -> None:
        """Show the state of the step and its reason."""
        self._shown = state
        self.state.setText(f"{SIGNS[state.mark]}  {state.why}")
        palette = self.state.palette()
        colour = COLOURS[state.mark][is_dark(self.palette())]
        palette.setColor(QPalette.ColorRole.WindowText, QColor(colour))
        self.state.setPalette(palette)

    def take_colours(self) -> None:
        """Show the state of the step in the colour of its mark."""
        if self._shown is not None:
            self.show_state(self._shown)
