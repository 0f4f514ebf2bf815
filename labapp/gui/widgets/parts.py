"""A canvas of several parts: all at once if there is space, else one at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from PySide6.QtWidgets import QTabBar, QWidget

NARROW = 100
"""A canvas narrower than this number of letters is narrow, as on a small screen at 150 %."""


class PartsBar(QTabBar):
    """Tabs that choose the visible part of a narrow canvas; hidden on a wide one.

    Parameters
    ----------
    name
        Name of the tabs for a screen reader.
    parts
        Widgets by the name of the part; a widget may be in several parts.
    """

    def __init__(self, name: str, parts: Mapping[str, Sequence[QWidget]]) -> None:
        super().__init__()
        self._parts = list(parts.values())
        self._is_narrow = False
        self.setAccessibleName(name)
        self.setDrawBase(False)
        for part in parts:
            self.addTab(part)
        self.currentChanged.connect(lambda _: self._show())
        self.hide()

    def fit(self, canvas: QWidget, least_px: int = 0) -> None:
        """Follow a canvas that has become narrow or wide, or lower or higher than all needs."""
        is_narrow = canvas.width() < NARROW * self.fontMetrics().averageCharWidth()
        is_narrow = is_narrow or canvas.height() < least_px
        if is_narrow != self._is_narrow:
            self._is_narrow = is_narrow
            self.setVisible(is_narrow)
            self._show()

    def _show(self) -> None:
        chosen = self._parts[self.currentIndex()]
        for part in self._parts:
            for widget in part:
                widget.setVisible(not self._is_narrow or widget in chosen)
