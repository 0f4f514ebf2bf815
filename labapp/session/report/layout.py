"""Layout of the report: A4 pages of text, tables and figures."""

from __future__ import annotations

import functools
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import matplotlib
from reportlab.lib import colors
from reportlab.lib.enums import TA_RIGHT
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import ParagraphStyle
from reportlab.lib.units import mm
from reportlab.lib.utils import ImageReader
from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.cidfonts import UnicodeCIDFont
from reportlab.pdfbase.ttfonts import TTFont
from reportlab.pdfgen.canvas import Canvas
from reportlab.platypus import (
    BaseDocTemplate,
    Flowable,
    Frame,
    Image,
    KeepTogether,
    PageTemplate,
    Paragraph,
    Table,
    TableStyle,
)

FONT = "DejaVuSans"
"""Has Greek, Cyrillic and the symbols used; distributed with Matplotlib."""

EASTERN = {
    "[\u1100-\u11ff\uac00-\ud7a3]+": "HYSMyeongJo-Medium",
    "[\u2e80-\u312f\u3400-\u9fff\uf900-\ufaff\uff00-\uffef]+": "STSong-Light",
}
"""Fonts of PDF readers for Korean, and for Chinese and Japanese."""

MARGIN = 20 * mm
WIDTH = A4[0] - 2 * MARGIN
TALLEST = A4[1] - 4 * MARGIN
DPI = 220
"""Resolution of figures."""

Cells = list[list[str]]
"""Text of a table, row by row, the header first."""

UNPRINTABLE = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff￾￿]")


def _style(name: str, size: float, **more: Any) -> ParagraphStyle:
    look = {"fontName": FONT, "fontSize": size, "leading": size * 1.4, "splitLongWords": 1}
    return ParagraphStyle(name, **(look | more))


BOLD = f"{FONT}-Bold"
TITLE = _style("title", 17, fontName=BOLD, spaceAfter=6)
HEADING = _style("heading", 12, fontName=BOLD, spaceBefore=14, spaceAfter=5)
PART = _style("part", 9.5, fontName=BOLD, spaceBefore=8, spaceAfter=3)
BODY = _style("body", 9, spaceAfter=5)
CAPTION = _style("caption", 7.5, spaceBefore=3, spaceAfter=9, textColor=colors.Color(0.2, 0.2, 0.2))
CELL = _style("cell", 8, leading=10)
NUMBER = _style("number", 8, leading=10, alignment=TA_RIGHT)
MARGINAL = _style("marginal", 7.5, textColor=colors.Color(0.3, 0.3, 0.3))
HEAD = _style("head", 8, leading=10, fontName=BOLD)
HEAD_NUMBER = _style("head number", 8, leading=10, fontName=BOLD, alignment=TA_RIGHT)


def plain(text: str) -> str:
    """Escape user input for a paragraph, so that nothing in it is markup."""
    lines = UNPRINTABLE.sub("\N{REPLACEMENT CHARACTER}", text.expandtabs(4)).splitlines()
    marked = "<br/>".join(escape(line) for line in lines)
    for letters, font in EASTERN.items():
        marked = re.sub(letters, rf'<font name="{font}">\g<0></font>', marked)
    return marked


class Story:
    """Content of a report in order, with numbered tables and figures."""

    def __init__(self) -> None:
        _register_fonts()
        self.flowables: list[Flowable] = []
        """All content, in order."""
        self.tables: list[Cells] = []
        self.captions: list[str] = []
        """Text of all tables, and all captions."""
        self._figures = 0
        self._headings: list[Flowable] = []

    def title(self, text: str) -> None:
        """Add the report's title."""
        self.flowables.append(Paragraph(plain(text), TITLE))

    def heading(self, text: str) -> None:
        """Add the heading of a section, on the same page as what follows."""
        self._headings.append(Paragraph(plain(text), HEADING))

    def part(self, text: str) -> None:
        """Add a heading within a section."""
        self._headings.append(Paragraph(plain(text), PART))

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._add(Paragraph(plain(text), BODY))

    def listing(self, rows: Sequence[tuple[str, str]]) -> None:
        """Add names and values, one pair per line, without a caption; empty values are omitted."""
        cells = [[name, value] for name, value in rows if value]
        if cells:
            self.tables.append(cells)
            self._add(_table(cells, "ll", [0.3, 0.7], header=False))

    def table(self, caption: str, cells: Cells, align: str, widths: Sequence[float]) -> None:
        """Add a table with its caption above.

        Parameters
        ----------
        cells
            Text of the table, the header first.
        align
            ``l`` or ``r`` for each column.
        widths
            Width of each column as a fraction of the text width.
        """
        self.tables.append(cells)
        number = len([c for c in self.captions if c.startswith("Table")]) + 1
        above = self._caption(f"Table {number}. {caption}")
        self._add(above, _table(cells, align, widths, header=True))

    def figure(self, caption: str, png: bytes) -> None:
        """Add a figure of `DPI` with its caption below, reduced if it does not fit."""
        self._figures += 1
        across, down = ImageReader(io.BytesIO(png)).getSize()
        scale = min(72 / DPI, WIDTH / across, TALLEST / down)
        image = Image(io.BytesIO(png), across * scale, down * scale)
        below = self._caption(f"Figure {self._figures}. {caption}")
        self._add(image, below)

    def _caption(self, text: str) -> Paragraph:
        self.captions.append(text)
        return Paragraph(plain(text), CAPTION)

    def _add(self, *flowables: Flowable) -> None:
        """Add content and the headings above it, on one page if possible."""
        self.flowables.append(KeepTogether([*self._headings, *flowables]))
        self._headings = []

    def pdf(self, header: str, footer: str, title: str) -> bytes:
        """Return the PDF, with header and footer on each page; reproducible to the byte."""

        class Pages(_CountedPages):
            margins = (header, footer)

        content = io.BytesIO()
        document = _Document(
            content, pagesize=A4, title=title, creator="labapp", producer="labapp", invariant=1
        )
        document.build(list(self.flowables), canvasmaker=Pages)
        return content.getvalue()


class _Document(BaseDocTemplate):  # type: ignore[misc]
    """Document with one frame per page, and headings in the outline."""

    def __init__(self, file: io.BytesIO, **more: Any) -> None:
        super().__init__(file, **more)
        height = A4[1] - 2 * MARGIN
        frame = Frame(MARGIN, MARGIN, WIDTH, height, 0, 0, 0, 0)
        self.addPageTemplates(PageTemplate(frames=[frame]))
        self._headings = 0

    def afterFlowable(self, flowable: Flowable) -> None:  # noqa: N802 (reportlab's name)
        if isinstance(flowable, Paragraph) and flowable.style is HEADING:
            self._headings += 1
            key = f"section-{self._headings}"
            self.canv.bookmarkPage(key)
            self.canv.addOutlineEntry(flowable.getPlainText(), key)


class _CountedPages(Canvas):  # type: ignore[misc]
    """Writes header, footer and "page n of m" once all pages are known."""

    margins = ("", "")

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self._pages: list[dict[str, Any]] = []

    def showPage(self) -> None:  # noqa: N802 (reportlab's name)
        self._pages.append(dict(self.__dict__))
        self._startPage()

    def save(self) -> None:
        for number, page in enumerate(self._pages, 1):
            self.__dict__.update(page)
            self._write_margins(f"page {number} of {len(self._pages)}")
            super().showPage()
        super().save()

    def _write_margins(self, count: str) -> None:
        header, footer = self.margins
        self.saveState()
        self.setFont(FONT, 7.5)
        self.setFillGray(0.3)
        self.setStrokeGray(0.6)
        self.setLineWidth(0.4)
        top = A4[1] - 13 * mm
        line = Paragraph(plain(_fitted(header)), MARGINAL)
        line.wrapOn(self, WIDTH, 12)
        line.drawOn(self, MARGIN, top - 2)
        self.line(MARGIN, top - 4, A4[0] - MARGIN, top - 4)
        self.drawString(MARGIN, 11 * mm, footer)
        self.drawRightString(A4[0] - MARGIN, 11 * mm, count)
        self.restoreState()


def _fitted(text: str) -> str:
    """Truncate a text to one line of the header."""
    text = " ".join(UNPRINTABLE.sub(" ", text).split())
    fits = next((n for n in range(len(text)) if _width(text[: n + 1]) > WIDTH - 15), len(text))
    return text if fits == len(text) else text[:fits] + "…"


def _width(text: str) -> float:
    """Return the width of a text in the header; East Asian characters are about square."""
    wide = sum(any(re.match(letters, c) for letters in EASTERN) for c in text)
    return float(pdfmetrics.stringWidth(text, FONT, 7.5)) + 4 * wide


def _table(cells: Cells, align: str, widths: Sequence[float], *, header: bool) -> Table:
    rows = []
    for k, row in enumerate(cells):
        left, right = (HEAD, HEAD_NUMBER) if header and k == 0 else (CELL, NUMBER)
        styles = [right if side == "r" else left for side in align]
        rows.append([Paragraph(plain(c), s) for c, s in zip(row, styles, strict=True)])
    table = Table(
        rows,
        [share * WIDTH for share in widths],
        repeatRows=int(header),
        spaceAfter=6,
        splitInRow=1,
    )
    look: list[tuple[Any, ...]] = [
        ("VALIGN", (0, 0), (-1, -1), "TOP"),
        ("TOPPADDING", (0, 0), (-1, -1), 1.5),
        ("BOTTOMPADDING", (0, 0), (-1, -1), 2.5),
        ("LEFTPADDING", (0, 0), (-1, -1), 5),
        ("RIGHTPADDING", (0, 0), (-1, -1), 5),
        ("LINEBELOW", (0, 0), (-1, -1), 0.25, colors.Color(0.85, 0.85, 0.85)),
    ]
    if header:
        look += [
            ("LINEABOVE", (0, 0), (-1, 0), 0.8, colors.black),
            ("LINEBELOW", (0, 0), (-1, 0), 0.5, colors.black),
            ("LINEBELOW", (0, -1), (-1, -1), 0.8, colors.black),
        ]
    table.setStyle(TableStyle(look))
    return table


@functools.cache
def _register_fonts() -> None:
    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    for end in ("", "-Bold"):
        pdfmetrics.registerFont(TTFont(FONT + end, folder / f"{FONT}{end}.ttf"))
    for font in EASTERN.values():
        pdfmetrics.registerFont(UnicodeCIDFont(font))
