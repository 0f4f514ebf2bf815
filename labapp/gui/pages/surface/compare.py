"""Two schemes side by side: surfaces with a common camera, difference, and figures."""

from __future__ import annotations

from PySide6.QtCore import Qt
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QHeaderView, QWidget
from threadpoolctl import threadpool_limits

from labapp.gui.pages.surface.comparison import Comparison, compared, other_scheme
from labapp.gui.pages.surface.presenter import SCHEME_CHOICES, Options
from labapp.gui.tasks import Control, Task
from labapp.gui.views.view3d import View3d
from labapp.gui.views.view3d_kinds import make_view3d
from labapp.gui.widgets.fields import ChoiceField
from labapp.gui.widgets.labels import wrapping_label
from labapp.gui.widgets.layouts import column_of, hbox, row_of, vbox
from labapp.gui.widgets.parts import PartsBar
from labapp.gui.widgets.tables import ReadTable
from labapp.gui.workspace import Workspace

COLUMNS = ("", "First", "Second", "Difference", "Unit")
NUMBERS = (1, 2, 3)
"""Columns with numbers."""


class CompareView(QWidget):
    """The frame in view reconstructed by two schemes; all views share one camera."""

    def __init__(self, workspace: Workspace) -> None:
        super().__init__()
        self.workspace = workspace
        self.first, self.second = (_SchemeBox(order) for order in ("First", "Second"))
        self.difference = make_view3d("Difference of the two surfaces")
        self.words = wrapping_label()
        self.table = _FiguresTable()
        self._options = Options()
        self._shown_for: object = None
        self._task: Task | None = None
        for view in self.views:
            for other in self.views:
                if other is not view:
                    view.camera_changed.connect(other.set_camera)
        for box in (self.first, self.second):
            box.choice.edited.connect(lambda _: self.refresh(self._options))
        figures = column_of(self.words, (self.table, 1))
        surfaces = row_of((self.first, 1), (self.second, 1))
        below = row_of((self.difference, 1), (figures, 1))
        self.parts = PartsBar(
            "What is seen of the comparison",
            {
                "First": (surfaces, self.first),
                "Second": (surfaces, self.second),
                "Difference": (below, self.difference),
                "Figures": (below, figures),
            },
        )
        vbox(self.parts, (surfaces, 1), (below, 1), of=self)

    @property
    def views(self) -> tuple[View3d, View3d, View3d]:
        """The first surface, the second, and their difference."""
        return self.first.view, self.second.view, self.difference

    def begin(self, scheme: str) -> None:
        """Compare a scheme with one of a different kind."""
        self.first.choice.set_value(scheme)
        self.second.choice.set_value(other_scheme(scheme))

    def refresh(self, options: Options) -> None:
        """Reconstruct the frame in view by both schemes in the background, and show it."""
        session, frame = self.workspace.session, self.workspace.frame
        assert session is not None
        schemes = (self.first.choice.value(), self.second.choice.value())
        result = session.result(frame)
        wanted = (frame, schemes, options, None if result is None else result.measured)
        if wanted == self._shown_for:
            return
        self._shown_for, self._options = wanted, options
        self.words.setText("Computing…")
        self.table.setEnabled(False)  # its figures are still those of another frame
        if self._task is not None:
            self._task.cancel()

        def work(_: Control) -> Comparison:
            # The matrices are small, and several threads would slow the window.
            with threadpool_limits(limits=1, user_api="blas"):
                return compared(session, frame, schemes, options)

        def done(comparison: Comparison) -> None:
            if self._shown_for == wanted:
                self._show(comparison)

        self._task = self.workspace.tasks.start("Comparing", work, done)

    def leave(self) -> None:
        """Stop all that only this view needs."""
        self._shown_for = None
        if self._task is not None:
            self._task.cancel()
            self._task = None

    def _show(self, comparison: Comparison) -> None:
        for box, scene, why in zip(
            (self.first, self.second), comparison.scenes, comparison.words, strict=True
        ):
            box.view.set_words(why)
            box.view.show_scene(scene)
        self.difference.set_words("Nothing to compare")
        self.difference.show_scene(comparison.difference)
        self.words.setText(comparison.text)
        self.table.setRowCount(len(comparison.rows))
        for k, row in enumerate(comparison.rows):
            for column, text in enumerate(row):
                number = column in NUMBERS
                tip = f"{row[0]}: {text} {row[4] if number else ''}".strip()
                self.table.set_cell(k, column, text, number=number, tip=tip)
        self.table.resizeRowsToContents()
        self.table.setEnabled(True)
        self._make_room()

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Show all figures if there is space."""
        super().resizeEvent(event)
        self.parts.fit(self)
        self._make_room()

    def _make_room(self) -> None:
        wanted = self.table.full_height
        self.table.setMinimumHeight(min(wanted, self.height() * 2 // 5))


class _SchemeBox(QWidget):
    """Choice of a scheme, and its surface."""

    def __init__(self, order: str) -> None:
        super().__init__()
        self.choice = ChoiceField(order, SCHEME_CHOICES, tooltip=f"{order} of the two to compare")
        self.view = make_view3d(f"{order} surface")
        vbox(hbox(self.choice.label, (self.choice, 1)), (self.view, 1), of=self)


class _FiguresTable(ReadTable):
    """Sizes and errors of both schemes, and the first minus the second."""

    def __init__(self) -> None:
        name = "Figures of both schemes and their difference"
        super().__init__(name, "Figures of both schemes, and the first minus the second", COLUMNS)
        self.setWordWrap(False)
        # All columns fit, and a scroll bar would take the space of a row.
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        # Numbers with their ± have the width that they need.
        self.horizontalHeader().setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
