"""The tour under Xvfb: every page and every dialog has a picture that is not blank."""

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
from labapp.gui.shell.actions import MENUS
from labapp.gui.shell.help import TITLES
from labapp.gui.shell.steps import STEPS
from labapp.gui.tools import TOOLS
from tests.screen import screen
from tests.waiting import PATIENCE_S

GUI = Path(labapp.__file__).parent / "gui"
TOUR = (sys.executable, "-m", "tests.tour")
ROOT = Path(__file__).parents[2]
SIZE = (1280, 760)
ASKING = ("ask_file", "ask_folder", "ask_save", "ask_new_session", "setWindowTitle")


def environment(home: Path, platform: str) -> dict[str, str]:
    folders = {"HOME": home, "XDG_CONFIG_HOME": home / "config", "XDG_STATE_HOME": home / "state"}
    inherited = {k: v for k, v in os.environ.items() if k != "VTK_DEFAULT_OPENGL_WINDOW"}
    return {**inherited, "QT_QPA_PLATFORM": platform, **{k: str(v) for k, v in folders.items()}}


@pytest.fixture(scope="module")
def taken(opengl: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, Path]:
    """The folder of the pictures, the output of the tour, and its home folder."""
    out, home = tmp_path_factory.mktemp("tour"), tmp_path_factory.mktemp("home")
    with screen(*SIZE) as display:
        process = subprocess.run(
            [*TOUR, "--out", out, "--size", "{}x{}".format(*SIZE)],
            cwd=ROOT,
            env={**environment(home, "xcb"), "DISPLAY": display},
            capture_output=True,
            text=True,
            timeout=5 * PATIENCE_S,
            check=False,
        )
    assert process.returncode == 0, f"{process.stdout[-300:]}\n{process.stderr}"
    return out, process.stdout, home


def levels(file: Path) -> np.ndarray:
    """Grey levels of a picture, shape (height, width)."""
    return cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)


def pictures_of(taken: tuple[Path, str, Path], part: str) -> list[Path]:
    return sorted(taken[0].glob(f"[0-9][0-9][0-9]-{part}.png"))


@pytest.mark.soak
@pytest.mark.xvfb
def test_pictures_have_the_requested_size_and_are_not_blank(
    taken: tuple[Path, str, Path],
):
    out, stdout, _ = taken
    names = [line.split()[0] for line in stdout.splitlines() if re.match(r"\d{3}-\S+\.png", line)]
    assert names == sorted(path.name for path in out.iterdir())
    assert [int(name[:3]) for name in names] == list(range(1, len(names) + 1))
    for name in names:
        picture = levels(out / name)
        assert picture.shape == SIZE[::-1], name
        assert picture.std() > 5, name
        assert len(np.unique(picture)) > 20, name


@pytest.mark.soak
@pytest.mark.xvfb
def test_no_two_pictures_are_the_same(taken: tuple[Path, str, Path]):
    out, _, _ = taken
    contents = [path.read_bytes() for path in sorted(out.iterdir())]
    assert len(set(contents)) == len(contents)


@pytest.mark.soak
@pytest.mark.xvfb
@pytest.mark.parametrize("key", ["welcome", *(step.key for step in STEPS)])
def test_every_page_has_a_picture(taken: tuple[Path, str, Path], key: str):
    assert pictures_of(taken, key) + pictures_of(taken, f"{key}-*")


@pytest.mark.soak
@pytest.mark.xvfb
def test_every_menu_has_a_picture(taken: tuple[Path, str, Path]):
    for menu in MENUS:
        assert pictures_of(taken, f"*-menu-{menu.replace('&', '').lower()}"), menu


def asked_titles() -> Iterator[str]:
    """The start of the title of each dialog of the app, read from its source."""
    for path in sorted(GUI.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call):
                name = getattr(node.func, "attr", getattr(node.func, "id", ""))
                if name in ASKING:
                    yield from itertools.islice(_texts(node.args), 1)


def _texts(arguments: list[ast.expr]) -> Iterator[str]:
    """The texts among arguments; of one that is composed, its start."""
    for argument in arguments:
        first = argument.values[0] if isinstance(argument, ast.JoinedStr) else argument
        if isinstance(first, ast.Constant) and isinstance(first.value, str):
            yield first.value


@pytest.mark.soak
@pytest.mark.xvfb
def test_every_file_dialog_and_question_has_a_picture(
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
    """All dialogs of the app have pictures: each help text and each tool."""
    classes = {
        node.name
        for path in GUI.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.ClassDef)
        and any(isinstance(base, ast.Name) and base.id == "QDialog" for base in node.bases)
    }
    assert classes == {"HelpDialog", "ToolWindow", "PaperDialog", "LevelsDialog"}
    for kind in (*TITLES, *TOOLS, "save-picture", "levels"):
        assert pictures_of(taken, f"dialog-{kind}")


@pytest.mark.soak
@pytest.mark.xvfb
def test_3d_views_are_drawn(taken: tuple[Path, str, Path]):
    """The centre of the canvas shows the surface: many levels, which differ between the views."""
    pictures = []
    for name in ("surface", "surface-sigma", "surface-side", "surface-rays", "surface-compare"):
        (file,) = pictures_of(taken, name)
        part = levels(file)[80:380, 180:600]
        assert part.std() > 12, name
        assert len(np.unique(part)) > 60, name
        pictures.append(part)
    for one, other in itertools.pairwise(pictures):
        assert np.abs(one.astype(int) - other).mean() > 1


@pytest.mark.soak
@pytest.mark.xvfb
def test_tour_leaves_only_the_log_in_the_home_folder(taken: tuple[Path, str, Path]):
    home = taken[2]
    left = {path.relative_to(home).parts[:2] for path in home.rglob("*") if path.is_file()}
    assert {parts for parts in left if not parts[0].startswith(".cache")} <= {("state", "labapp")}


def rejection(home: Path, *arguments: object) -> str:
    """Run a tour that must be rejected, without a display; return its error message."""
    displays = ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM")
    process = subprocess.run(
        [*TOUR, *map(str, arguments)],
        cwd=ROOT,
        env={k: v for k, v in environment(home, "").items() if k not in displays},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert process.returncode == 2, process.stderr
    assert "Traceback" not in process.stderr
    return process.stderr


def test_missing_display_is_reported(tmp_path: Path):
    assert "display" in rejection(tmp_path, "--out", tmp_path / "out")


@pytest.mark.parametrize("size", ["large", "1366", "1366x", "0x0", "99999x10"])
def test_invalid_size_is_rejected(tmp_path: Path, size: str):
    assert "1366x768" in rejection(tmp_path, "--out", tmp_path / "out", "--size", size)
    assert not (tmp_path / "out").exists()


def test_invalid_folder_is_rejected(tmp_path: Path):
    (tmp_path / "file").write_text("")
    assert "folder that can be written" in rejection(tmp_path, "--out", tmp_path / "file" / "out")


BROKEN = """
import sys
from tests.tour.__main__ import main
from labapp.gui.pages.{page}.page import {kind} as Kind
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
def test_exception_on_a_page_ends_the_tour_and_names_the_page(
    tmp_path: Path, page: str, kind: str, method: str
):
    code = BROKEN.format(page=page, kind=kind, method=method)
    process = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "out"],
        cwd=ROOT,
        env=environment(tmp_path / "home", "offscreen"),
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert process.returncode == 1, process.stderr
    assert f"ended early. {page}: " in process.stderr
    assert "not today" in process.stderr
