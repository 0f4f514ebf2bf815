"""The tour under Xvfb: every page and every dialog has a picture that shows something."""

from __future__ import annotations

import ast
import itertools
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

import labapp
from labapp.gui.pages import PAGES
from labapp.gui.shell.actions import MENUS
from labapp.gui.shell.help import TITLES
from labapp.gui.tools import TOOLS
from tests.screen import screen
from tests.waiting import PATIENCE_S

GUI = Path(labapp.__file__).parent / "gui"
TOUR = (sys.executable, "-m", "tests.tour")
ROOT = Path(__file__).parents[2]
SIZE = (1280, 760)
ASKING = ("getOpenFileName", "getSaveFileName", "getExistingDirectory")


def environment(home: Path, platform: str) -> dict[str, str]:
    folders = {"HOME": home, "XDG_CONFIG_HOME": home / "config", "XDG_STATE_HOME": home / "state"}
    kept = {k: v for k, v in os.environ.items() if k != "VTK_DEFAULT_OPENGL_WINDOW"}
    return {**kept, "QT_QPA_PLATFORM": platform, **{k: str(v) for k, v in folders.items()}}


@pytest.fixture(scope="module")
def taken(opengl: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, Path]:
    """The pictures' folder, what was said, and the home folder of who took the tour."""
    out, home = tmp_path_factory.mktemp("tour"), tmp_path_factory.mktemp("home")
    with screen(*SIZE) as display:
        done = subprocess.run(
            [*TOUR, "--out", out, "--size", "{}x{}".format(*SIZE)],
            cwd=ROOT,
            env={**environment(home, "xcb"), "DISPLAY": display},
            capture_output=True,
            text=True,
            timeout=5 * PATIENCE_S,
            check=False,
        )
    assert done.returncode == 0, f"{done.stdout[-300:]}\n{done.stderr}"
    return out, done.stdout, home


def levels(file: Path) -> np.ndarray:
    """Grey levels of a picture, shape (height, width)."""
    return cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)


def named(taken: tuple[Path, str, Path], part: str) -> list[Path]:
    return sorted(taken[0].glob(f"[0-9][0-9]-{part}.png"))


@pytest.mark.soak
@pytest.mark.xvfb
def test_every_picture_is_there_as_large_as_asked_for_and_shows_something(
    taken: tuple[Path, str, Path],
):
    out, told, _ = taken
    names = [line.split()[0] for line in told.splitlines() if re.match(r"\d\d-\S+\.png", line)]
    assert names == sorted(path.name for path in out.iterdir())
    assert [int(name[:2]) for name in names] == list(range(1, len(names) + 1))
    for name in names:
        picture = levels(out / name)
        assert picture.shape == SIZE[::-1], name
        assert picture.std() > 5, name
        assert len(np.unique(picture)) > 20, name


@pytest.mark.soak
@pytest.mark.xvfb
def test_no_two_pictures_are_the_same(taken: tuple[Path, str, Path]):
    out, _, _ = taken
    seen = [path.read_bytes() for path in sorted(out.iterdir())]
    assert len(set(seen)) == len(seen)


@pytest.mark.soak
@pytest.mark.xvfb
@pytest.mark.parametrize("key", ["welcome", *PAGES])
def test_every_page_has_a_picture(taken: tuple[Path, str, Path], key: str):
    assert named(taken, key) + named(taken, f"{key}-*")


@pytest.mark.soak
@pytest.mark.xvfb
def test_every_menu_has_a_picture(taken: tuple[Path, str, Path]):
    for menu in MENUS:
        assert named(taken, f"*-menu-{menu.replace('&', '').lower()}"), menu


def asked_titles() -> Iterator[str]:
    """How the title begins of each dialog that the app opens, read from its source."""
    for path in sorted(GUI.rglob("*.py")):
        tree = ast.parse(path.read_text("utf-8"))
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef):
                yield from _titles_in(function, path)


def _titles_in(function: ast.FunctionDef, path: Path) -> Iterator[str]:
    calls = [node for node in ast.walk(function) if isinstance(node, ast.Attribute)]
    if any(call.attr in ASKING for call in calls):
        texts = [
            text.value
            for text in ast.walk(function)
            if isinstance(text, ast.Constant) and isinstance(text.value, str)
        ]
        titles = [text for text in texts if re.match(r"[A-Z][a-z]+ (?!files)[a-z]", text)]
        docstring = ast.get_docstring(function, clean=False)
        titles = [title for title in titles if title != docstring]
        assert titles, f"{path.name}: {function.name} opens a dialog without a title"
        yield titles[0]
    made = [
        node.func.id
        for node in ast.walk(function)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    ]
    if "QMessageBox" in made:
        yield from (
            call.args[0].value
            for call in ast.walk(function)
            if isinstance(call, ast.Call)
            and isinstance(call.func, ast.Attribute)
            and call.func.attr == "setWindowTitle"
            and isinstance(call.args[0], ast.Constant)
        )


@pytest.mark.soak
@pytest.mark.xvfb
def test_every_question_for_a_file_and_every_other_question_has_a_picture(
    taken: tuple[Path, str, Path],
):
    lines = [line.partition(".png  ")[2] for line in taken[1].splitlines()]
    shown = [title for line in lines for title in line.split("  ")]
    titles = list(asked_titles())
    assert len(titles) >= 10
    assert not [t for t in titles if not any(one.startswith(t) for one in shown)]


@pytest.mark.soak
@pytest.mark.xvfb
def test_every_dialog_class_has_a_picture(taken: tuple[Path, str, Path]):
    """The app's own have pictures: each text of the help, each tool."""
    own = {
        node.name
        for path in GUI.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.ClassDef)
        and any(isinstance(base, ast.Name) and base.id == "QDialog" for base in node.bases)
    }
    assert own == {"HelpDialog", "ToolWindow", "PaperDialog", "LevelsDialog"}
    for kind in (*TITLES, *TOOLS, "save-picture", "levels"):
        assert named(taken, f"dialog-{kind}")


@pytest.mark.soak
@pytest.mark.xvfb
def test_the_3d_views_are_drawn(taken: tuple[Path, str, Path]):
    """Middle of the canvas, where the surface is: many levels, and not those of another look."""
    looks = []
    for name in ("surface", "surface-sigma", "surface-side", "surface-rays", "surface-compare"):
        (file,) = named(taken, name)
        part = levels(file)[80:380, 180:600]
        assert part.std() > 12, name
        assert len(np.unique(part)) > 60, name
        looks.append(part)
    for one, other in itertools.pairwise(looks):
        assert np.abs(one.astype(int) - other).mean() > 1


@pytest.mark.soak
@pytest.mark.xvfb
def test_nothing_is_left_in_the_home_folder_but_the_log(taken: tuple[Path, str, Path]):
    home = taken[2]
    left = {path.relative_to(home).parts[:2] for path in home.rglob("*") if path.is_file()}
    assert {parts for parts in left if not parts[0].startswith(".cache")} <= {("state", "labapp")}


def refused(home: Path, *arguments: object) -> str:
    """What the tour says that does not begin, where there is no display."""
    displays = ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM")
    done = subprocess.run(
        [*TOUR, *map(str, arguments)],
        cwd=ROOT,
        env={k: v for k, v in environment(home, "").items() if k not in displays},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr


def test_without_a_display_it_says_so(tmp_path: Path):
    assert "display" in refused(tmp_path, "--out", tmp_path / "out")


@pytest.mark.parametrize("size", ["large", "1366", "1366x", "0x0", "99999x10"])
def test_a_size_that_is_none_is_refused(tmp_path: Path, size: str):
    assert "1366x768" in refused(tmp_path, "--out", tmp_path / "out", "--size", size)
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_is_refused(tmp_path: Path):
    (tmp_path / "file").write_text("")
    assert "folder that can be written" in refused(tmp_path, "--out", tmp_path / "file" / "out")


BROKEN = """
import sys
from tests.tour.__main__ import main
from labapp.gui.pages.{page} import {kind} as Kind
def fail(*_):
    raise RuntimeError("not today")
Kind.{method} = fail
sys.exit(main(["--out", sys.argv[1]]))
"""


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize(
    ("page", "kind", "method"),
    [
        ("setup", "SetupPage", "refresh"),
        pytest.param("laser", "LaserPage", "_show_way", marks=pytest.mark.soak),
    ],
)
def test_a_page_that_throws_ends_it_and_is_named(tmp_path: Path, page: str, kind: str, method: str):
    code = BROKEN.format(page=page, kind=kind, method=method)
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "out"],
        cwd=ROOT,
        env=environment(tmp_path / "home", "offscreen"),
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 1, done.stderr
    assert f"ended early. {page}: " in done.stderr
    assert "not today" in done.stderr
