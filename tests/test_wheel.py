"""The wheel as a user installs it: in an empty environment, outside the checkout."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import skip_or_fail
from tests.screen import screen
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.slow

Start = Callable[..., str]


def run(*command: object, cwd: Path, **variables: str) -> str:
    """Run a program that cannot see this checkout; return its output."""
    removed = ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM", "PYTHONPATH", "VIRTUAL_ENV")
    process = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env={**{k: v for k, v in os.environ.items() if k not in removed}, **variables},
        capture_output=True,
        text=True,
        timeout=5 * PATIENCE_S,
        check=False,
    )
    assert process.returncode == 0, f"{process.stdout}\n{process.stderr}"
    return process.stdout


@pytest.fixture(scope="module")
def uv() -> Path:
    executable = shutil.which(
        "uv", path=f"{ROOT / '.tools' / 'bin'}{os.pathsep}{os.environ['PATH']}"
    )
    if executable is None:
        skip_or_fail("uv is not here")
    return Path(str(executable))


@pytest.fixture(scope="module")
def away(uv: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel, the locked requirements and an empty environment."""
    folder = tmp_path_factory.mktemp("away")
    run(uv, "build", "--wheel", "--out-dir", folder, ROOT, cwd=folder)
    run(
        *(uv, "export", "--project", ROOT, "--locked", "--no-dev", "--all-extras"),
        *("--no-emit-project", "--no-hashes", "--output-file", folder / "locked.txt"),
        cwd=folder,
    )
    run(uv, "venv", "--no-project", "--python", sys.executable, folder / "env", cwd=folder)
    return folder


def own_folders(away: Path) -> dict[str, str]:
    return {"XDG_CONFIG_HOME": str(away / "config"), "XDG_STATE_HOME": str(away / "state")}


def install(uv: Path, away: Path, extra: str) -> Start:
    """Install the wheel with an extra; return a function that runs its labapp."""
    (wheel,) = away.glob("*.whl")
    run(
        *(uv, "pip", "install", "--python", away / "env", "--constraint", away / "locked.txt"),
        f"labapp{extra} @ {wheel.as_uri()}",
        cwd=away,
    )

    def start(*arguments: object, **variables: str) -> str:
        return run(
            away / "env" / "bin" / "labapp", *arguments, cwd=away, **own_folders(away), **variables
        )

    return start


def test_wheel_without_gui_measures_and_simulates(uv: Path, away: Path) -> None:
    labapp = install(uv, away, "")
    assert "3-D" in labapp("demo", "--frames", "0:2", "--no-window", "--out", "demo")
    assert {"measures.csv", "report.pdf"} <= {p.name for p in (away / "demo" / "results").iterdir()}
    assert not list((away / "demo").glob("surface_*.png"))
    labapp("simulate", "mode_11", "--out", "simulated", "--frames", 1)
    assert (away / "simulated" / "recording.avi").stat().st_size > 10_000


@pytest.mark.xvfb
@pytest.mark.usefixtures("opengl")
def test_wheel_with_gui_opens_every_page(uv: Path, away: Path) -> None:
    labapp = install(uv, away, "[gui,study]")
    labapp("demo", "--frames", "0:1", "--no-window", "--out", "demo in 3-D")
    assert list((away / "demo in 3-D").glob("surface_*.png"))
    shutil.copytree(
        ROOT / "tests" / "tour", away / "tour"
    )  # where the labapp of the checkout cannot be imported
    environment = {**own_folders(away), "QT_QPA_PLATFORM": "xcb"}
    with screen(1366, 768) as display:
        run(
            *(away / "env" / "bin" / "python", "-m", "tour", "--out", "pictures"),
            cwd=away,
            DISPLAY=display,
            **environment,
        )
    assert len(list((away / "pictures").glob("*.png"))) > 30
