"""Detection of the dots of one image without a set-up, for `labapp detect`."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from labapp.core.images.dots import Dots
from labapp.core.images.find_dots import DotSettings, find_dots
from labapp.core.rows.find_lattice import LatticeSettings, find_lattice
from labapp.core.rows.lattice import Lattice
from labapp.core.values import CannotMeasure
from labapp.errors import os_errors_as_input
from labapp.export.tables import PX_DIGITS, number
from labapp.files import write_atomically
from labapp.media import read_picture
from labapp.text import csv_text

COLUMNS = "u_px v_px reflected_row reflected_column snr u_sigma_px v_sigma_px".split()


def detect_dots(
    path: str | os.PathLike[str], dot_settings: DotSettings, lattice_settings: LatticeSettings
) -> tuple[Dots, Lattice | None, str]:
    """Find the dots of a source's first frame, and their rows and columns.

    Returns
    -------
    dots, lattice, doubt
        If rows and columns are not found, the lattice is None and the doubt gives the reason.

    Raises
    ------
    InputError
        If the source cannot be read.
    """
    image = read_picture(path)
    dots = Dots(*np.empty((7, 0)))
    try:
        dots = find_dots(image, dot_settings)
        return dots, find_lattice(dots, (image.shape[0], image.shape[1]), lattice_settings), ""
    except CannotMeasure as answer:
        return dots, None, str(answer)


def write_detected(path: Path, dots: Dots, lattice: Lattice | None) -> None:
    """Write the dots as CSV, atomically.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    rows: list[list[object]] = [
        [
            number(dots.u_px[k], PX_DIGITS),
            number(dots.v_px[k], PX_DIGITS),
            *(("", "") if lattice is None else (lattice.row[k] or "", lattice.column[k] or "")),
            number(dots.snr[k], PX_DIGITS),
            number(dots.u_sigma_px[k], PX_DIGITS),
            number(dots.v_sigma_px[k], PX_DIGITS),
        ]
        for k in range(len(dots))
    ]
    with os_errors_as_input(path, "--out", "a file that can be written"):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, csv_text([COLUMNS, *rows]).encode())
