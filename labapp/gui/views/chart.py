"""A single plot with text above it: zoom, values under the pointer, copying and saving."""

from __future__ import annotations

from PySide6.QtCore import QEvent, QPointF, Qt
from PySide6.QtGui import QPalette
from PySide6.QtWidgets import QVBoxLayout

from labapp.gui.views.axes import make_plot, paint_axes
from labapp.gui.views.canvas import Plotted
from labapp.gui.views.picture_files import save_plot
from labapp.gui.widgets.buttons import add_menu
from labapp.gui.widgets.labels import plain_label, wrapping_label

KEYS = "+ − zoom, F shows all"


class Chart(Plotted):
    """One plot with a line of text above it, in the colours of the theme.

    Parameters
    ----------
    unit
        Unit of the values under the pointer, with a leading space.
    """

    def __init__(
        self, name: str, x_label: str, y_label: str, equal: bool, unit: str = " mm"
    ) -> None:
        super().__init__(name, KEYS)
        self._unit = unit
        self.setToolTip(f"{name}: wheel to zoom, drag to move; {KEYS}")
        self.title = wrapping_label(name)
        self.plot = self.canvas = make_plot(x_label, y_label, equal)
        self.plot.setMinimumSize(88, 80)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(1, 1, 1, 1)
        layout.setSpacing(0)
        layout.addWidget(self.title)
        layout.addWidget(self.plot)
        self._at = plain_label(parent=self.plot)
        self._at.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self._at.hide()
        self.plot.scene().sigMouseMoved.connect(self._moved_to)
        add_menu(
            self,
            ("Copy picture", self.copy_picture),
            ("Save picture…", save_plot(self, self.plot, "chart")),
            ("Show all", self.fit),
        )

    def fit(self) -> None:
        """Show all."""
        self.plot.autoRange()

    def zoom(self, factor: float) -> None:
        """Zoom about the centre; a factor above 1 enlarges."""
        self.plot.getViewBox().scaleBy((1 / factor, 1 / factor))

    def _moved_to(self, at: QPointF) -> None:
        """Show the values under the pointer."""
        box = self.plot.getViewBox()
        inside = box.sceneBoundingRect().contains(at)
        place = box.mapSceneToView(at)
        self._at.setText(f"{place.x():.3g}, {place.y():.3g}{self._unit}".replace("-", "−"))
        self._at.adjustSize()
        self._at.move(self.plot.width() - self._at.width() - 4, 2)
        self._at.setVisible(inside)

    def leaveEvent(self, event: QEvent) -> None:
        """Hide the values."""
        self._at.hide()
        super().leaveEvent(event)

    def say(self, words: str) -> None:
        """Show text above the plot."""
        self.title.setText(words)
        self.describe(words)

    def take_colours(self) -> None:
        """Use the colours of the theme."""
        palette = self.palette()
        self.text = palette.color(QPalette.ColorRole.Text)
        self.accent = palette.color(QPalette.ColorRole.Highlight)
        self.plot.setBackground(palette.color(QPalette.ColorRole.Base))
        paint_axes(self.plot, self.text, self.text)
