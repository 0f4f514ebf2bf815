"""Dots → Lattice, by the default search or by one of the dissertation's two (§5.2.2, §5.3)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from labapp.core.images.dots import Dots
from labapp.core.rows.lattice import Lattice
from labapp.core.rows.lattice_growth import GrowSettings, grow_lattice
from labapp.core.rows.row_search import MaskRowsSettings, RowSearchSettings, mask_rows, search_rows


@dataclass(frozen=True)
class LatticeSettings:
    """Choice of the search for rows and columns, and the settings of each.

    Parameters
    ----------
    method
        ``grow`` (the default), ``rows`` (§5.2.2) or ``masks`` (§5.3).
    grow, rows, masks
        Settings of each; only those of ``method`` are used.
    """

    method: Literal["grow", "rows", "masks"] = "grow"
    grow: GrowSettings = field(default_factory=GrowSettings)
    rows: RowSearchSettings = field(default_factory=RowSearchSettings)
    masks: MaskRowsSettings = field(default_factory=MaskRowsSettings)


def find_lattice(dots: Dots, frame_shape: tuple[int, int], settings: LatticeSettings) -> Lattice:
    """Find the rows and columns of dots in a frame of the given height and width, px.

    Raises
    ------
    CannotMeasure
        ``too-few-dots`` or ``no-rows`` if no rows can be found.
    """
    if settings.method == "rows":
        return search_rows(dots, settings.rows)
    if settings.method == "masks":
        return mask_rows(dots, frame_shape, settings.masks)
    return grow_lattice(dots, settings.grow)
