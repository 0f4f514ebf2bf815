"""Light and dark: palettes with one accent colour, for Qt's own Fusion style."""

from __future__ import annotations

from PySide6.QtCore import QEvent, Qt
from PySide6.QtGui import QColor, QPalette
from PySide6.QtWidgets import QApplication

Role = QPalette.ColorRole

COLOURS = {
    Role.Window: ("#f3f4f5", "#1f2326"),
    Role.WindowText: ("#1c2024", "#e4e7ea"),
    Role.Base: ("#ffffff", "#2a3036"),
    Role.AlternateBase: ("#f0f2f4", "#30373e"),
    Role.Text: ("#1c2024", "#e4e7ea"),
    Role.PlaceholderText: ("#6b7480", "#929ba6"),
    Role.Button: ("#e7e9ec", "#383f46"),
    Role.ButtonText: ("#1c2024", "#e4e7ea"),
    Role.BrightText: ("#ffffff", "#ffffff"),
    Role.ToolTipBase: ("#ffffff", "#31363c"),
    Role.ToolTipText: ("#1c2024", "#e4e7ea"),
    Role.Link: ("#0a62a8", "#6db8f2"),
    Role.LinkVisited: ("#0a62a8", "#6db8f2"),
    Role.Highlight: ("#0a6fc2", "#2a7fc4"),
    Role.HighlightedText: ("#ffffff", "#ffffff"),
    Role.Accent: ("#0a6fc2", "#4ba3e3"),
    Role.Light: ("#ffffff", "#4a5159"),
    Role.Midlight: ("#e2e5e9", "#3a4047"),
    Role.Mid: ("#b7bec7", "#50575f"),
    Role.Dark: ("#8f98a3", "#14171a"),
    Role.Shadow: ("#5d656f", "#0b0c0e"),
}
"""Colours by role: on a light and on a dark background."""

RED = QColor("#b8321f"), QColor("#f0705a")
"""Colour of alarms, limits and a running recording: on a light and on a dark background."""

DISABLED = {False: "#8b939d", True: "#767e88"}
"""Text colour of disabled widgets, by whether the theme is dark."""


def palette(dark: bool) -> QPalette:
    """The light or the dark palette."""
    made = QPalette()
    for role, colours in COLOURS.items():
        made.setColor(role, QColor(colours[dark]))
    for role in (Role.WindowText, Role.Text, Role.ButtonText, Role.HighlightedText):
        made.setColor(QPalette.ColorGroup.Disabled, role, QColor(DISABLED[dark]))
    made.setColor(
        QPalette.ColorGroup.Disabled, Role.Highlight, QColor("#50575f" if dark else "#b7bec7")
    )
    return made


def is_dark(look: QPalette) -> bool:
    """Whether a palette is dark, to choose colours that have no role in it."""
    return look.color(Role.Window).lightness() < 128


def faint(colour: QColor | str, alpha: int) -> QColor:
    """A colour with an opacity, 0 … 255."""
    paler = QColor(colour)
    paler.setAlpha(alpha)
    return paler


class FollowsTheme:
    """Base of widgets with colours outside the palette; precedes Qt's class in the bases."""

    _follows = False

    def follow_theme(self) -> None:
        """Use the window's colours, now and whenever they change."""
        self._follows = True
        self.take_colours()

    def take_colours(self) -> None:
        """Use the window's current colours."""

    def changeEvent(self, event: QEvent) -> None:
        """Follow a change of theme."""
        super().changeEvent(event)  # type: ignore[misc]
        if event.type() == QEvent.Type.PaletteChange and self._follows:
            self.take_colours()


def apply_theme(app: QApplication, theme: str) -> None:
    """Use the light, the dark or the desktop's theme; dark if the desktop does not specify it."""
    if app.style().name().lower() != "fusion":
        app.setStyle("Fusion")
    desktop_is_light = app.styleHints().colorScheme() == Qt.ColorScheme.Light
    dark = theme == "dark" or (theme == "system" and not desktop_is_light)
    made = palette(dark)
    if app.palette() != made:
        app.setPalette(made)
