"""The way of the tour: what an operator does from the first start to the export."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QDialog, QMessageBox, QTabBar, QToolButton

from labapp.gui.live.canvas import PARTS
from labapp.gui.pages.bench_check import BenchCheckPage
from labapp.gui.pages.capture import CapturePage
from labapp.gui.pages.dots import DotsPage
from labapp.gui.pages.laser import LaserPage
from labapp.gui.pages.plane import PlanePage
from labapp.gui.pages.setup import SetupPage
from labapp.gui.pages.surface import SurfacePage
from labapp.gui.shell.steps import STEPS
from labapp.gui.tools.adviser import AdviserWindow
from labapp.gui.tools.analysis import AnalysisWindow
from labapp.gui.tools.dynamics import DynamicsWindow
from labapp.gui.tools.simulator import SimulatorWindow
from labapp.gui.tools.study import StudyWindow
from labapp.gui.tools.tool import ToolWindow
from labapp.session.session import Session

from .bench import CROSS_MM, places
from .hands import CTRL, Hands, give

T = TypeVar("T", bound=ToolWindow)

FRAMES = 6
"""So many are imported: enough to see, soon measured."""


def go_through(hands: Hands, folder: Path) -> None:
    """Go through the whole app.

    Parameters
    ----------
    hands
        What drives the window.
    folder
        Of `bench.lay_out`.

    Raises
    ------
    TourFailed
        If a page does not do what it should.
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
    _troubles(hands, files)
    _help(hands)


def _begin_session(hands: Hands, files: Path) -> None:
    new = files / "plate 12.labsession"
    hands.asked("new", lambda: hands.do("new"), give(new))


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
    hands.asked("load-setup", lambda: hands.press("Load…"), give(files / "setup.toml"))
    hands.picture("bench")
    hands.asked("save-setup", lambda: hands.press("Save…"))


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
    hands.asked("cross-hair", lambda: hands.press("Load picture…"), give(picture))
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
    hands.asked("target", lambda: hands.press("Load picture…"), give(none))
    hands.picture("not-found", trouble=True)
    hands.read()
    known = files / "calibration.png"
    hands.asked("", lambda: hands.press("Load picture…"), give(known))
    hands.picture("found")
    hands.press("Apply")
    hands.picture("used")
    hands.asked("print-target", lambda: hands.press("Save for printing…"))


def _bench_check(hands: Hands, files: Path) -> None:
    hands.do("next_step")
    page = hands.on(BenchCheckPage)
    hands.picture("before")
    hands.press("Predict ± by pictures")
    hands.settle()
    picture = files / "plate.png"
    hands.asked("mirror", lambda: hands.press("Add picture…"), give(picture))
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
    hands.asked("folder", lambda: hands.press("Choose folder…"))
    hands.asked("file", lambda: hands.press("Choose file…"), give(files / "recording.avi"))
    hands.settle()
    hands.enter("Last frame", str(FRAMES - 1))
    hands.picture("chosen")
    hands.press("Import")
    hands.picture("imported")
    hands.asked("import", lambda: hands.do("import"))
    hands.press("Find devices")
    hands.picture("foot-switch")


def _film(hands: Hands) -> None:
    """Watch the simulated camera and record from it; the session has a recording: it is a file."""
    page = hands.on(CapturePage)
    hands.press("Start")
    view = page.live_view
    hands.wait(lambda: view.updates > 20 and page.exposure.isVisible(), "live frames")
    hands.wait(lambda: view.bar.ring.value() == 100, "the seconds before a trigger")
    hands.wait(lambda: view.measured_s, "a live frame to be measured")
    hands.picture("live")
    _look_on(hands, page)
    hands.press("● Record")
    hands.wait(lambda: view.live and view.live.takes[0].frames > 150, "frames to be recorded")
    hands.picture("recording")
    hands.asked("recording-runs", lambda: hands.do("close"))
    hands.press("■ End recording")
    hands.press("Stop camera")
    hands.settle()
    hands.picture("second")
    hands.asked("next-session", lambda: hands.press("New session from this recording…"))


def _look_on(hands: Hands, page: CapturePage) -> None:
    """The live pool in 3-D, its trend, a limit that it passes, and who can be told."""
    canvas = page.live_view.canvas
    surface, streams = (list(PARTS).index(part) for part in ("surface", "streams"))
    canvas.tabs.setCurrentIndex(surface)
    hands.wait(lambda: canvas.surface.view.scene, "a live surface")
    hands.picture("live-surface")
    canvas.tabs.setCurrentIndex(list(PARTS).index("trends"))
    canvas.trends.canvas_parts.setCurrentIndex(1)  # seen on a small screen only
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
    hands.read()
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
    show = hands.found(QToolButton, "Show", QToolButton.text)
    hands.popup(show.menu(), "show", show.showMenu)
    page.parts["rays"].trigger()
    hands.picture("rays")
    page.parts["rays"].trigger()
    hands.asked("save-picture", lambda: hands.press("Save…"))
    hands.asked("save-copy", lambda: hands.do("copy"))


def _compare(hands: Hands) -> None:
    hands.press("Compare")
    hands.picture("compare")
    hands.press("Compare")


def _dots(hands: Hands) -> None:
    """Look at levels; take a dot out, add it again, and carry that on."""
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
    hands.choose("Spectrum of", "Height")
    hands.picture("spectrum")
    hands.choose("Spectrum of", "none")
    table = files / "current.csv"
    hands.asked("signals", lambda: hands.press("Load table…"), give(table))
    hands.picture("signals")
    tool = _tool(hands, "dynamics", DynamicsWindow)
    hands.wait(lambda: tool.drawn and not tool.working, "the pool over time to be analysed")
    tool.tabs.setCurrentIndex(1)
    hands.picture("dialog-dynamics")
    hands.asked("save-dynamics", lambda: hands.press("Save the results…"))
    tool.close()


def _export(hands: Hands, files: Path) -> None:
    hands.do("step_export")
    hands.picture("before")
    hands.asked("where-to", lambda: hands.press("Choose folder…"), give(files))
    hands.choose("Frames", "the frame in view")
    hands.press("Export")
    hands.picture("after")


def _other_pages(hands: Hands) -> None:
    """The pages that have no part of the way of their own: a picture each."""
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
    hands.asked("scenario", lambda: hands.press("Load scenario…"))
    hands.asked("simulation-folder", lambda: hands.press("Choose folder…"))
    hands.enter("Frames", "2")
    hands.press("Simulate")
    hands.wait(lambda: tool.made, "the simulation to be written")
    hands.picture("dialog-simulator")
    tool.close()


def _study(hands: Hands) -> None:
    """A study of the recording that was simulated, made and measured."""
    hands.do("step_setup")
    made = hands.window.findChild(SimulatorWindow).made
    tool = _tool(hands, "study", StudyWindow)
    hands.asked("study", lambda: hands.press("Open study…"))
    hands.asked("study-recordings", lambda: hands.press("Choose folder…"))
    hands.asked("study-setup", lambda: hands.press("Choose set-up…"))
    tool.take_folder(made[1])
    hands.asked("new-study", lambda: hands.press("Make study…"))
    tool.make(made[1].parent / "study.toml")
    hands.wait(lambda: tool.found and not tool.looks.active, "the study to be read")
    hands.press("Run")
    hands.wait(lambda: tool.summary and not tool.looks.active, "the study to be measured")
    hands.picture("dialog-study")
    tool.close()


def _adviser(hands: Hands) -> None:
    """What it asks; a search would take the tour's time."""
    tool = _tool(hands, "adviser", AdviserWindow)
    hands.picture("dialog-adviser")
    hands.asked("save-advice", tool.choose_folder)
    tool.close()


def _analysis(hands: Hands) -> None:
    """The part that is done soonest."""
    tool = _tool(hands, "analysis", AnalysisWindow)
    for key in ("budget", "measurement"):
        hands.press(tool.parts[key].text())
    hands.enter("Frames of each", "1")
    hands.press("Run")
    hands.wait(lambda: tool.files and not tool.working, "the thumb tack to be worked out")
    hands.picture("dialog-analysis")
    hands.asked("save-results", lambda: hands.press("Save the results…"))
    tool.close()


def _tool(hands: Hands, key: str, kind: type[T]) -> T:
    hands.do(key)
    tool = hands.window.findChild(kind)
    assert tool is not None
    return tool


def _misnumber(hands: Hands) -> None:
    """Shift a row that was right: the fit takes long and says so, and is left."""
    hands.do("step_dots")
    page = hands.on(DotsPage)
    hands.click_row(page.dots_panel.rows, 3)
    hands.picture("row-chosen")
    hands.key(Qt.Key.Key_Right, CTRL)
    hands.picture("row-shifted", busy=True)
    hands.do("undo")
    hands.do("close")


def _blocked(hands: Hands, folder: Path) -> None:
    """A session with frames that cannot be measured."""
    session = folder / "blocked_rows.labsession"
    hands.asked("open", lambda: hands.do("open"), give(session))
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
    """The recording is not where it was; a session is open elsewhere."""
    there, elsewhere = folder / "recording.mkv", folder / "elsewhere"
    elsewhere.mkdir()
    there.rename(elsewhere / there.name)
    session = folder / "blocked_rows.labsession"
    with Session.open(session):
        hands.asked("read-only", lambda: hands.window.files.open(session), _agree)
    hands.do("step_capture")
    hands.picture("read-only", trouble=True)
    hands.read()
    hands.do("close")
    QTest.keyClick(hands.window.welcome.list, Qt.Key.Key_Return)  # the last one that was open
    hands.do("step_capture")
    hands.picture("missing", trouble=True)
    hands.read()
    found = give(elsewhere / there.name)
    hands.asked("where-is", lambda: hands.press("Locate…"), found)
    hands.picture("found-again")
    hands.do("close")


def _agree(dialog: QDialog) -> None:
    assert isinstance(dialog, QMessageBox)
    QTest.mouseClick(dialog.defaultButton(), Qt.MouseButton.LeftButton)


def _troubles(hands: Hands, files: Path) -> None:
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
