"""Selection and edits of the dots of a frame. Without Qt.

Every edit is one of `labapp.core.rows.correction`, and one step of undo in the session.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from labapp.core.images.dots import Image
from labapp.core.pipeline import Settings
from labapp.core.rows import correction as core
from labapp.core.rows.correction import Correction
from labapp.core.rows.lattice import Site
from labapp.core.values import FloatArray, IntArray
from labapp.gui.pages.dots import picking
from labapp.gui.tasks import PROBLEM
from labapp.text import pluralize

Commit = Callable[[str, Callable[[], Correction | None]], bool]
"""Makes an edit, one step of that name; reports an error and returns False if refused."""

REASONS = 3
"""Most dots that are not numbered whose reasons are named."""

NOTHING: IntArray = np.zeros(0, np.int64)


class Editor:
    """Editing of one frame: selection, drag in progress, and edits.

    The edits expect that what they need is there, see `presenter.unmet_need`.
    """

    def __init__(self, commit: Commit) -> None:
        self._commit = commit
        self.correction: Correction | None = None
        """Displayed dots and rows; None if there are none."""
        self.selection = NOTHING
        """Indices of the selected dots, ascending."""
        self.shift_px: FloatArray = np.zeros(2)
        """Displacement of the selected dots by a drag or held key in progress, shape (2,), px."""
        self.refusal = ""
        """Why the last edit of these dots was refused; empty if it was made."""

    def show(self, correction: Correction | None, same_frame: bool) -> None:
        """Show a correction; the selection is kept for the same frame unless dots were removed."""
        before = self.correction
        self.correction = correction
        stays = same_frame and before is not None and correction is not None
        if not stays or before is None or correction is None:
            self.selection, self.shift_px, self.refusal = NOTHING, np.zeros(2), ""
        elif len(before.dots) != len(correction.dots):
            self.selection = self.selection[self.selection < len(correction.dots)]
            if len(before.dots) > len(correction.dots):
                self.selection = NOTHING

    @property
    def dots_px(self) -> FloatArray:
        """Drawn positions of the dots, shape (n, 2), px, including a drag in progress."""
        if self.correction is None:
            return np.zeros((0, 2))
        place = self.correction.dots.image_px.copy()
        place[self.selection] += self.shift_px
        return place

    # --- choosing -----------------------------------------------------------------------------

    def at(self, u: float, v: float, within_px: float) -> int | None:
        """Index of the dot at a position; None if there is none."""
        return picking.nearest(self.dots_px, u, v, within_px)

    def click(self, u: float, v: float, within_px: float, add: bool) -> None:
        """Select the dot at a position; with ``add``, toggle it in the selection."""
        dot = self.at(u, v, within_px)
        if dot is None:
            self.selection = self.selection if add else NOTHING
        elif add:
            self.selection = np.setxor1d(self.selection, [dot])
        else:
            self.selection = np.array([dot])

    def box(self, one: tuple[float, float], other: tuple[float, float], add: bool) -> None:
        """Select the dots in a box."""
        inside = picking.in_box(self.dots_px, one, other)
        self.selection = np.union1d(self.selection, inside) if add else inside

    def choose_rows(self, rows: list[int]) -> None:
        """Select all dots of some rows; row 0 contains the doubtful dots."""
        if self.correction is not None:
            self.selection = np.flatnonzero(np.isin(self.correction.lattice.row, rows))

    def choose_all(self) -> None:
        """Select every dot."""
        self.selection = np.arange(len(self.dots_px))

    def choose_doubtful(self) -> None:
        """Select the dots without a row or column."""
        if self.correction is not None:
            self.selection = np.flatnonzero(~self.correction.sited)

    def choose_none(self) -> None:
        """Clear the selection."""
        self.selection = NOTHING

    def choose_next(self, step: int) -> None:
        """Select the next or previous dot: row by row from the bottom, left to right."""
        if self.correction is None or not len(self.correction.dots):
            return
        lattice = self.correction.lattice
        order = np.lexsort((self.correction.dots.u_px, lattice.column, lattice.row))
        places = np.flatnonzero(np.isin(order, self.selection)).tolist()
        from_none = -1 if step > 0 else 0
        at = (places[-1] if step > 0 else places[0]) if places else from_none
        self.selection = order[[(at + step) % len(order)]]

    @property
    def rows(self) -> list[int]:
        """Rows of the selected dots, ascending."""
        if self.correction is None:
            return []
        rows = np.unique(self.correction.lattice.row[self.selection])
        return [int(k) for k in rows[rows > 0]]

    # --- edits --------------------------------------------------------------------------------

    def add(self, image: Image, u: float, v: float, settings: Settings) -> bool:
        """Add the dot at the pointer, numbered by its neighbours if they determine its site."""

        def edit(correction: Correction) -> Correction:
            added = core.add_dot(correction, image, u, v, settings.dots.band_pass)
            own = np.array([len(added.dots) - 1])
            try:
                return picking.numbered_by_neighbours(added, own)[0]
            except ValueError:
                return added

        if not self._edit("add a dot", edit):
            return False
        self.selection = np.array([len(self.dots_px) - 1])
        return True

    def delete(self) -> bool:
        """Delete the selected dots."""
        chosen = self.selection
        done = self._edit(_of("delete", chosen), lambda c: core.delete_dots(c, chosen))
        self.selection = NOTHING if done else self.selection
        return done

    def drop(self) -> bool:
        """Move the selected dots by `shift_px`."""
        (du, dv), chosen = self.shift_px.tolist(), self.selection
        self.shift_px = np.zeros(2)
        if du == dv == 0:
            return False
        return self._edit(_of("move", chosen), lambda c: core.move_dots(c, chosen, du, dv))

    def assign(self, row: int | None = None, column: int | None = None) -> bool:
        """Set the row, the column or both of the selected dots."""
        chosen, what = self.selection, "row" if column is None else "column"
        label = f"{what} of {pluralize(len(chosen), 'dot')}"
        return self._edit(label, lambda c: core.assign(c, chosen, row, column))

    def number(self) -> bool:
        """Set the row and column of the selected dots from their neighbours, where these do.

        Those that could not be numbered stay selected, and `refusal` says why.
        """
        chosen, unnumbered = self.selection, dict[int, str]()

        def edit(correction: Correction) -> Correction:
            made, left = picking.numbered_by_neighbours(correction, chosen)
            unnumbered.update(left)
            return made

        done = self._edit("number dots by their neighbours", edit)
        if unnumbered:
            self.selection = np.array(list(unnumbered), np.int64)
            done_words = f"{len(chosen) - len(unnumbered)} of {len(chosen)} dots are numbered"
            reasons = list(unnumbered.values())
            more = len(reasons) - REASONS
            parts = [*reasons[:REASONS], *([f"{more} more for such reasons"] if more > 0 else [])]
            self.refusal = f"{PROBLEM} {done_words}. In doubt: {'; '.join(parts)}"
        return done

    def put_in_doubt(self) -> bool:
        """Mark the selected dots as doubtful: without row and column."""
        chosen = self.selection
        return self._edit(_of("put in doubt", chosen), lambda c: core.clear_rows(c, chosen))

    def shift(self, columns: int) -> bool:
        """Shift the rows of the selected dots by columns, to the right if positive."""
        rows = self.rows

        def edit(correction: Correction) -> Correction:
            # Each shift may renumber rows, so all start from the original numbers.
            for row in rows:
                correction = core.shift_row(correction, row, columns)
            return correction

        way = "right" if columns > 0 else "left"
        return self._edit(f"shift {_named(rows)} {way}", edit)

    def split(self, above: bool = True) -> bool:
        """Split the row of the selected dot: the dot and those to its right form a new row."""
        chosen = self.selection

        def edit(correction: Correction) -> Correction:
            dot = int(chosen[0])
            lattice = correction.lattice
            return core.split_row(
                correction, int(lattice.row[dot]), int(lattice.column[dot]), above
            )

        return self._edit(f"split {_named(self.rows)}", edit)

    def merge(self) -> bool:
        """Merge the two rows of the selected dots."""
        rows = self.rows
        return self._edit(
            f"merge {_named(rows)}", lambda c: core.merge_rows(c, rows[1], into=rows[0])
        )

    def block(self) -> bool:
        """Mark the rows of the selected dots as blocked by the torch, or unmark them if all are."""
        rows, correction = self.rows, self.correction
        marked = correction is not None and set(rows) <= correction.lattice.blocked_rows

        def edit(correction: Correction) -> Correction:
            for row in rows:
                correction = core.block_row(correction, row, not marked)
            return correction

        return self._edit(f"{'un' if marked else ''}block {_named(rows)}", edit)

    def set_reference(self, site: Site | None) -> bool:
        """Set the site of the reference; None: determine it automatically."""
        return self._edit("reference", lambda c: core.set_reference(c, site))

    def point_at_reference(self, u: float, v: float) -> bool:
        """Set the site at a position as the reference."""

        def edit(correction: Correction) -> Correction:
            found = picking.site_at(correction, u, v)
            if found is None:
                raise ValueError("without rows the reference's row and column are not known")
            return core.set_reference(correction, found[0])

        return self._edit("reference", edit)

    def back_to_automatic(self) -> bool:
        """Remove the correction."""
        return self._commit("back to automatic", lambda: None)

    def _edit(self, label: str, edit: Callable[[Correction], Correction]) -> bool:
        correction = self.correction

        def made() -> Correction:
            if correction is None:
                raise ValueError("the dots of this frame are still being looked for")
            return edit(correction)

        return self._commit(label, made)


def _of(what: str, dots: IntArray) -> str:
    return f"{what}: {pluralize(len(dots), 'dot')}"


def _named(rows: list[int]) -> str:
    return f"row{'s' * (len(rows) != 1)} {', '.join(map(str, rows))}".strip()
