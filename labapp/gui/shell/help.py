"""The guide; the keys, from the same data as the window; information about the program."""

from __future__ import annotations

import sys
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy
import PySide6
from PySide6.QtCore import QSize, Qt, QUrl
from PySide6.QtGui import QAction, QDesktopServices, QImage, QKeySequence, QTextDocument
from PySide6.QtWidgets import QDialog, QDialogButtonBox, QTextBrowser, QVBoxLayout, QWidget

from labapp.bundled import bundled
from labapp.gui.shell.actions import ACTIONS, MENUS
from labapp.log import log_file
from labapp.version import VERSION

if TYPE_CHECKING:
    from labapp.gui.pages.page import Page

PART_OF_SCREEN = 0.85
"""Largest share of the screen for a text; the rest is for the frame around it."""

SIZES_PX = {"guide": (900, 700), "keys": (720, 600), "about": (520, 300)}

TITLES = {"guide": "Guide", "keys": "Keys", "about": "About labapp"}

NO_GUIDE = "<p>The guide did not come with this installation.</p>"


def keys(page: Page | None = None) -> str:
    """Every action that has a key, those of the page in view first; HTML."""
    from labapp.gui.views import picture, plots, view3d

    parts = []
    if page is not None:
        own = [(_key(action), action.text(), action.toolTip()) for action in page.actions()]
        rows = [(key, text, tip.removesuffix(f" ({key})")) for key, text, tip in own if key]
        parts += [_table(f"This page: {page.accessibleName()}", rows)] if rows else []
    in_views = (("Pictures", picture.KEYS), ("3-D views", view3d.KEYS_TOLD), ("Plots", plots.KEYS))
    message = "".join(f"<p><b>{name}</b>: {escape(words)}.</p>" for name, words in in_views)
    parts.append(f"<h3>In what is drawn</h3>{message}")
    for menu in MENUS:
        rows = [(_shown(a.key), a.text, a.tip) for a in ACTIONS if a.menu == menu and a.key]
        parts.append(_table(menu.replace("&", ""), rows))
    return f"<h2>Keys</h2>{''.join(parts)}"


def _table(heading: str, rows: list[tuple[str, str, str]]) -> str:
    lines = "".join(
        f"<tr><td width='110'>{escape(key)}</td>"
        f"<td width='190'><b>{escape(text.replace('&', ''))}</b></td><td>{escape(tip)}</td></tr>"
        for key, text, tip in rows
    )
    return f"<h3>{escape(heading)}</h3><table cellpadding='2'>{lines}</table>"


def about() -> str:
    """What the program is; HTML."""
    import scipy

    built_on = (
        f"Python {sys.version.split()[0]}, numpy {numpy.__version__}, scipy {scipy.__version__}, "
        f"Qt for Python {PySide6.__version__}"
    )
    return (
        f"<h2>labapp {VERSION}</h2>"
        "<p>The three-dimensional surface of a molten weld pool, measured from a reflected laser "
        "dot matrix.</p>"
        f"<p>BSD 3-Clause licence. {built_on}.</p><p>The log is {escape(str(log_file()))}.</p>"
    )


class GuidePages(QTextBrowser):
    """Shows pages of the guide; their pictures are made to fit its width."""

    def __init__(self) -> None:
        super().__init__()
        self.setOpenLinks(False)
        self.setVerticalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOn)  # the width stays
        self.anchorClicked.connect(self._follow)

    def show_page(self, name: str) -> None:
        """Show a page."""
        file = bundled("docs/guide") / f"{name}.md"
        if file.is_file():
            self.setSource(QUrl.fromLocalFile(str(file)))
        else:
            self.setHtml(NO_GUIDE)

    def _follow(self, link: QUrl) -> None:
        url = self.source().resolved(link)
        if not url.isLocalFile():
            QDesktopServices.openUrl(url)
        elif Path(url.toLocalFile()).is_file():
            self.setSource(url)

    def loadResource(self, kind: int, name: QUrl | str) -> object:
        """Load a page, or a picture with the available width."""
        loaded = super().loadResource(kind, name)
        if kind != QTextDocument.ResourceType.ImageResource.value:
            return loaded
        image = QImage(self.source().resolved(QUrl(name)).toLocalFile())
        room = self.viewport().width() - 2 * round(self.document().documentMargin())
        smooth = Qt.TransformationMode.SmoothTransformation
        return image.scaledToWidth(room, smooth) if image.width() > room else image


class HelpDialog(QDialog):
    """One of the help texts, beside the window."""

    def __init__(self, kind: str, parent: QWidget | None = None, page: Page | None = None) -> None:
        super().__init__(parent)
        self.setObjectName(f"help-{kind}")
        self.setWindowTitle(TITLES[kind])
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        self.browser = GuidePages()
        self.browser.setAccessibleName(TITLES[kind])
        self.browser.setAccessibleDescription("Arrow keys and Page Up and Down scroll the text")
        buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
        buttons.button(QDialogButtonBox.StandardButton.Close).setToolTip("Close this window (Esc)")
        buttons.rejected.connect(self.reject)
        layout = QVBoxLayout(self)
        layout.addWidget(self.browser)
        layout.addWidget(buttons)
        wanted = QSize(*SIZES_PX[kind])
        self.resize(wanted.boundedTo(self.screen().availableSize() * PART_OF_SCREEN))
        layout.activate()  # pictures are scaled to fit
        if kind == "guide":
            self.browser.show_page("welcome" if page is None else page.key)
        else:
            self.browser.setHtml(keys(page) if kind == "keys" else about())


def _key(action: QAction) -> str:
    return action.shortcut().toString(QKeySequence.SequenceFormat.NativeText)


def _shown(key: str) -> str:
    return QKeySequence(key).toString(QKeySequence.SequenceFormat.NativeText)
