"""Style of pictures for print: black on white, small, and reproducible byte by byte."""

from __future__ import annotations

import colorsys
import io
from collections.abc import Iterator
from contextlib import contextmanager

from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

INCHES = 6.7
"""Width of the text on a page."""

STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "axes.linewidth": 0.6,
    "axes.edgecolor": "0.3",
    "lines.linewidth": 0.8,
    "savefig.facecolor": "white",
    # Equal pictures give equal files.
    "svg.hashsalt": "labapp",
}
"""Parameters for ``rc_context``, in which pictures are drawn and written."""


@contextmanager
def new_figure(width: float, height: float) -> Iterator[Figure]:
    """An empty figure of a size in inches, without a window; drawn in `STYLE` by the block."""
    with rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


def as_bytes(figure: Figure, kind: str = "png", dpi: int = 120) -> bytes:
    """A figure as PNG or SVG without date or program name, so that the result is reproducible."""
    content = io.BytesIO()
    with rc_context(STYLE):
        metadata = {"Software": None} if kind == "png" else {"Date": None}
        figure.savefig(content, format=kind, dpi=dpi, metadata=metadata)
    return content.getvalue()


def row_colour(row: int) -> tuple[float, float, float]:
    """Colour that is dark enough on white and differs strongly between neighbouring rows."""
    return colorsys.hsv_to_rgb(row * 0.381966 % 1, 0.9, 0.65)
