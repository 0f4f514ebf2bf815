"""From dark to light and back, on every page: what is seen says the same, in the other colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyqtgraph as pg
import pytest
from PySide6.QtGui import QColor, QImage, QPalette
from PySide6.QtWidgets import QApplication, QGraphicsView, QWidget
from pytestqt.qtbot import QtBot

from labapp.gui.live.figures import AlarmStrip, Figure, LiveFigures
from labapp.gui.recent import Recent
from labapp.gui.shell.step_list import COLOURS
from labapp.gui.shell.steps import STEPS
from labapp.gui.shell.window import MainWindow
from labapp.gui.theme import RED, palette
from labapp.gui.views.view3d import View3d
from labapp.run.alarms import Alarm
from tests.gui.conftest import CopySample, let_draw


@pytest.fixture
def opened(window: MainWindow, copy_sample: CopySample) -> MainWindow:
    """The window, dark, with a measured session."""
    window.apply_theme()
    assert window.files.open(copy_sample("gtaw"))
    return window


def plots(widget: QWidget) -> list[pg.PlotItem]:
    """All plots that are seen."""
    views = [view for view in widget.findChildren(QGraphicsView) if view.isVisible()]
    return [each for view in views for each in view.items() if isinstance(each, pg.PlotItem)]


def axes(plot: pg.PlotItem) -> list[pg.AxisItem]:
    return [plot.getAxis(side) for side in ("left", "bottom") if plot.getAxis(side).isVisible()]


def misread(axis: pg.AxisItem) -> list[str]:
    """Numbers at an axis that are not the place where they stand."""
    wrong = []
    size = max(axis.geometry().width(), axis.geometry().height())
    for spacing, values in axis.tickValues(*axis.range, size):
        told = axis.tickStrings(values, axis.autoSIPrefixScale * axis.scale, spacing)
        places = zip(told, values, strict=True)
        wrong += [f"{t} at {v:g}" for t, v in places if abs(float(t) - v) > 0.51 * spacing]
    return [f"{axis.labelText}: {words}" for words in wrong]


def test_every_axis_keeps_its_unit(opened: MainWindow, qtbot: QtBot) -> None:
    seen: dict[str, int] = {}
    keys = [step.key for step in STEPS if step.key != "laser"]
    for key in (*keys, "laser"):
        if key == "laser":  # without a calibration there is nothing to draw
            opened.workspace.attempt(lambda s: s.calibrate_laser([13.676], [18.561], [7.874]))
        opened.show_step(key)
        qtbot.waitUntil(lambda: not opened.workspace.tasks.active)
        if key == "surface":  # its charts are drawn behind the 3-D view
            qtbot.waitUntil(lambda: len(opened.page.profile._height.getData()[0]) > 0)
        for theme in ("dark", "light", "dark"):
            opened.set_theme(theme)
            let_draw()
            drawn = plots(opened)
            assert [one for plot in drawn for axis in axes(plot) for one in misread(axis)] == []
        seen[key] = len(drawn)
    assert {key for key, count in seen.items() if count} >= {"setup", "laser", "surface", "trends"}
    assert seen["surface"] == 3


def test_the_scale_of_heights_keeps_its_numbers(opened: MainWindow, qtbot: QtBot) -> None:
    opened.show_step("surface")
    views = [view for view in opened.page.findChildren(View3d) if view.isVisible()]
    assert views
    for theme in ("dark", "light"):
        opened.set_theme(theme)
        let_draw()
        for view in views:
            qtbot.waitUntil(lambda view=view: view.picture() is not None)
            overlay = view._drawing.overlay
            label, limits, table = overlay.scale
            assert (label, limits) == (view.scene.label, view.scene.limits)
            assert table.GetTableRange() == pytest.approx(limits)
            assert label.replace(" (", "\n(") in overlay.words


def shades(image: QImage) -> set[str]:
    """The colours of a picture's pixels that are wholly of one colour."""
    image = image.convertToFormat(QImage.Format.Format_ARGB32)
    levels = np.frombuffer(image.constBits(), np.uint32).reshape(image.height(), -1)
    found = np.unique(levels[:, : image.width()]).tolist()
    return {QColor(level).name() for level in found if level >> 24 == 255}


def test_marks_and_words_take_the_colours_of_the_theme(opened: MainWindow) -> None:
    opened.show_step("trends")
    steps, panel, timeline = opened.step_list, opened.side_panel, opened.timeline
    marks = {opened._states[step.key].mark for step in STEPS}
    assert len(marks) > 1
    for theme, dark in (("light", False), ("dark", True)):
        opened.set_theme(theme)
        let_draw()
        icons = [steps.item(row).icon().pixmap(54).toImage() for row in range(steps.count())]
        for icon, step in zip(icons, STEPS, strict=True):
            pair = COLOURS[opened._states[step.key].mark]
            assert pair[dark] in shades(icon)
            assert pair[not dark] not in shades(icon)
        state = opened._states["trends"]
        colour = panel.state.palette().color(QPalette.ColorRole.WindowText)
        assert colour == QColor(COLOURS[state.mark][dark])
        play = timeline.play_button.icon().pixmap(timeline.play_button.iconSize()).toImage()
        assert shades(play) == {palette(dark).color(QPalette.ColorRole.ButtonText).name()}
        ticks = [tick for tick in timeline._ticks if tick.light]
        assert any((t.dark if dark else t.light) in timeline.counts.text() for t in ticks)
        assert not any((t.light if dark else t.dark) in timeline.counts.text() for t in ticks)


def test_sessions_that_are_gone_stay_legible(tmp_path: Path, window: MainWindow) -> None:
    welcome = window.welcome
    path = tmp_path / "gone.labsession"
    welcome._shown = (path,)
    welcome.list.addItem("gone")
    welcome._show(Recent(path, "gone", "is not there", there=False))
    for theme, dark in (("dark", True), ("light", False)):
        window.set_theme(theme)
        let_draw()
        pale = palette(dark).color(QPalette.ColorRole.PlaceholderText)
        assert welcome.list.item(0).foreground().color() == pale


def test_live_figures_and_alarms_take_the_colours_of_the_theme(qapp: QApplication) -> None:
    figures, strip = LiveFigures(), AlarmStrip(lambda: None)
    qapp.setPalette(palette(True))
    figures.show_figures([Figure("Width", "6.6", "", "▲ above 6", "alarm")])
    strip.show_alarms([Alarm("width-high", "Width is 6.6 mm", 0, 0.0)])
    for dark in (True, False):
        qapp.setPalette(palette(dark))
        let_draw()
        for label in (figures._labels[0, 1], strip.words):
            assert label.palette().color(QPalette.ColorRole.WindowText) == RED[dark]
    qapp.setPalette(palette(True))
