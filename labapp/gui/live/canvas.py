"""The parts of a live camera's view: picture, surface, trends, and streams to other programs."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtWidgets import QStackedWidget, QTabBar, QWidget

from labapp.gui.live.figures import AlarmStrip
from labapp.gui.live.streams import LiveStreams
from labapp.gui.live.surface import LiveSurface
from labapp.gui.live.trends import LiveTrends
from labapp.gui.views.picture import PictureView
from labapp.gui.widgets.layouts import scrolled, vbox
from labapp.gui.workspace import Workspace
from labapp.run.live_measuring import LiveResult
from labapp.run.live_watch import LiveWatch

PARTS = {
    "picture": ("Picture", "What the camera sees"),
    "surface": ("Surface", "The pool in 3-D as it is measured"),
    "trends": ("Trends and limits", "Sizes of the last seconds, and the limits that raise alarms"),
    "streams": ("Control software", "Send measures to other programs"),
}


class LiveCanvas(QWidget):
    """A page's picture, and further parts to choose from while a camera is measured."""

    def __init__(
        self,
        workspace: Workspace,
        picture: PictureView,
        watch: Callable[[], LiveWatch | None],
        acknowledge: Callable[[], None],
    ) -> None:
        super().__init__()
        self._watch = watch
        self.alarms = AlarmStrip(acknowledge)
        self.surface = LiveSurface()
        self.trends = LiveTrends(workspace)
        self.streams = LiveStreams(workspace, watch)
        self.tabs = QTabBar()
        self.tabs.setAccessibleName("What is seen of the live camera")
        self.tabs.setDrawBase(False)
        for k, (words, tip) in enumerate(PARTS.values()):
            self.tabs.addTab(words)
            self.tabs.setTabToolTip(k, tip)
        self.stack = QStackedWidget()
        for part in (picture, self.surface, self.trends, scrolled(self.streams)):
            self.stack.addWidget(part)
        self.tabs.currentChanged.connect(self._choose)
        # Alarms are at the bottom, so that nothing above them moves.
        vbox(self.tabs, (self.stack, 1), self.alarms, of=self).setSpacing(2)
        self.set_live(False)

    @property
    def part(self) -> str:
        """The visible part: a key of `PARTS`."""
        return list(PARTS)[self.stack.currentIndex()]

    def set_live(self, live: bool) -> None:
        """Offer all parts while a camera is measured, otherwise only the picture.

        A surface of a former camera or set-up disappears.
        """
        self.tabs.setVisible(live)
        if live:
            self.surface.clear()
            self.trends.refresh()
            self.streams.begin()
        else:
            self.tabs.setCurrentIndex(0)
            self.surface.release()
            self.alarms.keep_unacknowledged()
            self.streams.show_state()

    def follow(self, result: LiveResult | None, watch: LiveWatch) -> bool:
        """Show a new result at the camera's pace; returns whether something new was shown."""
        return self.surface.isVisible() and self.surface.follow(result, watch)

    def show_status(self, watch: LiveWatch) -> None:
        """Show the information that is updated a few times per second."""
        self.alarms.show_alarms(watch.alarms.shown)
        if self.trends.isVisible():
            self.trends.show_trend(watch)
        elif self.streams.isVisible():
            self.streams.show_state()

    def _choose(self, index: int) -> None:
        if self.part == "surface":
            self.surface.clear()
        self.stack.setCurrentIndex(index)
        watch = self._watch()
        if watch is not None:
            self.show_status(watch)
