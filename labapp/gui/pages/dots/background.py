"""What the dots page does in the background: read, look for dots, fit again, carry on."""

from __future__ import annotations

from PySide6.QtCore import QObject, Signal

from labapp.errors import InputError
from labapp.gui.pages.dots import presenter
from labapp.gui.pages.dots.presenter import Carried, Found, Shown
from labapp.gui.tasks import Control, Task
from labapp.gui.workspace import Workspace
from labapp.media import GreyImage


class Looking(QObject):
    """Reads the frame in view, and looks for dots where the session knows none.

    One task at a time: when it ends, what is wanted by then comes next.

    Signals
    -------
    ready
        There is something new to show.

    Attributes
    ----------
    frame
        Number of the frame that was read last.
    image
        That frame; None where it could not be read.
    why
        Why not.
    found
        What was found last.
    """

    ready = Signal()

    def __init__(self, workspace: Workspace) -> None:
        super().__init__()
        self._space = workspace
        self._task: Task | None = None
        self.forget()
        workspace.opened.connect(self.forget)

    def forget(self) -> None:
        """Another session is open."""
        self.frame: int | None = None
        self.image: GreyImage | None = None
        self.why = ""
        self.found: Found | None = None
        self._task = None

    def want(self, frame: int) -> None:
        """See to it that a frame, and dots in it, are there to show."""
        session = self._space.session
        if session is None or (self._task is not None and self._task in self._space.tasks.active):
            return
        by = presenter.wanted(session, frame)
        known = self.found is not None and by == (self.found.frame, *self.found.by)
        if self.frame == frame and (by is None or known or self.image is None):
            return
        kept = self.image if self.frame == frame else None

        def work(control: Control) -> Found | None:
            image = kept
            if image is None:
                try:
                    image = session.frame(frame).image
                except InputError as error:
                    control.part((frame, None, str(error)))
                    return None
                control.part((frame, image, ""))
            return None if by is None else presenter.detect(image, frame, by[1:])

        title = f"Reading frame {frame}" if kept is None else "Looking for dots"
        self._task = self._space.tasks.start(title, work, self._done, self._read)

    def stop(self) -> None:
        """Give up what is under way."""
        if self._task is not None:
            self._task.cancel()

    def _read(self, part: tuple[int, GreyImage | None, str]) -> None:
        self.frame, self.image, self.why = part
        self.ready.emit()

    def _done(self, found: Found | None) -> None:
        self.found = found or self.found
        self._task = None
        self.ready.emit()


class Refit:
    """Measures a frame anew whenever its dots or rows were changed by hand.

    One fit at a time: an edit made meanwhile makes another follow, of what the frame has then.

    Attributes
    ----------
    pending
        Whether a fit is under way.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._space = workspace
        self._task: Task | None = None
        self._failed: tuple[int, object] | None = None

    @property
    def pending(self) -> bool:
        """Whether a fit is under way."""
        return self._task is not None and self._task in self._space.tasks.active

    def want(self, frame: int) -> None:
        """Fit a frame if what it was measured from has been changed."""
        session = self._space.session
        if session is None or self.pending or not presenter.needs_fit(session, frame):
            return
        # A fit that was refused or cancelled is not begun again until something else is tried.
        state = (frame, session.history)
        if state == self._failed or presenter.why_no_fit(session):
            return
        self._failed = state
        self._task = self._space.measure([frame])


def carry_on(workspace: Workspace, seen: Shown, most: int | None) -> None:
    """Carry the correction of a frame on, one step that can be undone; then measure."""
    session = workspace.session
    assert session is not None

    def finished(carried: Carried) -> None:
        if carried.corrections and not workspace.attempt(
            lambda session: session.correct(
                carried.corrections, f"carry frame {seen.frame} on over {len(carried.corrections)}"
            )
        ):
            return
        workspace.said.emit(carried.words, not carried.corrections)
        if carried.corrections and not presenter.why_no_fit(session):
            workspace.measure(list(carried.corrections))

    workspace.tasks.start(
        "Carrying on", lambda control: presenter.carry(session, seen, most, control), finished
    )
