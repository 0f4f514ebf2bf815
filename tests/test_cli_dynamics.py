"""`labapp dynamics` and `Results.dynamics`: tables, pictures, signals."""

from __future__ import annotations

import csv
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import labapp as package
from labapp.core.surface.measures import SHAPES, SIZES
from labapp.errors import InputError
from labapp.export.folder import ExportChoice
from labapp.export.result_folder import measured_in
from labapp.session.session import Session
from tests.conftest import Run

SAMPLE = Path(package.__file__).parents[1] / "sample_sessions" / "gtaw"


@pytest.fixture
def gtaw(tmp_path: Path) -> Path:
    shutil.copytree(SAMPLE, tmp_path / "gtaw")
    return tmp_path / "gtaw" / "gtaw.labsession"


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def current_step(folder: Path) -> Path:
    """Write the table of a data logger with a step of the current at 0.25 s."""
    table = folder / "log.csv"
    times = np.arange(-0.2, 0.9, 0.001)
    lines = [f"{t:.3f},{70 + 20 * (t >= 0.25):g}" for t in times]
    table.write_text("\n".join(["time_s,current_a", *lines]))
    return table


def test_tables_and_pictures_of_a_session(labapp: Run, gtaw: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    code, stdout, _ = labapp("dynamics", gtaw, "--out", out, "--signals", current_step(tmp_path))
    assert code == 0
    assert "current changes at 0.2" in stdout
    series = rows(out / "series.csv")
    assert len(series) == 30
    with Session.open(gtaw, read_only=True) as session:
        heights = session.overview().measures["height_mm"]
    assert [float(row["height_mm"]) for row in series] == pytest.approx(heights, abs=1e-6)
    assert {"convexity_mm", "asymmetry", "wetting_slope_deg", "mode (0, 1) mm"} <= set(series[0])
    assert [row["mode"] for row in rows(out / "modes.csv")][:4] == [
        *("(0, 1)", "(1, 1)", "(2, 1)", "(0, 2)"),
    ]
    (step,) = [row for row in rows(out / "events.csv") if row["series"] == "current"]
    assert float(step["time_s"]) == pytest.approx(0.25, abs=0.001)
    spectrum = rows(out / "spectrum.csv")
    assert all(float(r["low_95_per_hz"]) < float(r["density_per_hz"]) for r in spectrum)
    for name in ("dynamics.png", "modes.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_result_folder_and_session_have_equal_dynamics(gtaw: Path, tmp_path: Path) -> None:
    from labapp.export.dynamics import dynamics_of

    with Session.open(gtaw) as session:
        session.export(tmp_path / "results", ExportChoice(surfaces=frozenset({"csv"})))
        of_session = package.Results.of_session(session).dynamics()
    of_folder = dynamics_of(measured_in(tmp_path / "results"))
    for one, other in zip(of_session.modes, of_folder.modes, strict=True):
        np.testing.assert_allclose(one.coefficient_mm, other.coefficient_mm, atol=5e-4)
    for name, values in of_session.series.items():
        np.testing.assert_allclose(values, of_folder.series[name], rtol=0.05, atol=0.02)
    measures = tmp_path / "results" / "measures.csv"
    head, first, *others = measures.read_text("utf-8").splitlines()
    frame, time_s, rest = first.split(",", 2)
    width = rest.split(",")[head.split(",")[2:].index("width_mm")]

    def with_width(cell: str) -> str:
        return rest.replace(f",{width},", f",{cell},", 1)

    for column, wrong in (
        ("frame", f"nan,{time_s},{rest}"),
        ("time_s", f"{frame},1e300,{rest}"),
        ("time_s", f"{frame},inf,{rest}"),
        ("width_mm", f"{frame},{time_s},{with_width('inf')}"),
        ("width_mm", f"{frame},{time_s},{with_width('nan')}"),
        ("width_mm", f"{frame},{time_s},{with_width('1_0')}"),
    ):
        measures.write_text("\n".join([head, wrong, *others]), "utf-8")
        with pytest.raises(InputError, match=column):
            dynamics_of(measured_in(measures.parent))
    measures.write_text("\n".join([head.replace("width_mm", "w"), first, *others]), "utf-8")
    with pytest.raises(InputError, match="width_mm"):
        dynamics_of(measured_in(measures.parent))
    (measures.parent / "boundary.csv").write_text("frame,theta_deg,x_mm,y_mm,z_mm\n0,0,a,0,0\n")
    measures.write_text("\n".join([head, first, *others]), "utf-8")
    with pytest.raises(InputError, match="boundary"):
        dynamics_of(measured_in(measures.parent))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with one frame: a dome of 6 mm."""
    folder = tmp_path_factory.mktemp("results")
    theta = np.arange(-180.0, 180.0, 10.0)
    x, y = 3 * np.cos(np.radians(theta)), 3 * np.sin(np.radians(theta))
    lines = [f"0,{t},{a:.6f},{b:.6f},0" for t, a, b in zip(theta, x, y, strict=True)]
    _write(folder / "boundary.csv", "frame,theta_deg,x_mm,y_mm,z_mm", lines)
    grid = np.arange(-2.8, 2.9, 0.2)
    nodes = [(a, b) for a in grid for b in grid if np.hypot(a, b) < 3]
    lines = [f"{a:.4f},{b:.4f},{0.3 - (a * a + b * b) / 30:.6f}" for a, b in nodes]
    _write(folder / "surface_000000.csv", "x_mm,y_mm,z_mm", lines)
    sizes = dict.fromkeys((*SIZES, *SHAPES), "1")
    names = ",".join(("frame", "time_s", "status", *sizes))
    _write(folder / "measures.csv", names, [",".join(("0", "0.0", "ok", *sizes.values()))])
    return folder


def _write(path: Path, head: str, lines: list[str]) -> None:
    path.write_text("\n".join([head, *lines, ""]), "utf-8")


def test_results_of_one_frame_are_read(folder: Path) -> None:
    assert len(list(measured_in(folder))) == 1


@pytest.mark.parametrize(
    ("name", "old", "new", "field"),
    [
        ("surface_000000.csv", "\n0.2000,0.0000,", "\n0.2000,0.0000,x", "z_mm"),
        ("surface_000000.csv", "\n0.2000,0.0000,0", "\n0.2000,0.0000,1e300", "z_mm"),
        ("surface_000000.csv", r"\n0.2000(.*\n)*", "\n", "points"),
        ("surface_000000.csv", r"\n-?\d.\d000,", "\n0.0,", "points"),
        ("boundary.csv", "z_mm", "x_mm", "line 1"),
        ("boundary.csv", ",3.000000", ",1e300", "x_mm"),
        ("measures.csv", "time_s", "frame", "line 1"),
    ],
)
def test_damaged_results_are_rejected(
    folder: Path, tmp_path: Path, name: str, old: str, new: str, field: str
) -> None:
    damaged = shutil.copytree(folder, tmp_path / "results")
    text, count = re.subn(old, new, (damaged / name).read_text("utf-8"))
    assert count > 0
    (damaged / name).write_text(text, "utf-8")
    with pytest.raises(InputError) as caught:
        list(measured_in(damaged))
    assert (Path(caught.value.source).name, caught.value.field) == (name, field)


@pytest.mark.parametrize(
    "options",
    [
        ("--of", "shade_mm"),
        ("--band", "9:3"),
        ("--band", "9:inf"),
        ("--band", "30:900"),
        ("--segment", "0.01"),
        ("--start", "1"),
        ("--film", "(9,9)"),
    ],
)
def test_wrong_options_are_named(labapp: Run, gtaw: Path, tmp_path: Path, options) -> None:
    code, _, stderr = labapp("dynamics", gtaw, "--out", tmp_path / "out", *options)
    assert code == 2
    assert options[1].split(":")[0] in stderr or options[0] in stderr or "signals" in stderr


def test_frames_without_times_have_no_dynamics(labapp: Run, tmp_path: Path) -> None:
    sample = SAMPLE.parent / "concave" / "concave.labsession"
    shutil.copy(sample, tmp_path)
    code, _, stderr = labapp("dynamics", tmp_path / sample.name, "--out", tmp_path / "out")
    assert code == 2
    assert "time" in stderr


def test_signals_are_aligned_with_the_brightness_of_frames(tmp_path: Path) -> None:
    from labapp.media import Frame
    from labapp.session.signals import Signals, align_signals

    time_s = np.arange(0, 5, 0.001)
    current = np.where((time_s > 1) & (time_s < 1.7), 120.0, 60.0)
    signals = Signals("a.csv", time_s, current, np.full(len(time_s), np.nan))
    frame_time_s = np.arange(300) / 100
    level = np.interp(frame_time_s + 0.5, time_s, current)
    frames = [
        Frame(k, t, np.full((4, 4), g))
        for k, (t, g) in enumerate(zip(frame_time_s, level, strict=True))
    ]
    aligned, offset = align_signals(signals, frames)
    assert aligned.start_s == pytest.approx(-0.5, abs=0.01)
    assert offset.correlation > 0.9
    with pytest.raises(InputError):
        align_signals(
            signals, [Frame(k, t, np.full((4, 4), k % 2)) for k, t in enumerate(frame_time_s)]
        )
