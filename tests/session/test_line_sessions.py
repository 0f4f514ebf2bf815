"""A session of a line pattern: measured, stored, exported; shown by the pages without Qt."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from labapp.config.setup import parse_setup
from labapp.core.geometry.line_pattern import LineRays
from labapp.core.lines.states import State
from labapp.core.rows.correction import Correction
from labapp.errors import InputError
from labapp.export.folder import ExportChoice
from labapp.gui.pages.dots.line_presenter import show_lines
from labapp.gui.pages.setup import presenter as setup_page
from labapp.gui.pages.surface import presenter as surface_page
from labapp.gui.pages.trends import presenter as trends_page
from labapp.session.results.line_trends import LineTrend, line_trend
from labapp.session.session import Session
from labapp.simulation.pools import Pool, egg
from tests.line_truth.frames import LineLook, render_lines
from tests.test_cli_lines import SETUP, VIEW

FIVE_LINES = Path(__file__).parents[2] / "sample_sessions" / "five_lines" / "five_lines.labsession"

POOL = egg(6.0, 2.8, 3.2, 0.3)


def measured_session(folder: Path, pools: list[Pool | None]) -> Session:
    rig = parse_setup(SETUP, "setup", lines=True).line_rig
    assert rig is not None
    frames = folder / "frames"
    frames.mkdir()
    for k, pool in enumerate(pools):
        image = render_lines(pool, rig, VIEW, LineLook(), np.random.default_rng(k)).image
        cv2.imwrite(str(frames / f"{k}.png"), image)
    session = Session.create(folder / "lines.labsession")
    session.set_setup(SETUP)
    session.import_recording(frames, frame_rate_hz=10.0)
    for _ in session.measure(warm=True):
        pass
    return session


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with measured_session(tmp_path_factory.mktemp("lines"), [None, POOL]) as session:
        yield session


@pytest.mark.slow
def test_lines_are_measured_and_stored(session: Session):
    stored = session.result(1)
    assert stored is not None
    lines = stored.measurement.lines
    assert lines is not None
    assert stored.stale == ()
    assert (stored.measurement.status, lines.features.count) == ("ok", 5)
    assert lines.surface is not None
    assert lines.surface.height_mm == pytest.approx(0.3, rel=0.08)
    assert session.overview().status == ("no-lines", "ok")
    assert session.problems() == []
    assert not len(session.stale_frames())


@pytest.mark.slow
def test_export_of_lines_equals_the_output_of_the_command(session: Session, tmp_path: Path):
    written = {file_written.name for file_written in session.export(tmp_path / "out")}
    assert written == {"features.csv", "lines.csv", "line_points.csv", "surface_000001.csv"}
    with (tmp_path / "out" / "features.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["lines"] for row in rows] == ["0", "5"]
    assert rows[0]["state"] == "no-pool"


@pytest.mark.parametrize(
    ("choice", "report", "named"),
    [
        (ExportChoice(hdf5=True, pictures=frozenset({"trends"})), True, "hdf5, pictures, report"),
        (ExportChoice(tables=frozenset({"dots"})), False, "tables"),
        (ExportChoice(together=frozenset({"hdf5"})), False, "together"),
        (ExportChoice(surfaces=frozenset(), sigma_parts=True), False, "surfaces, sigma_parts"),
        (ExportChoice(solid=True, spacing_mm=0.2), False, "solid, spacing_mm"),
    ],
)
def test_export_of_lines_refuses_what_only_dots_have(
    tmp_path: Path, choice: ExportChoice, report: bool, named: str
):
    with (
        Session.open(FIVE_LINES, read_only=True) as session,
        pytest.raises(InputError) as refused,
    ):
        session.export(tmp_path / "out", choice, report=report)
    assert refused.value.value == named
    assert not (tmp_path / "out").exists()


def test_export_of_lines_reports_progress(tmp_path: Path):
    done = list[tuple[int, int]]()
    with Session.open(FIVE_LINES, read_only=True) as session:
        count = len(session.frames)
        session.export(tmp_path / "out", progress=lambda *steps: done.append(steps))
    assert done == [(k, count) for k in range(1, count + 1)]


@pytest.mark.slow
def test_dots_are_rejected_as_a_correction_of_lines(session: Session):
    with pytest.raises(InputError):
        session.correct({1: Correction.of(None, None)})


@pytest.mark.slow
def test_changed_pattern_makes_lines_stale(session: Session):
    session.update_setup({"pattern": {"interline_angle_deg": 0.25}})
    assert session.stale_frames().tolist() == [0, 1]
    session.undo()
    assert session.stale_frames().tolist() == []


@pytest.mark.slow
def test_page_shows_lines_by_their_numbers(session: Session):
    shown = show_lines(session, 1)
    assert [line.name for line in shown.lines] == ["1", "2", "3", "4", "5"]
    assert len(shown.listed) == 5
    assert show_lines(session, 0).lines == ()


@pytest.mark.slow
def test_surface_ends_at_the_outer_lines(session: Session):
    shown = surface_page.shown(session, 1)
    pool = shown.reconstruction
    assert pool is not None
    assert surface_page.shown(session, 0).reconstruction is None
    x, y = pool.points_mm[:, :2].T
    assert np.isfinite(pool.surface.height(0.99 * x, 0.99 * y + 0.01 * y.mean())).mean() > 0.95
    # The head beyond the uppermost line belongs to the pool, but is not shown.
    assert np.isfinite(POOL.height(np.zeros(1), np.array([2.5]))).all()
    assert np.isnan(pool.surface.height(np.zeros(1), np.array([2.5]))).all()
    assert [row.name for row in shown.sizes] == ["Height", "Width"]


def test_change_of_the_pattern_kind_removes_former_keys(tmp_path: Path):
    with Session.create(tmp_path / "kind.labsession") as session:
        session.set_setup(SETUP)
        assert session.has_lines
        setup_page.put_kind(session, "square")
        state = setup_page.shown(session)
        assert state.kind == "square"
        assert state.values["pattern.count"] is None
        assert "pattern.rows" in state.missing
        setup_page.put_kind(session, "lines")
        setup_page.put_usual(session)
        assert session.setup_problems == ()
        pattern = session.setup.rig.pattern
        assert isinstance(pattern, LineRays)
        assert (pattern.lines.count, pattern.lines.interline_angle_deg) == (5, 0.23)


def test_drawing_shows_a_light_plane_for_each_line(tmp_path: Path):
    with Session.create(tmp_path / "bench.labsession") as session:
        session.set_setup(SETUP)
        view = setup_page.bench(session).view
    assert view is not None
    assert [ray.row for ray in view.rays] == [1, 2, 3, 4, 5]


@pytest.mark.slow
def test_trends_of_few_frames_show_lines_without_states(session: Session):
    shown = trends_page.show(session, trends_page.TrendOptions())
    curves = {curve.name: curve for curve in shown.curves}
    assert curves["Lines"].y.tolist() == [0.0, 5.0]
    assert curves["Pool height"].key is not None
    assert curves["Pool height"].key.tolist() == [1]
    assert line_trend(session).states == ()


def test_consecutive_equal_states_are_grouped():
    frame, none = np.arange(5), np.zeros(5)
    states: tuple[State, ...] = ("no-pool", "no-pool", "growing", "convex", "convex")
    trend = LineTrend(frame, none > 0, {}, none, states)
    assert trend.stretches() == [("no-pool", 0, 1), ("growing", 2, 2), ("convex", 3, 4)]
