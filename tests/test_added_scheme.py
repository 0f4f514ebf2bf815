"""A scheme is a file and an entry of `SCHEMES` (docs/development.md); it is offered everywhere.

Python loads the `sitecustomize` below at the start of each process, before labapp.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from labapp.config.settings import check_algorithm, check_settings
from labapp.core import schemes
from labapp.core.pipeline import Settings, reconstruct
from labapp.errors import InputError
from labapp.session.file.blobs import Damaged, pack, unpack
from labapp.session.file.stored import NAMES, STORED, Stored
from labapp.session.results.measured import scheme_name
from tests.waiting import PATIENCE_S

SAMPLE = Path(__file__).parents[1] / "sample_sessions" / "gtaw"

SITE = """
from pathlib import Path
from labapp.core import schemes

schemes.__path__.append(str(Path(__file__).parent))
words = schemes.Words("the toy", "Toy: a quadric by least squares")
schemes.SCHEMES["toy"] = schemes.Scheme("toy", "a toy", words)
"""

TOY = '''
"""The quadric whose slopes fit those that the reflections ask for on the work piece."""

import numpy as np

from labapp.core.schemes.slopes import Estimate, reflected_rays, reconstruction_within
from labapp.core.surface.boundary import boundary_on_work_piece
from labapp.core.surface.interpolation import ThinPlateSurface


def reconstruct(match, rig, settings):
    assert settings is None
    rays = reflected_rays(match, rig)
    boundary = boundary_on_work_piece(match, rig, "piecewise")
    distance = rays.distance_at(0.0)
    points, normal = rays.points(distance), rays.normals(distance)
    x, y, _ = points.T
    none, one = 0 * x, 0 * x + 1
    along_x = np.column_stack([one, none, 2 * x, y, none])
    along_y = np.column_stack([none, one, none, x, 2 * y])
    slope = -(normal[:, :2] / normal[:, 2:]).T.ravel()
    quadric = np.linalg.lstsq(np.vstack([along_x, along_y]), slope)[0]

    def height(x, y):
        return np.column_stack([x, y, x * x, x * y, y * y]) @ quadric

    points[:, 2] = height(x, y) - height(*boundary.points_mm[:, :2].T).mean()
    best = Estimate(points, ThinPlateSurface(points), np.nan)
    return reconstruction_within("toy", match, rays, best, boundary)
'''

IN_THE_WINDOW = """
import json, sys

from PySide6.QtWidgets import QApplication, QVBoxLayout, QWidget

app = QApplication([])
from labapp.gui.pages.export import presenter as export
from labapp.gui.pages.surface import compare, comparison, panel, presenter
from labapp.gui.tools import analysis_presenter
from labapp.gui.widgets.labels import Message
from labapp.gui.workspace import Workspace
from labapp.session.session import Session
from labapp.studies import analysis, error_analysis, pictures


def offered(field):
    combo = field._combo
    return {combo.itemData(k): combo.itemText(k) for k in range(combo.count())}


holder = QWidget()
side = panel.SurfacePanel(Workspace(), QVBoxLayout(holder), Message(1))
box = compare._SchemeBox("First")
found = {
    "surface page": offered(side.scheme),
    "comparison": offered(box.choice),
    "error analysis, window": dict(analysis_presenter.SCHEME_CHOICES),
    "error analysis": dict.fromkeys(analysis.AnalysisOptions().schemes),
    "survey": dict.fromkeys(error_analysis.survey.__defaults__[0]),
    "pictures": pictures.STYLE_OF,
}
with Session.open(sys.argv[1], read_only=True) as session:
    found["export page"] = dict(export.schemes(session))
    first = presenter.provenance(session.result(0, "toy"))
    compared = comparison.compared(session, 0, ("toy", "fit"), presenter.Options()).text
found["other"] = comparison.other_scheme("toy")
found["provenance"], found["compared"] = first, compared
print(json.dumps(found))
"""

Python = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def python(tmp_path: Path) -> Python:
    """Run Python with the toy scheme in the folder of schemes and in `SCHEMES`."""
    site = tmp_path / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(SITE)
    (site / "toy.py").write_text(TOY)
    paths = [str(site), str(SAMPLE.parents[1]), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        "QT_QPA_PLATFORM": "offscreen",
        "COLUMNS": "200",
        "XDG_STATE_HOME": str(tmp_path / "state"),
    }

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *map(str, arguments)],
            env=environment,
            timeout=PATIENCE_S,
            capture_output=True,
            encoding="utf-8",
            check=False,
        )

    return run


@pytest.mark.slow
def test_command_line_offers_and_runs_an_added_scheme(python: Python, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = (SAMPLE / "recording.avi", "--setup", SAMPLE / "setup.toml", "--frames", "0:1")
    process = python("-m", "labapp", "reconstruct", *arguments, "--out", out, "--scheme", "toy")
    assert process.returncode == 0, process.stderr
    with (out / "measures.csv").open(encoding="utf-8", newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["scheme"], row["status"]) == ("toy", "ok")
    for command in ("reconstruct", "session measure", "session export", "analyze errors"):
        help_text = python("-m", "labapp", *command.split(), "--help").stdout
        (line,) = (line for line in help_text.splitlines() if "--scheme" in line)
        assert "toy" in line, command
    rejected = python("-m", "labapp", "reconstruct", *arguments, "--out", out, "--scheme", "toys")
    assert rejected.returncode == 2
    assert "'toy'" in rejected.stderr
    arguments = ("--algorithm", "epa-r", "--scheme", "toy", "--out", out, *arguments)
    assert python("-m", "labapp", "reconstruct", *arguments).returncode == 2


@pytest.mark.slow
def test_sessions_and_pages_offer_an_added_scheme(python: Python, tmp_path: Path) -> None:
    file = Path(shutil.copytree(SAMPLE, tmp_path / "gtaw")) / "gtaw.labsession"
    process = python(
        "-m", "labapp", "session", "measure", file, "--frames", "0:1", "--scheme", "toy"
    )
    assert process.returncode == 0, process.stderr
    window = python("-c", IN_THE_WINDOW, file)
    assert window.returncode == 0, window.stderr
    texts = json.loads(window.stdout)
    assert texts.pop("compared").startswith("Toy minus Fit, from the same dots: the heights")
    assert texts.pop("other") == "fit"
    assert texts.pop("provenance").startswith("Frame 0 · Toy · dots found automatically")
    assert texts.pop("export page")[""] == "the toy (as in the settings)"
    for where, offered in texts.items():
        assert "toy" in offered, where
    assert texts["surface page"]["toy"] == "Toy: a quadric by least squares"
    out = tmp_path / "out"
    options = ("--scheme", "toy", "--frames", "0:1", "--out", out)
    process = python("-m", "labapp", "session", "export", file, *options)
    assert process.returncode == 0, process.stderr
    assert ",ok,toy," in (out / "measures.csv").read_text("utf-8").splitlines()[1]


@dataclass(frozen=True)
class TwoSettings:
    """Settings of a scheme of two algorithms."""

    algorithm: str = "one"


@dataclass(frozen=True)
class SettingsOfTwo(Settings):
    """Settings with those of the scheme."""

    two: TwoSettings = TwoSettings()


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add a scheme of two algorithms, whose result is its settings."""
    words = {name: schemes.Words(name, f"Two: {name}") for name in ("one", "other")}
    scheme = schemes.Scheme("two", "a toy (of two)", words, "TwoSettings")
    monkeypatch.setitem(schemes.SCHEMES, "two", scheme)
    module: Any = ModuleType("labapp.core.schemes.two")
    module.reconstruct = lambda match, rig, settings: settings
    monkeypatch.setitem(sys.modules, module.__name__, module)


@pytest.mark.usefixtures("two")
@pytest.mark.parametrize(
    ("chosen", "used"), [("opa", "one"), ("epa-r", "one"), ("one", "one"), ("other", "other")]
)
def test_scheme_of_two_algorithms_uses_its_own(chosen: str, used: str) -> None:
    settings = SettingsOfTwo(scheme="two", algorithm=chosen)
    nothing: Any = SimpleNamespace()
    assert reconstruct(nothing, nothing, settings) == TwoSettings(used)  # type: ignore[comparison-overlap]
    assert scheme_name(settings) == f"two-{used}"
    check_settings(settings, "measure")
    if chosen != "epa-r":
        check_algorithm(settings, "measure")
    plain = Settings(scheme="two", algorithm=chosen)
    assert unpack(pack(plain), Settings) == plain


@pytest.mark.usefixtures("two")
@pytest.mark.parametrize(
    ("scheme", "algorithm", "expected"),
    [
        ("two", "epa-r", "one of one, other"),
        ("irs", "other", "one of opa, epa-r, epa-c, epa-rc"),
        ("fit", "other", "scheme two, which alone has it, instead of fit"),
        ("fit", "epa-r", "scheme irs, which alone has it, instead of fit"),
    ],
)
def test_algorithm_of_another_scheme_is_refused(scheme: str, algorithm: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        check_algorithm(Settings(scheme=scheme, algorithm=algorithm), "measure")
    assert (caught.value.field, caught.value.expected) == ("algorithm", expected)


@pytest.mark.parametrize("field", ["scheme", "settings"])
def test_settings_of_a_missing_scheme_are_named(
    field: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as changed:
        if field == "scheme":
            name = "two"
            blob = pack(Settings(scheme=name))
        else:
            name = TwoSettings.__name__
            changed.setitem(STORED, name, Stored(TwoSettings))
            changed.setitem(NAMES, TwoSettings, name)
            blob = pack(TwoSettings())
    with pytest.raises(Damaged) as caught:
        unpack(blob)
    assert "written by a labapp with other" in str(caught.value)
    assert repr(name) in str(caught.value)


@pytest.mark.parametrize("scheme", schemes.SCHEMES)
def test_algorithm_that_no_scheme_has_is_refused(scheme: str) -> None:
    settings = Settings(scheme=scheme, algorithm="other")
    with pytest.raises(InputError) as caught:
        check_settings(settings, "measure")
    assert caught.value.field == "settings.algorithm"
    assert caught.value.expected.endswith("one of opa, epa-r, epa-c, epa-rc")
    with pytest.raises(Damaged):
        unpack(pack(settings), Settings)
    assert scheme_name(replace(settings, algorithm="opa")) == (
        "irs-opa" if scheme == "irs" else scheme
    )
