"""The steps of the tour: what an operator does from the first start to the export."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QDialog, QMessageBox, QTabBar, QToolButton

from labapp.gui.live.canvas import PARTS
from labapp.gui.pages.bench_check.page import BenchCheckPage
from labapp.gui.pages.capture.page import CapturePage
from labapp.gui.pages.dots.page import DotsPage
from labapp.gui.pages.laser.page import LaserPage
from labapp.gui.pages.plane.page import PlanePage
from labapp.gui.pages.setup.page import SetupPage
from labapp.gui.pages.surface.page import SurfacePage
from labapp.gui.shell.steps import STEPS
from labapp.gui.tools.adviser import AdviserWindow
from labapp.gui.tools.analysis import AnalysisWindow
from labapp.gui.tools.dynamics import DynamicsWindow
from labapp.gui.tools.simulator import SimulatorWindow
from labapp.gui.tools.study import StudyWindow
from labapp.gui.tools.tool import ToolWindow
from labapp.session.session import Session

from .bench import CROSS_MM, places
from .hands import CTRL, Hands, enter_path

T = TypeVar("T", bound=ToolWindow)

FRAMES = 6
"""Number of imported frames: enough to see, and quickly measured."""


def go_through(hands: Hands, folder: Path) -> None:
    """Go through the complete app.

    Parameters
    ----------
    hands
        Drives the window.
    folder
        The folder written by `bench.lay_out`.

    Raises
    ------
    TourFailed
        If a page does not behave as expected.
    """
    files = folder / "measurements"
    hands.begin()
    hands.picture("first-start")
    _begin_session(hands, files)
    _set_up(hands, files)
    _laser(hands, files)
    _plane(hands, files)
    _bench_check(hands, files)
    _record(hands, files)
    _film(hands)
    _measure(hands)
    _surface(hands)
    _compare(hands)
    _dots(hands)
    _trends(hands, files)
    _export(hands, files)
    _menus(hands)
    _other_pages(hands)
    _simulator(hands)
    _study(hands)
    _adviser(hands)
    _analysis(hands)
    _misnumber(hands)
    _blocked(hands, folder / "blocked")
    _moved(hands, folder / "blocked")
    _problems(hands, files)
    _help(hands)


def _begin_session(hands: Hands, files: Path) -> None:
    new = files / "plate 12.labsession"
    hands.answer_dialog("new", lambda: hands.do("new"), enter_path(new))


def _set_up(hands: Hands, files: Path) -> None:
    page = hands.on(SetupPage)
    hands.enter("Title", "Plate 12, bead on plate")
    hands.enter("Operator", "A. Welder")
    hands.enter("Current", "75")
    hands.picture("experiment")
    _tab(hands, page, 1)
    for box in list(page.ticks.values())[:3]:
        hands.press(box.text())
    hands.picture("safety")
    _tab(hands, page, 2)
    hands.picture("bench-empty")
    hands.answer_dialog(
        "load-setup", lambda: hands.press("Load…"), enter_path(files / "setup.toml")
    )
    hands.picture("bench")
    hands.answer_dialog("save-setup", lambda: hands.press("Save…"))


def _tab(hands: Hands, page: SetupPage, number: int) -> None:
    bar: QTabBar = page.tabs.tabBar()
    QTest.mouseClick(bar, Qt.MouseButton.LeftButton, pos=bar.tabRect(number).center())
    hands.settle()


def _laser(hands: Hands, files: Path) -> None:
    hands.do("next_step")
    page = hands.on(LaserPage)
    hands.picture("before")
    hands.choose("Lengths", "from a picture")
    picture = files / "cross_hair.png"
    hands.answer_dialog("cross-hair", lambda: hands.press("Load picture…"), enter_path(picture))
    hands.settle()
    for name, place in places().items():
        hands.drag(page.picture_view, page.places()[name], place)
    hands.picture("picture")
    hands.press("Add as a reading")
    hands.choose("Lengths", "by callipers")
    for row, off_mm in enumerate((0.03, -0.02), 1):
        for column, length in enumerate(CROSS_MM):
            hands.enter_cell(page.table, row, column, f"{length + off_mm:.2f}")
    hands.picture("callipers")
    hands.press("Apply")
    hands.picture("used")


def _plane(hands: Hands, files: Path) -> None:
    hands.do("next_step")
    hands.on(PlanePage)
    hands.picture("before")
    none = files / "no_target.png"
    hands.answer_dialog("target", lambda: hands.press("Load picture…"), enter_path(none))
    hands.picture("not-found", trouble=True)
    hands.dismiss()
    known = files / "calibration.png"
    hands.answer_dialog("", lambda: hands.press("Load picture…"), enter_path(known))
    hands.picture("found")
    hands.press("Apply")
    hands.picture("used")
    hands.answer_dialog("print-target", lambda: hands.press("Save for printing…"))


def _bench_check(hands: Hands, files: Path) -> None:
    hands.do("next_step")
    page = hands.on(BenchCheckPage)
    hands.picture("before")
    hands.press("Predict ± by pictures")
    hands.settle()
    picture = files / "plate.png"
    hands.answer_dialog("mirror", lambda: hands.press("Add picture…"), enter_path(picture))
    hands.settle()
    hands.press("Check")
    hands.wait(lambda: page.checked, "the bench to be checked")
    hands.picture("checked")
    hands.press("Apply")
    hands.picture("used")
    hands.do("undo")


def _record(hands: Hands, files: Path) -> None:
    hands.do("next_step")
    hands.picture("none")
    hands.answer_dialog("folder", lambda: hands.press("Choose folder…"))
    hands.answer_dialog(
        "file", lambda: hands.press("Choose file…"), enter_path(files / "recording.avi")
    )
    hands.settle()
    hands.enter("Last frame", str(FRAMES - 1))
    hands.picture("chosen")
    hands.press("Import")
    hands.picture("imported")
    hands.answer_dialog("import", lambda: hands.do("import"))
    hands.press("Find devices")
    hands.picture("foot-switch")


def _film(hands: Hands) -> None:
    """Show the simulated camera and record from it, into a file beside the session."""
    page = hands.on(CapturePage)
    hands.press("Start")
    view = page.live_view
    hands.wait(lambda: view.updates > 20 and page.exposure.isVisible(), "live frames")
    hands.wait(lambda: view.bar.ring.value() == 100, "the seconds before a trigger")
    hands.wait(lambda: view.measured_s, "a live frame to be measured")
    hands.picture("live")
    _live_parts(hands, page)
    hands.press("● Record")
    hands.wait(lambda: view.live and view.live.takes[0].frames > 150, "frames to be recorded")
    hands.picture("recording")
    hands.answer_dialog("recording-runs", lambda: hands.do("close"))
    hands.press("■ End recording")
    hands.press("Stop camera")
    hands.settle()
    hands.picture("second")
    hands.answer_dialog("next-session", lambda: hands.press("New session from this recording…"))


def _live_parts(hands: Hands, page: CapturePage) -> None:
    """Show the live pool in 3-D, its trends, an alarm, and the streams to control software."""
    canvas = page.live_view.canvas
    surface, streams = (list(PARTS).index(part) for part in ("surface", "streams"))
    canvas.tabs.setCurrentIndex(surface)
    hands.wait(lambda: canvas.surface.view.scene, "a live surface")
    hands.picture("live-surface")
    canvas.tabs.setCurrentIndex(list(PARTS).index("trends"))
    canvas.trends.canvas_parts.setCurrentIndex(1)  # visible on a small screen only
    hands.enter("Width, max.", "6")
    hands.wait(canvas.alarms.isVisible, "an alarm")
    if canvas.trends.canvas_parts.isVisible():
        hands.picture("live-limits", trouble=True)
    canvas.trends.canvas_parts.setCurrentIndex(0)
    hands.picture("live-alarm", trouble=True)
    canvas.trends.canvas_parts.setCurrentIndex(1)
    hands.press("Acknowledge")
    hands.enter("Width, max.", "9")
    hands.wait(lambda: not canvas.alarms.isVisible(), "the alarm to go")
    canvas.tabs.setCurrentIndex(streams)
    hands.picture("live-control")
    canvas.tabs.setCurrentIndex(0)


def _measure(hands: Hands) -> None:
    hands.do("step_surface")
    hands.picture("not-measured")
    hands.do("measure")
    hands.picture("measuring", busy=True)
    hands.do("close")
    hands.picture("recent")


def _surface(hands: Hands) -> None:
    hands.do("sample")
    page = hands.on(SurfacePage)
    hands.picture()
    hands.choose("Colour", "by ±")
    hands.press("Top")
    hands.picture("sigma")
    hands.choose("Colour", "by height")
    hands.press("Side")
    hands.enter("Heights ×", "5")
    hands.picture("side")
    hands.press("Oblique")
    hands.enter("Heights ×", "1")
    show = hands.find(QToolButton, "Show", QToolButton.text)
    hands.popup(show.menu(), "show", show.showMenu)
    page.drawn_items["rays"].trigger()
    hands.picture("rays")
    page.drawn_items["rays"].trigger()
    hands.answer_dialog("save-picture", lambda: hands.press("Save…"))
    hands.answer_dialog("save-copy", lambda: hands.do("copy"))


def _compare(hands: Hands) -> None:
    hands.press("Compare")
    hands.picture("compare")
    hands.press("Compare")


def _dots(hands: Hands) -> None:
    """Show the levels; delete a dot, add it again, and carry the correction on."""
    hands.do("step_dots")
    page = hands.on(DotsPage)
    hands.picture("automatic")
    page.view.show_levels()
    hands.picture("dialog-levels")
    levels = hands.window.findChild(QDialog, "picture-levels")
    assert isinstance(levels, QDialog)
    levels.close()
    hands.do("next")
    hands.settle()
    hands.key(Qt.Key.Key_Period)
    u, v = page.editor.dots_px[int(page.editor.selection[0])].tolist()
    hands.key(Qt.Key.Key_Delete)
    hands.picture("dot-deleted")
    hands.click(page.view, (u, v), twice=True)
    hands.picture("dot-added")
    hands.enter("At most", "1")
    hands.press("Carry on")
    hands.picture("carried-on")


def _trends(hands: Hands, files: Path) -> None:
    hands.do("step_trends")
    hands.picture()
    hands.choose("Spectrum of", "Length")
    hands.picture("spectrum")
    hands.choose("Spectrum of", "none")
    table = files / "current.csv"
    hands.answer_dialog("signals", lambda: hands.press("Load table…"), enter_path(table))
    hands.picture("signals")
    tool = _tool(hands, "dynamics", DynamicsWindow)
    hands.wait(lambda: tool.drawn and not tool.working, "the pool over time to be analysed")
    tool.tabs.setCurrentIndex(1)
    hands.picture("dialog-dynamics")
    hands.answer_dialog("save-dynamics", lambda: hands.press("Save the results…"))
    tool.close()


def _export(hands: Hands, files: Path) -> None:
    hands.do("step_export")
    hands.picture("before")
    hands.answer_dialog("where-to", lambda: hands.press("Choose folder…"), enter_path(files))
    hands.choose("Frames", "the frame in view")
    hands.press("Export")
    hands.picture("after")


def _other_pages(hands: Hands) -> None:
    """Take a picture of each page that no other function shows."""
    for step in STEPS:
        if step.key not in hands.pages:
            hands.do(f"step_{step.key}")
            hands.picture()


def _menus(hands: Hands) -> None:
    for menu in hands.window.menuBar().actions():
        hands.menu(menu.text().replace("&", ""))


def _simulator(hands: Hands) -> None:
    hands.do("step_setup")
    tool = _tool(hands, "simulator", SimulatorWindow)
    hands.wait(lambda: tool.preview, "the first frame of a scenario")
    hands.answer_dialog("scenario", lambda: hands.press("Load scenario…"))
    hands.answer_dialog("simulation-folder", lambda: hands.press("Choose folder…"))
    hands.enter("Frames", "2")
    hands.press("Simulate")
    hands.wait(lambda: tool.made, "the simulation to be written")
    hands.picture("dialog-simulator")
    tool.close()


def _study(hands: Hands) -> None:
    """Create and run a study of the simulated recording."""
    hands.do("step_setup")
    simulated = hands.window.findChild(SimulatorWindow).made
    tool = _tool(hands, "study", StudyWindow)
    hands.answer_dialog("study", lambda: hands.press("Open study…"))
    hands.answer_dialog("study-recordings", lambda: hands.press("Choose folder…"))
    hands.answer_dialog("study-setup", lambda: hands.press("Choose set-up…"))
    tool.take_folder(simulated[1])
    hands.answer_dialog("new-study", lambda: hands.press("Make study…"))
    tool.make(simulated[1].parent / "study.toml")
    hands.wait(lambda: tool.found and not tool.looks.active, "the study to be read")
    hands.press("Run")
    hands.wait(lambda: tool.summary and not tool.looks.active, "the study to be measured")
    hands.picture("dialog-study")
    tool.close()


def _adviser(hands: Hands) -> None:
    """Show the request only; a search would take too long."""
    tool = _tool(hands, "adviser", AdviserWindow)
    hands.picture("dialog-adviser")
    hands.answer_dialog("save-advice", tool.choose_folder)
    tool.close()


def _analysis(hands: Hands) -> None:
    """Run the fastest part of the analysis."""
    tool = _tool(hands, "analysis", AnalysisWindow)
    for key in ("budget", "measurement"):
        hands.press(tool.parts[key].text())
    hands.enter("Frames of each", "1")
    hands.press("Run")
    hands.wait(lambda: tool.files and not tool.working, "the thumb tack to be worked out")
    hands.picture("dialog-analysis")
    hands.answer_dialog("save-results", lambda: hands.press("Save the results…"))
    tool.close()


def _tool(hands: Hands, key: str, kind: type[T]) -> T:
    hands.do(key)
    tool = hands.window.findChild(kind)
    assert tool is not None
    return tool


def _misnumber(hands: Hands) -> None:
    """Shift a correct row: the fit takes long, is shown as running, and is left."""
    hands.do("step_dots")
    page = hands.on(DotsPage)
    hands.click_row(page.dots_panel.rows, 3)
    hands.picture("row-chosen")
    hands.key(Qt.Key.Key_Right, CTRL)
    hands.picture("row-shifted", busy=True)
    hands.do("undo")
    hands.do("close")


def _blocked(hands: Hands, folder: Path) -> None:
    """Open a session with frames that cannot be measured."""
    session = folder / "blocked_rows.labsession"
    hands.answer_dialog("open", lambda: hands.do("open"), enter_path(session))
    hands.settle()
    hands.do("step_dots")
    hands.do("next_doubtful")
    hands.picture("cannot-be-measured")
    hands.do("step_surface")
    hands.picture("cannot-be-measured")
    hands.do("step_trends")
    hands.picture("gaps")
    hands.do("close")


def _moved(hands: Hands, folder: Path) -> None:
    """Open a session whose recording was moved, and one that is open elsewhere."""
    recording, elsewhere = folder / "recording.mkv", folder / "elsewhere"
    elsewhere.mkdir()
    recording.rename(elsewhere / recording.name)
    session = folder / "blocked_rows.labsession"
    with Session.open(session):
        hands.answer_dialog("read-only", lambda: hands.window.files.open(session), _agree)
    hands.do("step_capture")
    hands.picture("read-only", trouble=True)
    hands.dismiss()
    hands.do("close")
    QTest.keyClick(hands.window.welcome.list, Qt.Key.Key_Return)  # the last open session
    hands.do("step_capture")
    hands.picture("missing", trouble=True)
    hands.dismiss()
    answer = enter_path(elsewhere / recording.name)
    hands.answer_dialog("where-is", lambda: hands.press("Locate…"), answer)
    hands.picture("found-again")
    hands.do("close")


def _agree(dialog: QDialog) -> None:
    assert isinstance(dialog, QMessageBox)
    QTest.mouseClick(dialog.defaultButton(), Qt.MouseButton.LeftButton)


def _problems(hands: Hands, files: Path) -> None:
    hands.settle()
    hands.window.files.open_path(files / "damaged.labsession")
    hands.picture("problem", trouble=True)
    hands.press("Messages")
    hands.picture("messages")
    hands.do("log")


def _help(hands: Hands) -> None:
    for kind in ("guide", "keys", "about"):
        hands.do(kind)
        hands.picture(f"dialog-{kind}")
        dialog = hands.window.findChild(QDialog, f"help-{kind}")
        assert isinstance(dialog, QDialog)
        QTest.keyClick(dialog, Qt.Key.Key_Escape)
