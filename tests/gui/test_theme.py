"""From dark to light and back, on every page: what is seen says the same, in the other colours."""

from __future__ import annotations

import numpy as np
import pyqtgraph as pg
import pytest
from PySide6.QtWidgets import QGraphicsView, QWidget
from pytestqt.qtbot import QtBot

from labapp.gui.steps import STEPS
from labapp.gui.views.view3d import View3d
from labapp.gui.window import MainWindow
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
            bars = view._drawing.plotter.scalar_bars
            ((title, bar),) = bars.items()
            assert title.replace("\n", " ") == view.scene.label
            assert bar.GetLookupTable().GetTableRange() == pytest.approx(view.scene.limits)
            assert np.isclose(float(bar.GetLabelFormat() % view.scene.limits[1]),
                              view.scene.limits[1], atol=0.01)  # fmt: skip
