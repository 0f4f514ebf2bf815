"""Writing of 3-D views, plots and frames to image files with their size on paper."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from PySide6.QtCore import QRectF, QSize, Qt
from PySide6.QtGui import QCursor, QImage, QPainter, QPalette
from PySide6.QtWidgets import QDialog, QGraphicsView, QMessageBox, QToolTip, QWidget

from labapp.export.rendering.paper import MM_AN_INCH, Paper
from labapp.gui.dialogs import ask_save
from labapp.gui.tasks import DONE
from labapp.gui.theme import palette
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.fields import FieldForm, whole
from labapp.gui.widgets.labels import plain_tip, wrapping_label
from labapp.gui.widgets.layouts import hbox, vbox

RASTERS = "PNG (*.png);;TIFF (*.tif *.tiff);;JPEG (*.jpg *.jpeg)"
VECTORS = f"{RASTERS};;SVG (*.svg)"
SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
SVG = ".svg"
SVG_DPI = 96
"""Resolution, pixels per inch, that programs assume for an SVG file."""


class PaperDialog(QDialog):
    """Asks for the width of a picture on paper and its resolution; remembers the last values."""

    paper = Paper()
    folder = Path.home()
    """Folder of the last saved picture."""

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.setObjectName("save-picture")
        self.setWindowTitle("Save picture")
        tip = "90 mm is one column of a journal, 180 mm two; margins are cropped"
        self.width_mm = whole("Width on paper", 20, tip, 300, unit="mm", step=5)
        tip = "Pixels per inch; journals ask for 300 or 600. An SVG of a plot has none"
        self.dpi = whole("Resolution", 72, tip, 600, unit="dpi", step=50)
        self.size_words = wrapping_label()
        form = FieldForm(self.width_mm, self.dpi)
        for field, value in ((self.width_mm, self.paper.width_mm), (self.dpi, self.paper.dpi)):
            field.set_value(value)
            field.edited.connect(lambda _: self._take())
        save = button("Save as…", "Choose the file; its extension sets the format", self.accept)
        save.setDefault(True)
        cancel = button("Cancel", "Save nothing (Esc)", self.reject)
        vbox(form, self.size_words, hbox(1, cancel, save), of=self).setContentsMargins(
            12, 12, 12, 12
        )
        self._take()

    def _take(self) -> None:
        width_mm, dpi = self.width_mm.value(), self.dpi.value()
        if width_mm is not None and dpi is not None:
            PaperDialog.paper = Paper(float(width_mm), int(dpi))
        self.size_words.setText(f"{self.paper.width_px} px wide, black on white")


def ask_paper(parent: QWidget, proposed: Path, kinds: str) -> tuple[Path, Paper] | None:
    """Ask for size and file of a picture; None if nothing is to be saved."""
    dialog = PaperDialog(parent)
    wanted = dialog.exec() == QDialog.DialogCode.Accepted
    dialog.deleteLater()
    path = ask_save(parent, "Save picture", proposed, kinds) if wanted else None
    if path is None:
        return None
    PaperDialog.folder = path.parent
    return path, PaperDialog.paper


def with_suffix(path: Path, *more: str) -> Path:
    """The path, with .png added if it has no suffix of a picture format."""
    known = path.suffix.lower() in (*SUFFIXES, *more)
    return path if known else path.with_name(f"{path.name}.png")


def write_image(path: Path, image: QImage, dpi: float) -> bool:
    """Write an image with its resolution; return whether that succeeded."""
    per_m = round(dpi / MM_AN_INCH * 1000)
    image.setDotsPerMeterX(per_m)
    image.setDotsPerMeterY(per_m)
    # PNG: 0 is the strongest compression; JPEG: 95 is a high image quality.
    return image.save(str(path), quality=95 if path.suffix.lower().startswith(".jp") else 0)


def write_plot(path: Path, drawn: QWidget, canvas: QGraphicsView, paper: Paper) -> bool:
    """Write a plot, dark on light, as SVG or pixels; return whether that succeeded."""
    with _light(drawn):
        if path.suffix.lower() == SVG:
            return _write_svg(path, canvas, paper)
        size = QSize(paper.width_px, round(paper.width_px * canvas.height() / canvas.width()))
        image = QImage(size, QImage.Format.Format_RGB32)
        image.fill(canvas.backgroundBrush().color())
        _paint(image, canvas)
        return write_image(path, image, paper.dpi)


def _paint(device: Any, canvas: QGraphicsView) -> None:
    with QPainter(device) as painter:
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        marks = [item for item in canvas.scene().items() if hasattr(item, "setExportMode")]
        for item in marks:  # otherwise marks would be bitmaps at screen resolution
            item.setExportMode(True, {"painter": painter, "resolutionScale": 1.0})
        try:
            canvas.render(painter, QRectF(painter.viewport()), canvas.viewport().rect())
        finally:
            for item in marks:
                item.setExportMode(False)


def _write_svg(path: Path, canvas: QGraphicsView, paper: Paper) -> bool:
    from PySide6.QtSvg import QSvgGenerator

    wide = round(paper.width_mm / MM_AN_INCH * SVG_DPI)
    size = QSize(wide, round(wide * canvas.height() / canvas.width()))
    generator = QSvgGenerator()
    generator.setFileName(str(path))
    generator.setResolution(SVG_DPI)
    generator.setSize(size)
    generator.setViewBox(QRectF(0, 0, size.width(), size.height()))
    _paint(generator, canvas)
    return path.is_file()


@contextmanager
def _light(drawn: QWidget) -> Iterator[None]:
    """Use the light colours for a widget within the context."""
    drawn.setPalette(palette(False))
    try:
        yield
    finally:
        drawn.setPalette(QPalette())


def save_picture(drawn: QWidget, image: QImage) -> None:
    """Ask for a file and write a picture to it as displayed."""
    proposed = PaperDialog.folder / "picture.png"
    if path := ask_save(drawn, "Save picture", proposed, RASTERS):
        PaperDialog.folder, path = path.parent, with_suffix(path)
        _report(path, write_image(path, image, SVG_DPI), drawn)


def _report(path: Path, written: bool, drawn: QWidget) -> None:
    if written:
        QToolTip.showText(QCursor.pos(), plain_tip(f"{DONE} Saved in {path}"), drawn)
    else:
        box = QMessageBox(QMessageBox.Icon.Warning, "Save picture", "", parent=drawn)
        box.setTextFormat(Qt.TextFormat.PlainText)
        box.setText(f"{path} cannot be written.")
        box.exec()


def save_plot(drawn: QWidget, canvas: QGraphicsView, name: str) -> Callable[[], None]:
    """A function that asks for a file and writes a plot to it."""

    def save() -> None:
        if answer := ask_paper(drawn, PaperDialog.folder / f"{name}.png", VECTORS):
            path = with_suffix(answer[0], SVG)
            _report(path, write_plot(path, drawn, canvas, answer[1]), drawn)

    return save
