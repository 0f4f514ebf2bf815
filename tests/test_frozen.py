"""The frozen program (`./run build`), outside the checkout and without a Python."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.conftest import skip_or_fail
from tests.screen import screen
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.soak


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the frozen program, moved to another place."""
    process = subprocess.run([ROOT / "run", "build"], cwd=ROOT, check=False)
    assert process.returncode == 0
    (archive,) = (ROOT / "build" / "packages").glob("*.tar.gz")
    folder = tmp_path_factory.mktemp("frozen")
    shutil.unpack_archive(archive, folder, filter="data")
    return folder / "labapp" / "labapp"


@pytest.fixture
def bare(tmp_path: Path) -> Mapping[str, str]:
    """Return an environment without a Python."""
    return {"PATH": os.defpath, "HOME": str(tmp_path / "home"), "LANG": "C.UTF-8"}


def test_frozen_program_measures_exports_and_draws(
    program: Path, bare: Mapping[str, str], tmp_path: Path
) -> None:
    process = subprocess.run(
        [program, "demo", "--frames", "0:2", "--no-window", "--out", "out"],
        cwd=tmp_path, env=bare, capture_output=True, text=True, check=False,
        timeout=5 * PATIENCE_S,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    results = {path.name for path in (tmp_path / "out" / "results").iterdir()}
    assert {"measures.csv", "report.pdf"} <= results
    assert list((tmp_path / "out").glob("surface_*.png"))


@pytest.mark.xvfb
@pytest.mark.usefixtures("opengl")
def test_frozen_window_opens_a_session_and_closes(
    program: Path, bare: Mapping[str, str], tmp_path: Path
) -> None:
    if shutil.which("xdotool") is None:
        skip_or_fail("xdotool is not here")
    session = tmp_path / "gtaw.labsession"
    shutil.copy(ROOT / "sample_sessions" / "gtaw" / session.name, session)
    with screen(1366, 768) as display:
        environment = {**bare, "DISPLAY": display}
        app = subprocess.Popen([program, session], env=environment, cwd=tmp_path)
        try:
            deadline = time.monotonic() + PATIENCE_S
            search = ["xdotool", "search", "--onlyvisible", "--name", "gtaw"]
            while subprocess.run(
                search, env=environment, capture_output=True, check=False
            ).returncode:
                assert app.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.2)
            app.send_signal(signal.SIGTERM)
            assert app.wait(PATIENCE_S) == 0
        finally:
            app.kill()
