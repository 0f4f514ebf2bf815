"""How pictures for paper look: black on white, small, the same bytes each time."""

from __future__ import annotations

import colorsys
import io

from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

INCHES = 6.7
"""Width of a page's text."""

STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "axes.linewidth": 0.6,
    "axes.edgecolor": "0.3",
    "lines.linewidth": 0.8,
    "savefig.facecolor": "white",
    # The same picture is the same file.
    "svg.hashsalt": "labapp",
}
"""Drawn and written within ``rc_context`` of it."""


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of a size in inches, without a window."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def as_bytes(figure: Figure, kind: str = "png", dpi: int = 120) -> bytes:
    """A figure as PNG or SVG, without date or the program that drew it: the same each time."""
    content = io.BytesIO()
    with rc_context(STYLE):
        metadata = {"Software": None} if kind == "png" else {"Date": None}
        figure.savefig(content, format=kind, dpi=dpi, metadata=metadata)
    return content.getvalue()


def row_colour(row: int) -> tuple[float, float, float]:
    """A colour that is dark enough on white and differs most between neighbouring rows."""
    return colorsys.hsv_to_rgb(row * 0.381966 % 1, 0.9, 0.65)
