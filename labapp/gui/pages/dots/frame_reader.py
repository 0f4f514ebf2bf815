"""Background tasks of the dots page: reading, detection, propagation of corrections."""

from __future__ import annotations

from PySide6.QtCore import QObject, QTimer, Signal

from labapp.core.rows.correction import Correction
from labapp.errors import InputError
from labapp.gui.pages.dots import presenter
from labapp.gui.pages.dots.presenter import DetectedDots, DotsState
from labapp.gui.pages.page import Page
from labapp.gui.shell.steps import recording_gone, why_not_measurable
from labapp.gui.tasks import PROBLEM, Control, Task
from labapp.gui.widgets.labels import Message
from labapp.gui.workspace import Workspace
from labapp.media import GreyImage

REST_MS = 120
"""Time, ms, that a frame stays in view before its dots are detected."""


class FrameReader(QObject):
    """Reads the frame in view, and detects its dots if the session has none.

    One task runs at a time; when it ends, the last request is processed.

    Attributes
    ----------
    frame
        Number of the last frame read.
    image
        That frame; None if it could not be read.
    why
        Reason why it could not be read.
    found
        Last detected dots.
    """

    ready = Signal()
    """New data can be shown."""

    def __init__(self, workspace: Workspace) -> None:
        super().__init__()
        self._space = workspace
        self._task: Task | None = None
        self._rest = QTimer(self, singleShot=True, interval=REST_MS)
        self._rest.timeout.connect(self._look)
        self.forget()
        workspace.opened.connect(self.forget)

    def forget(self) -> None:
        """Discard all data after another session was opened."""
        self.frame: int | None = None
        self.image: GreyImage | None = None
        self.why = ""
        self.found: DetectedDots | None = None
        self._rest.stop()

    def read(self, frame: int) -> None:
        """Read a frame."""
        session = self._space.session
        if session is None or self._busy:
            return
        self._rest.stop()

        def work(_: Control) -> tuple[int, GreyImage | None, str]:
            try:
                return frame, session.frame(frame).image, ""
            except InputError as error:
                return frame, None, recording_gone(session) or str(error)

        def done(read: tuple[int, GreyImage | None, str]) -> None:
            self.frame, self.image, self.why = read
            self.ready.emit()

        self._task = self._space.tasks.start(f"Reading frame {frame}", work, done)

    def look(self) -> None:
        """Detect dots in the last frame read, if it stays in view."""
        if not self._busy and not self._rest.isActive():
            self._rest.start()

    def stop(self) -> None:
        """Cancel pending detection."""
        self._rest.stop()

    @property
    def _busy(self) -> bool:
        return self._task in self._space.tasks.active

    def _look(self) -> None:
        session, image, frame = self._space.session, self.image, self.frame
        if session is None or image is None or frame is None or self._busy:
            return
        if not presenter.needs_dots(session, frame):
            return
        by = session.settings.dots, session.settings.lattice

        def done(found: DetectedDots) -> None:
            self.found = found
            self.ready.emit()

        self._task = self._space.tasks.start(
            "Looking for dots", lambda control: presenter.detect(image, frame, by, control), done
        )


def carry_on(page: Page, seen: DotsState, most: int | None, answer: Message) -> None:
    """Propagate the correction of a frame to later frames, one step of undo; then measure."""
    workspace, session = page.workspace, page.session

    def finished(carried: tuple[dict[int, Correction], str]) -> None:
        corrections, words = carried
        if not corrections:
            workspace.notified.emit(words, True)
            answer.setText(f"{PROBLEM} {words}")
            return
        label = f"carry frame {seen.frame} on over {len(corrections)}"
        if not workspace.attempt(lambda session: session.correct(corrections, label)):
            return
        page.confirm(words, answer)
        if not why_not_measurable(session):
            workspace.measure(list(corrections), show_answer=page.answer.setText)

    page.start_task(
        "Carrying on",
        lambda control: presenter.carry(session, seen, most, control),
        finished,
        answer=answer,
        once=True,
    )
