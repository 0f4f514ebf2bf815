"""Grey levels of a picture: histogram, and profile along a line that can be dragged."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import QPoint, Qt, SignalInstance
from PySide6.QtWidgets import QDialog, QGraphicsItem, QWidget
from scipy.ndimage import map_coordinates

from labapp.core.values import FloatArray
from labapp.gui.views.chart import Chart
from labapp.gui.widgets.layouts import vbox
from labapp.media import GreyImage

LINE = "#ffb000"
SIZE_PX = (360, 400)
BINS = 128


def profile(grey: GreyImage, ends_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Levels along a line, interpolated linearly, at intervals of 1 px.

    Parameters
    ----------
    ends_px
        Ends (u, v) of the line, shape (2, 2).

    Returns
    -------
    tuple of arrays
        Distances from the first end, px, and levels; NaN outside the picture.
    """
    length = float(np.hypot(*(ends_px[1] - ends_px[0])))
    along = np.linspace(0.0, length, max(2, round(length) + 1))
    u, v = (ends_px[0] + np.outer(along / max(length, 1e-9), ends_px[1] - ends_px[0])).T
    levels = map_coordinates(grey.astype(float), [v, u], order=1, cval=np.nan)
    return along, levels


class Shown(Protocol):
    """View of a picture with overlays: a `picture.PictureView`."""

    @property
    def picture(self) -> GreyImage | None:
        """The picture; None if there is none."""

    @property
    def changed(self) -> SignalInstance:
        """Emitted when another picture is shown."""

    def add(self, item: QGraphicsItem) -> None:
        """Add an overlay."""

    def remove(self, item: QGraphicsItem) -> None:
        """Remove an overlay."""


class LevelsDialog(QDialog):
    """Histogram and line profile of a picture, updated with it."""

    def __init__(self, view: Shown, parent: QWidget) -> None:
        super().__init__(parent)
        self.setObjectName("picture-levels")
        self.setWindowTitle("Levels of the picture")
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        self._view = view
        self.histogram = Chart("Histogram", "Level", "Pixels, log₁₀(1 + n)", False, "")
        self.profile = Chart("Profile", "Along the line (px)", "Level", False, "")
        self._counts = self.histogram.plot.plot(stepMode="center", fillLevel=0, pen=None)
        self._levels = self.profile.plot.plot()
        rows, columns = (480, 640) if view.picture is None else view.picture.shape
        ends = [(0.2 * columns, rows / 2), (0.8 * columns, rows / 2)]
        self.line = pg.LineSegmentROI(ends, pen=pg.mkPen(LINE, width=2))
        view.add(self.line)
        self.line.sigRegionChanged.connect(lambda _: self._show_profile())
        view.changed.connect(self.show_levels)
        vbox((self.histogram, 1), (self.profile, 1), of=self)
        self.resize(*SIZE_PX)
        self.move(parent.mapToGlobal(QPoint(0, 0)))
        self.finished.connect(lambda _: view.remove(self.line))
        for chart in (self.histogram, self.profile):
            chart.follow_theme()
        self._counts.setBrush(pg.mkBrush(self.histogram.accent))
        self._levels.setPen(pg.mkPen(self.profile.accent, width=2))
        self.show_levels()

    def show_levels(self) -> None:
        """Show histogram and profile of the current picture."""
        grey = self._view.picture
        if grey is None:
            self._counts.setData([0, 1], [0])
            self.histogram.say("No picture")
        else:
            low, high = float(grey.min()), float(grey.max())
            counts, edges = np.histogram(grey, BINS, (low, max(high, low + 1)))
            self._counts.setData(edges, np.log10(1 + counts))
            self.histogram.say(f"Levels {low:g} to {high:g}, mean {float(grey.mean()):.1f}")
        self._show_profile()

    def _show_profile(self) -> None:
        grey = self._view.picture
        if grey is None:
            self._levels.setData([], [])
            return
        handles = [self.line.mapToParent(each["pos"]) for each in self.line.handles]
        ends = np.array([(at.x(), at.y()) for at in handles])
        along, levels = profile(grey, ends)
        self._levels.setData(along, levels, connect="finite")
        self.profile.say("Profile: drag the line in the picture, or its ends")
