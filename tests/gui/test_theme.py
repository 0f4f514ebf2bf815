"""Switching between dark and light changes only the colours, on every page."""

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
    """The window in the dark theme with a measured session."""
    window.apply_theme()
    assert window.files.open(copy_sample("gtaw"))
    return window


def plots(widget: QWidget) -> list[pg.PlotItem]:
    """All visible plots."""
    views = [view for view in widget.findChildren(QGraphicsView) if view.isVisible()]
    return [each for view in views for each in view.items() if isinstance(each, pg.PlotItem)]


def axes(plot: pg.PlotItem) -> list[pg.AxisItem]:
    return [plot.getAxis(side) for side in ("left", "bottom") if plot.getAxis(side).isVisible()]


def wrong_labels(axis: pg.AxisItem) -> list[str]:
    """Axis labels whose number differs from their position."""
    errors = []
    size = max(axis.geometry().width(), axis.geometry().height())
    for spacing, values in axis.tickValues(*axis.range, size):
        labels = axis.tickStrings(values, axis.autoSIPrefixScale * axis.scale, spacing)
        pairs = zip(labels, values, strict=True)
        errors += [f"{t} at {v:g}" for t, v in pairs if abs(float(t) - v) > 0.51 * spacing]
    return [f"{axis.labelText}: {words}" for words in errors]


def test_axes_keep_their_units(opened: MainWindow, qtbot: QtBot) -> None:
    counts: dict[str, int] = {}
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
            assert [
                one for plot in drawn for axis in axes(plot) for one in wrong_labels(axis)
            ] == []
        counts[key] = len(drawn)
    assert {key for key, count in counts.items() if count} >= {
        "setup",
        "laser",
        "surface",
        "trends",
    }
    assert counts["surface"] == 3


def test_height_scale_keeps_its_numbers(opened: MainWindow, qtbot: QtBot) -> None:
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


def colours_of(image: QImage) -> set[str]:
    """The colours of the opaque pixels of a picture."""
    image = image.convertToFormat(QImage.Format.Format_ARGB32)
    levels = np.frombuffer(image.constBits(), np.uint32).reshape(image.height(), -1)
    values = np.unique(levels[:, : image.width()]).tolist()
    return {QColor(level).name() for level in values if level >> 24 == 255}


def test_marks_and_texts_use_the_colours_of_the_theme(opened: MainWindow) -> None:
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
            assert pair[dark] in colours_of(icon)
            assert pair[not dark] not in colours_of(icon)
        state = opened._states["trends"]
        colour = panel.state.palette().color(QPalette.ColorRole.WindowText)
        assert colour == QColor(COLOURS[state.mark][dark])
        play = timeline.play_button.icon().pixmap(timeline.play_button.iconSize()).toImage()
        assert colours_of(play) == {palette(dark).color(QPalette.ColorRole.ButtonText).name()}
        ticks = [tick for tick in timeline._ticks if tick.light]
        assert any((t.dark if dark else t.light) in timeline.counts.text() for t in ticks)
        assert not any((t.light if dark else t.dark) in timeline.counts.text() for t in ticks)


def test_missing_sessions_stay_legible(tmp_path: Path, window: MainWindow) -> None:
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


def test_live_figures_and_alarms_use_the_colours_of_the_theme(qapp: QApplication) -> None:
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
