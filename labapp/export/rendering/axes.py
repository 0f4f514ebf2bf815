"""Labels of a 3-D picture: numbers along the axes, the colour scale, captions.

They are drawn in screen coordinates, upright and of constant size; before every rendering they are
placed at the projections of their axes.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from labapp.core.values import FloatArray

USUAL_DPI = 72
"""Resolution at which a point of text is a pixel."""

NUMBER_PT, TITLE_PT, CAPTION_PT = 10, 11, 9
LETTER, LINE = 0.62, 1.3
"""Width of a letter and height of a line, relative to the font size."""

GAP_PT = 5.0
"""Gap between an edge, its numbers and its name."""

SHORT_PT = 24.0
"""Shortest projected edge that has numbers."""

STEEP = 0.8
"""Sine of the angle of an edge from which its name is written vertically."""

BAR_PT, BAR_SHARE, STRIPS = 13.0, 0.55, 128
"""Width of the colour scale; its fraction of the picture's height; number of its strips."""

NAMES = ("X (mm)", "Y, along the weld (mm)", "Z (mm)")
SLANT = 0.4
"""Component of a label's direction from which it is placed on that side of its anchor."""

CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])


class Label(NamedTuple):
    """A label: text, anchor in px from the lower left, and direction from the anchor."""

    words: str
    at_px: FloatArray
    way: tuple[float, float] = (0.0, 0.0)
    """Direction right and up, −1 to 1: (1, 0) is to the right of the anchor."""
    size_pt: int = NUMBER_PT
    upright: bool = False
    """Whether the text runs upwards."""
    plain: bool = True
    """Whether it has no background."""
    framed: bool = False
    """Whether it has a frame."""

    def edges(self, point_px: float) -> tuple[float, float, float, float]:
        """Return the left, lower, right and upper edge, px, for wide letters."""
        lines = self.words.split("\n")
        wide, tall = max(map(len, lines)) * LETTER, len(lines) * LINE
        if self.upright:
            wide, tall = tall, wide
        wide, tall = wide * self.size_pt * point_px, tall * self.size_pt * point_px
        (x, y), (across, up) = self.at_px, self.side
        left, low = x - wide * (0.5 - 0.5 * across), y - tall * (0.5 - 0.5 * up)
        return left, low, left + wide, low + tall

    def within(self, size_px: FloatArray, point_px: float) -> Label:
        """Return the label, moved into the picture."""
        left, low, right, high = self.edges(point_px)
        wide, tall = size_px
        x = max(2.0, min(left, wide - (right - left) - 2)) - left
        y = max(2.0, min(low, tall - (high - low) - 2)) - low
        return self._replace(at_px=self.at_px + np.array([x, y]))

    @property
    def side(self) -> tuple[int, int]:
        """Side of the anchor, −1, 0 or 1 to the right and up."""
        x, y = self.way
        return (x > SLANT) - (x < -SLANT), (y > SLANT) - (y < -SLANT)


def round_step(span: float, most: int) -> float:
    """Return the smallest of 1, 2, 5 × 10ⁿ that divides a span into at most ``most`` steps."""
    least = max(span, 1e-12) / max(most, 1)
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(k * power for k in (1, 2, 5, 10) if k * power >= least * (1 - 1e-9)))


def round_ticks(low: float, high: float, most: int) -> tuple[FloatArray, list[str]]:
    """Return round numbers within a range, ascending, and their texts."""
    step = round_step(high - low, most)
    ticks = step * np.arange(np.ceil(low / step - 1e-6), np.floor(high / step + 1e-6) + 1)
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    return ticks, [f"{tick + 0.0:.{decimals}f}".replace("-", "−") for tick in ticks.tolist()]


@functools.cache
def _font() -> str:
    """Return the font file, which is distributed with Matplotlib and has all symbols used."""
    import matplotlib

    return str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf")


class Overlay:
    """Labels and colour scale of a plotter."""

    def __init__(self, plotter: Any, colour: str) -> None:
        import pyvista

        self._plotter = plotter
        self._colour = pyvista.Color(colour).float_rgb
        self._texts: list[Any] = []
        self._written: list[Label | None] = []
        """Labels of the texts; None: hidden."""
        self._axes: list[Label] = []
        self._axes_made_for: object = None
        self._bar: Any = None
        self._bar_made_for: object = None
        self._bar_left = np.inf
        self.box_mm = np.zeros((2, 3))
        """Lowest and highest corner of the axes."""
        self.stretch = np.ones(3)
        self.scale: tuple[str, tuple[float, float], Any] | None = None
        """Label, range and VTK lookup table of the colours."""
        self.captions: dict[str, str] = {}
        """Texts by position: ``upper left``, ``lower left``, ``lower right``, ``middle``."""
        self.mark: tuple[FloatArray, str] | None = None
        """A point of the surface, shape (3,), mm, and its label."""
        self.upright_mm = np.zeros((2, 3))
        """Ends of the Z axis line."""

    @property
    def words(self) -> list[str]:
        """All texts in the picture as last drawn."""
        return [text.GetInput() for text in self._texts if text.GetVisibility()]

    @property
    def point_px(self) -> float:
        """Pixels per point of text."""
        return float(self._plotter.render_window.GetDPI()) / USUAL_DPI

    def place(self) -> None:
        """Place all labels for the present camera; this is called before every rendering."""
        size = np.array(self._plotter.renderer.GetSize(), float)
        if size.min() < 1:
            return
        others = [*self._scale(size), *self._captions(size)]
        if self.mark is not None:
            at, words = self.mark
            place = self.project(at[None] * self.stretch)[0]
            at_px = place + GAP_PT * self.point_px
            others.append(Label(words, at_px, (1, 1), TITLE_PT, plain=False))
        beside = size - [max(size[0] - self._bar_left, 0.0), 0.0]
        self._label_axes(beside)
        labels = [*self._axes, *(label.within(size, self.point_px) for label in others)]
        while len(self._texts) < len(labels):
            self._texts.append(self._new_text())
            self._written.append(None)
        for k, text in enumerate(self._texts):
            label = labels[k] if k < len(labels) else None
            if label is not self._written[k]:
                self._write(text, label)
                self._written[k] = label

    def project(self, points_mm: FloatArray) -> FloatArray:
        """Project drawn points, shape (n, 3), to px from the picture's lower left, shape (n, 2)."""
        return project(self._plotter.renderer, points_mm)

    def _apart(self, labels: list[Label], size: FloatArray) -> list[Label]:
        """Omit numbers that would overlap other labels."""
        labels = [label.within(size, self.point_px) for label in labels]
        names = [label for label in labels if label.size_pt == TITLE_PT]
        kept, taken = names, [name.edges(self.point_px) for name in names]
        for label in (one for one in labels if one.size_pt != TITLE_PT):
            left, low, right, high = edges = label.edges(self.point_px)
            if not any(
                left < other[2] and other[0] < right and low < other[3] and other[1] < high
                for other in taken
            ):
                kept.append(label)
                taken.append(edges)
        return kept

    # --- the axes ----------------------------------------------------------------------------

    def _label_axes(self, beside: FloatArray) -> None:
        """Label the axes, unless nothing has changed: this takes as long as the rendering."""
        arrays = view_matrix(self._plotter.renderer), beside, self.box_mm, self.stretch
        made_for = *(array.tobytes() for array in arrays), self.point_px
        if made_for != self._axes_made_for:
            labels = [*self._axis(0), *self._axis(1), *self._upwards()]
            self._axes, self._axes_made_for = self._apart(labels, beside), made_for

    def _axis(self, axis: int) -> list[Label]:
        """Label the edge of the floor that faces the viewer."""
        other, edges = 1 - axis, []
        for side in (0, 1):
            ends = np.tile(self.box_mm[0], (2, 1))
            ends[:, axis], ends[:, other] = self.box_mm[:, axis], self.box_mm[side, other]
            edges.append(ends)
        seen = [self.project(ends * self.stretch) for ends in edges]
        lowest = min((0, 1), key=lambda k: (round(seen[k][:, 1].mean()), seen[k][:, 0].mean()))
        return self._numbered(edges[lowest], seen[lowest], axis)

    def _upwards(self) -> list[Label]:
        """Label the vertical edge that is leftmost in the picture."""
        rows = self.box_mm[CORNERS, [0, 1]]
        feet = np.column_stack([rows, np.full(4, self.box_mm[0, 2])])
        left = int(np.argmin(self.project(feet * self.stretch)[:, 0]))
        self.upright_mm = np.stack([feet[left], feet[left]])
        self.upright_mm[1, 2] = self.box_mm[1, 2]
        return self._numbered(self.upright_mm, self.project(self.upright_mm * self.stretch), 2)

    def _numbered(self, ends_mm: FloatArray, ends_px: FloatArray, axis: int) -> list[Label]:
        way = ends_px[1] - ends_px[0]
        length = float(np.hypot(*way))
        point = self.point_px
        if length < SHORT_PT * point:
            return []
        way /= length
        aside = np.array([-way[1], way[0]])
        centre = self.project((self.box_mm * self.stretch).mean(axis=0)[None])[0]
        if aside @ (ends_px.mean(axis=0) - centre) < 0:
            aside = -aside
        # Extent of a number along the edge.
        room = (3.6 * LETTER * abs(way[0]) + LINE * abs(way[1]) + 0.4) * NUMBER_PT * point
        low, high = ends_mm[:, axis].tolist()
        ticks, texts = round_ticks(low, high, max(int(length / room), 1))
        if len(ticks) < 2:  # label the end of the edge instead
            ticks, texts = np.array([high]), [f"{high:g}"]
        share = (ticks - low) / (high - low)
        places_mm = ends_mm[0] + share[:, None] * (ends_mm[1] - ends_mm[0])
        places = self.project(places_mm * self.stretch) + GAP_PT * point * aside
        leads = (float(aside[0]), float(aside[1]))
        labels = [Label(text, at, leads) for text, at in zip(texts, places, strict=True)]
        wide = max((len(text) for text in texts), default=0) * LETTER
        beyond = (wide * abs(aside[0]) + LINE * abs(aside[1])) * NUMBER_PT + 2 * GAP_PT
        middle = ends_px.mean(axis=0) + beyond * point * aside
        upright = abs(aside[0]) > STEEP
        return [*labels, Label(NAMES[axis], middle, leads, TITLE_PT, upright)]

    # --- the colour scale and captions -------------------------------------------------------

    def _scale(self, size: FloatArray) -> list[Label]:
        if self.scale is None:
            return []
        label, limits, table = self.scale
        point, tall = self.point_px, BAR_SHARE * size[1]
        ticks, texts = round_ticks(*limits, max(min(int(tall / (3 * NUMBER_PT * point)), 6), 2))
        wide = max((len(text) for text in texts), default=1) * LETTER * NUMBER_PT
        title = label.replace(" (", "\n(")  # narrow, to stay within the picture
        half = max(len(line) for line in title.split("\n")) * LETTER * TITLE_PT / 2
        right = size[0] - max(wide + 2 * GAP_PT, half - BAR_PT / 2 + GAP_PT) * point
        left, bottom = right - BAR_PT * point, 0.2 * size[1]
        self._bar_left = left - GAP_PT * point
        self._show_bar((left, bottom, right, bottom + tall), table)
        share = (ticks - limits[0]) / (limits[1] - limits[0])
        places = [np.array([right + GAP_PT * point, bottom + part * tall]) for part in share]
        above = np.array([(left + right) / 2, bottom + tall + 1.5 * GAP_PT * point])
        numbers = [Label(text, at, (1, 0)) for text, at in zip(texts, places, strict=True)]
        return [*numbers, Label(title, above, (0, 1), TITLE_PT)]

    def _show_bar(self, corners: tuple[float, float, float, float], table: Any) -> None:
        import pyvista
        from vtkmodules.vtkRenderingCore import vtkActor2D, vtkPolyDataMapper2D

        if self._bar is None:
            self._bar = vtkActor2D()
            self._bar.SetMapper(vtkPolyDataMapper2D())
            self._plotter.renderer.AddViewProp(self._bar)
        if self._bar_made_for != (corners, table):
            left, bottom, right, top = corners
            heights = np.linspace(bottom, top, STRIPS + 1)
            points = np.zeros((2 * STRIPS + 2, 3))
            points[::2, 0], points[1::2, 0] = left, right
            points[:, 1] = np.repeat(heights, 2)
            k = 2 * np.arange(STRIPS)
            quads = np.column_stack([np.full(STRIPS, 4), k, k + 1, k + 3, k + 2])
            strips: Any = pyvista.PolyData(points, faces=quads.ravel())
            low, high = table.GetTableRange()
            values = pyvista.convert_array(np.linspace(low, high, STRIPS))
            strips.GetCellData().SetScalars(table.MapScalars(values, 0, -1))
            self._bar.GetMapper().SetInputData(strips)
            self._bar_made_for = corners, table

    def _captions(self, size: FloatArray) -> list[Label]:
        edge = GAP_PT * self.point_px
        places = {
            "upper left": (np.array([edge, size[1] - edge]), (1.0, -1.0), CAPTION_PT),
            "lower left": (np.array([edge, edge]), (1.0, 1.0), CAPTION_PT),
            # Framed, and not above the scale: it would be read as a part of the scale's title.
            "lower right": (np.array([size[0] - 2 * edge, 2 * edge]), (-1.0, 1.0), CAPTION_PT),
            "middle": (np.array([0.12, 0.75]) * size, (1.0, -1.0), TITLE_PT + 2),
        }
        return [
            Label(words, *places[where], framed=where == "lower right")
            for where, words in self.captions.items()
            if words
        ]

    # --- drawing -----------------------------------------------------------------------------

    def _new_text(self) -> Any:
        from vtkmodules.vtkRenderingCore import vtkTextActor

        text = vtkTextActor()
        style = text.GetTextProperty()
        style.SetFontFamily(4)  # VTK_FONT_FILE
        style.SetFontFile(_font())
        style.SetColor(*self._colour)
        style.SetBackgroundColor(*self._plotter.background_color.float_rgb)
        style.SetFrameColor(*self._colour)
        self._plotter.renderer.AddViewProp(text)
        return text

    def _write(self, text: Any, label: Label | None) -> None:
        text.SetVisibility(label is not None)
        if label is None:
            return
        style = text.GetTextProperty()
        style.SetFontSize(label.size_pt)
        style.SetOrientation(90.0 if label.upright else 0.0)
        style.SetBackgroundOpacity(0.0 if label.plain else 0.75)
        style.SetFrame(label.framed)
        across, up = label.side
        style.SetJustification(1 - (up if label.upright else across))
        style.SetVerticalJustification(1 + (across if label.upright else -up))
        text.SetInput(label.words)
        text.SetPosition(*label.at_px.tolist())


def project(renderer: Any, points: FloatArray) -> FloatArray:
    """Project scene points, shape (n, 3), to a picture, shape (n, 2), px from the lower left."""
    ahead = np.column_stack([points, np.ones(len(points))]) @ view_matrix(renderer).T
    return np.asarray((ahead[:, :2] / ahead[:, 3:] + 1) / 2 * np.array(renderer.GetSize(), float))


def view_matrix(renderer: Any) -> FloatArray:
    """Return the matrix from the scene to the picture, both homogeneous, shape (4, 4)."""
    camera = renderer.GetActiveCamera()
    matrix = camera.GetCompositeProjectionTransformMatrix(renderer.GetTiledAspectRatio(), -1, 1)
    return np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])
