"""Fields of the recording page for the frames to import, and the session to import into."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import Signal

from labapp.gui.pages.capture.presenter import Choice, Preview, choice_text, refusal
from labapp.gui.widgets.buttons import button, check_box
from labapp.gui.widgets.fields import FieldForm, NumberField, whole
from labapp.gui.widgets.labels import Message, offer, selectable_label
from labapp.gui.widgets.layouts import Group, fill, hbox
from labapp.session.session import Session

MOST_HZ = 1e7

REPLACED = "The session has a recording already: Import puts this one in its place."
MEASURED = (
    "Frames of the session's recording are measured or corrected: another "
    "recording needs its own session."
)

NEXT = "New session from this recording…"
NEXT_TIP = "Make a session with the same set-up and calibration, and import it there"


class ImportChoice(Group):
    """Frames to import; visible during the preview of a recording."""

    edited = Signal()
    """The choice changed."""

    def __init__(
        self,
        do_import: Callable[[], object],
        begin_next: Callable[[], object],
        leave: Callable[[], object],
    ) -> None:
        super().__init__("To be imported")
        self.source_words, self.replace_words = selectable_label(), selectable_label()
        self.embed = check_box(
            "Keep the frames in the session",
            "The session then needs no other file, and is about as large as the recording; "
            "otherwise the recording stays where it is and must not be changed",
            lambda _: self.edited.emit(),
        )
        self.choice_words = Message(2)
        tip = "Read it once from end to end, and add its frames"
        self.import_button = button("Import", tip, do_import)
        self.import_button.setDefault(True)
        stop = button("Discard", "Leave it, and see the session's frames", leave)
        self.next_button = button(NEXT, NEXT_TIP, begin_next)
        fill(
            self.column,
            *(self.source_words, self._form(), self.embed, self.choice_words),
            *(hbox(self.import_button, stop), self.next_button, self.replace_words),
        )
        self.hide()

    def _form(self) -> FieldForm:
        self.first = whole("First frame", 0, "The first frame to use, counted from 0")
        self.last = whole("Last frame", 0, "The last frame to use")
        self.every = whole("Every n-th", 1, "1: every frame; 2: every second one…")
        tip = (
            "The rate it was filmed at, where the recording does not say so, or says it "
            "wrongly; empty: the recording's own"
        )
        self.rate = NumberField(
            "Frame rate", "frames/s", lowest=1e-6, highest=MOST_HZ, optional=True, tooltip=tip
        )
        fields = self.first, self.last, self.every, self.rate
        for field in fields:
            field.edited.connect(lambda _: self.edited.emit())
        return FieldForm(*fields)

    def begin(self, preview: Preview) -> None:
        """Start with all frames of a recording."""
        last = preview.frames - 1
        for field, value in ((self.first, 0), (self.last, last), (self.every, 1)):
            field.highest = max(field.lowest, last)
            field.set_value(value)
        self.rate.set_value(None)
        message = "\n".join([preview.description, *(f"⚠ {each}" for each in preview.warnings)])
        self.source_words.setText(f"{preview.path.name}\n{message}")

    def choice(self) -> Choice:
        """The current choice."""
        first, last, every = (
            int(field.value() or 0) for field in (self.first, self.last, self.every)
        )
        return Choice(first, last, max(1, every), self.rate.value(), self.embed.isChecked())

    def show_choice(
        self, session: Session | None, preview: Preview | None, working: bool, measured: bool
    ) -> None:
        """Show what would be imported, or the reason why it cannot be.

        ``measured``: frames of the session are measured or corrected.
        """
        choice = None if preview is None else self.choice()
        why_not = refusal(session, choice, working)
        self.setVisible(preview is not None)
        has_one = session is not None and session.recording is not None
        wants_own = has_one and measured
        self.import_button.setDefault(not wants_own)
        self.next_button.setDefault(wants_own)
        offer(self.import_button, why_not or (MEASURED if wants_own else ""))
        if preview is not None and choice is not None:
            words = choice_text(preview, choice)
            self.choice_words.setText(f"{words}. {why_not}" if why_not else words)
        self.replace_words.setText(MEASURED if measured else REPLACED)
        self.replace_words.setVisible(has_one and not why_not)
        self.next_button.setVisible(has_one)
        self.next_button.setEnabled(choice is not None and choice.count > 0 and not working)
