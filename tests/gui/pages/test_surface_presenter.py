from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from labapp.core.values import CannotMeasure
from labapp.export.rendering.heights import profile
from labapp.export.rendering.scene import DIFFERENCE_MAP
from labapp.gui.pages.surface import comparison, presenter
from labapp.gui.pages.surface.presenter import Options
from labapp.gui.shell.steps import why_not_measurable
from labapp.session.results.measured import scheme_name
from labapp.session.session import Session
from labapp.text import SETUP_MARKS, local_time
from tests.gui.conftest import CopySample


@pytest.fixture
def session(copy_sample: CopySample) -> Iterator[Session]:
    with Session.open(copy_sample("gtaw")) as opened:
        yield opened


def test_measured_frame_is_shown_with_its_figures(session: Session) -> None:
    frame_view = presenter.shown(session, 3)
    assert frame_view.state == "measured"
    measures = frame_view.result.measurement.measures
    assert [row.name for row in frame_view.sizes] == [name for name, *_ in presenter.SIZES]
    width = frame_view.sizes[0]
    assert (width.value, width.sigma) == (measures.width_mm, measures.width_sigma_mm)
    name, value, sigma, unit = width.texts
    assert (name, unit) == ("Width", "mm")
    # As many decimals as σ with two significant digits.
    assert len(value.split(".")[1]) == len(sigma.split(".")[1])
    assert float(value) == pytest.approx(measures.width_mm, abs=measures.width_sigma_mm / 10)
    assert [row.value for row in frame_view.errors] == [
        *(measures.are_mm, measures.mre_mm, measures.are_inner_mm, measures.mre_inner_mm)
    ]


@pytest.mark.parametrize(("sample", "level"), [("gtaw", "Depth"), ("concave", "Height")])
def test_level_of_the_work_piece_has_no_sigma(
    copy_sample: CopySample, sample: str, level: str
) -> None:
    """A convex pool has no depth, and a concave one no height; that is not a lack of the scheme."""
    with Session.open(copy_sample(sample)) as session:
        rows = presenter.shown(session, int(session.frames[0])).sizes
    row = next(each for each in rows if each.name == level)
    assert row.texts[1:3] == ("0.000", "")
    assert presenter.NO_SIGMA_OF_LEVEL in row.note
    assert all(presenter.NO_SIGMA not in each.note for each in rows)


def test_measured_frame_of_a_scheme_without_sigma_says_so(session: Session) -> None:
    assert presenter.NO_SIGMA not in presenter.shown(session, 0).words
    session.set_settings(presenter.with_scheme(session.settings, "ers"))
    assert list(session.measure([0]))
    assert presenter.NO_SIGMA in presenter.shown(session, 0).words


def test_surface_is_marked_with_the_status_of_its_setup(session: Session) -> None:
    assert list(session.measure([4]))
    assert presenter.shown(session, 4).setup_words.startswith(SETUP_MARKS["entered"])
    session.update_setup({"laser": {"distance_mm": 31.0}})
    assert presenter.shown(session, 4).setup_words == ""


def test_provenance_text(session: Session) -> None:
    result = session.result(3)
    words = presenter.provenance(result)
    assert words.startswith("Frame 3 · Fit · dots found automatically · labapp ")
    assert result.version in words
    assert local_time(result.measured) in words
    by_hand = replace(
        result, measurement=replace(result.measurement, correction=object()), scheme="irs-opa"
    )
    assert "IRS, one point (OPA) · dots corrected by hand" in presenter.provenance(by_hand)
    lines = replace(result, measurement=replace(result.measurement, lines=object()))
    assert "lines found automatically" in presenter.provenance(lines)
    lines = replace(lines, measurement=replace(lines.measurement, correction=object()))
    assert "lines corrected by hand" in presenter.provenance(lines)


def test_tried_correspondences_are_listed(session: Session) -> None:
    frame_view = presenter.shown(session, 3)
    match = frame_view.result.measurement.match
    assert [row.name for row in frame_view.trials] == ["S/S ✓", "S/I", "I/I"]
    assert [row.value for row in frame_view.trials] == [trial.residual_mm for trial in match.trials]
    assert (
        frame_view.verdict == f"S/S: the next best is {match.residual_ratio:.0f} times as far off."
    )
    one = replace(match, trials=match.trials[:1])
    assert presenter.verdict(one) == "S/S: no other correspondence gives a surface."
    none = replace(match.trials[1], residual_mm=np.inf)
    rows = presenter.trial_rows(replace(match, trials=(match.trials[0], none)))
    assert rows[1].texts == ("S/I", "no surface", "", "")


def test_frame_without_a_surface_shows_the_reason(copy_sample: CopySample) -> None:
    with Session.open(copy_sample("blocked_rows")) as session:
        overview = session.overview()
        frame = int(overview.frame[[status == "no-match" for status in overview.status]][0])
        frame_view = presenter.shown(session, frame)
        assert frame_view.state == "failed"
        assert frame_view.words.startswith("No surface (no-match): ")
        assert session.result(frame).measurement.reason in frame_view.words
        assert frame_view.sizes == frame_view.errors == ()
        with pytest.raises(CannotMeasure, match="no matched dots"):
            comparison.by_scheme(session, frame, "ers")
        compared = comparison.compared(session, frame, ("fit", "ers"), Options())
        assert compared.scenes == (None, None)
        assert compared.difference is None
        assert "measure it first" in compared.words[0]


def test_changed_settings_make_figures_outdated(session: Session) -> None:
    session.set_settings(replace(session.settings, correspondence="S/S"))
    frame_view = presenter.shown(session, 3)
    assert frame_view.state == "stale"
    assert (
        frame_view.words == "These figures are out of date. Since then the settings were changed."
    )
    assert frame_view.sizes  # still shown
    session.undo()
    assert presenter.shown(session, 3).state == "measured"


def test_other_scheme_is_not_measured_yet(session: Session) -> None:
    session.set_settings(presenter.with_scheme(session.settings, "irs-epa-rc"))
    frame_view = presenter.shown(session, 3)
    assert frame_view.state == "unmeasured"
    assert frame_view.words == "Frame 3 is not measured by IRS, edge points, both (EPA-RC) yet."
    assert frame_view.reconstruction is None


@pytest.mark.parametrize("name", presenter.SCHEMES)
def test_scheme_names_round_trip(session: Session, name: str) -> None:
    assert scheme_name(presenter.with_scheme(session.settings, name)) == name


def test_scene_follows_its_options(session: Session) -> None:
    result = session.result(3)
    rig = result.parsed_setup.rig
    reconstruction = result.measurement.reconstruction
    cut = profile(reconstruction)

    def make_scene(options: Options, limits: tuple[float, float] | None = None) -> object:
        return presenter.scene(result.measurement, rig, options, limits, cut)

    full = make_scene(Options(rays=True), (0.0, 1.0))
    assert full.limits == (0.0, 1.0)
    assert len(full.points_mm) == len(full.rays_mm["incident"]) == len(reconstruction.points_mm)
    assert set(full.lines_mm) == {"boundary", "section"}
    # The section line lies on the surface.
    x, y, z = full.lines_mm["section"].T
    np.testing.assert_allclose(reconstruction.surface.height(x, y), z)
    bare = make_scene(Options(points=False, boundary=False, electrode=False, exaggeration=1.0))
    assert len(bare.points_mm) == 0
    assert set(bare.lines_mm) == {"section"}
    assert bare.rays_mm == {}
    assert (bare.electrode, bare.exaggeration) == (False, 1.0)
    by_sigma = make_scene(Options(colour="sigma"), (0.0, 1.0))
    assert by_sigma.label == "± height (mm)"
    assert by_sigma.limits[1] == pytest.approx(reconstruction.sigma_mm.max(), rel=0.01)


def test_height_limits_cover_all_frames(session: Session) -> None:
    low, high = presenter.height_limits(session.overview())
    measures = [session.result(int(k)).measurement.measures for k in session.frames]
    assert low == min(each.depth_mm for each in measures)
    assert high == max(each.height_mm for each in measures)


def test_computed_dots_differ_by_the_residuals(session: Session) -> None:
    measurement = session.result(3).measurement
    captured, computed = presenter.reflected_dots(measurement)
    np.testing.assert_allclose(computed - captured, measurement.reconstruction.residual_mm)
    scale = presenter.error_scale(captured, computed)
    longest = np.linalg.norm(computed - captured, axis=1).max() * scale
    assert 0.02 < longest / np.ptp(captured, axis=0).max() <= 0.1
    assert presenter.error_scale(captured, captured) == 1000
    assert presenter.error_scale(captured[:0], captured[:0]) == 1


def test_schemes_are_compared_on_the_same_dots(session: Session) -> None:
    before = session.measured_by
    compared = comparison.compared(session, 3, ("fit", "ers"), Options())
    assert session.measured_by == before  # the comparison is not stored
    assert compared.words == ("", "")
    ers = comparison.by_scheme(session, 3, "ers")
    fit = session.result(3).measurement
    assert compared.scenes[0].limits == compared.scenes[1].limits
    assert compared.difference.colour_map == DIFFERENCE_MAP
    name, one, other, difference, unit = compared.rows[0]
    assert (name, unit) == ("Width", "mm")
    assert one.split(" ± ")[1]
    assert "±" not in other  # ERS gives none
    expected = fit.measures.width_mm - ers.measures.width_mm
    assert float(difference.replace("−", "-")) == pytest.approx(expected, abs=0.001)
    assert [row[0] for row in compared.rows[-5:]] == ["ARE", "MRE", "ARE-I", "MRE-I", "Own ARE"]
    assert compared.text.startswith("Fit minus ERS, from the same dots")


def test_scheme_equals_itself_in_a_comparison(session: Session) -> None:
    compared = comparison.compared(session, 3, ("ers", "ers"), Options())
    np.testing.assert_array_equal(compared.difference.values, 0.0)
    assert {row[3] for row in compared.rows} == {"0.000", "0.0000"}
    assert comparison.other_scheme("fit") != "fit"
    assert comparison.other_scheme("ers") != "ers"


def test_reasons_why_nothing_can_be_measured(session: Session, copy_sample: CopySample) -> None:
    assert why_not_measurable(session) == ""
    session.update_setup({"laser": {"distance_mm": None}})
    assert "Enter distance of the laser" in why_not_measurable(session)
    session.undo()
    with Session.create(session.path.with_name("empty.labsession")) as empty:
        assert why_not_measurable(empty) == "Import a recording first"
        assert presenter.shown(empty, 0).state == "unmeasured"
    path = copy_sample("concave")
    (path.parent / "recording").rename(path.parent / "elsewhere")
    with Session.open(path) as lost:
        assert "is missing" in why_not_measurable(lost)


def test_surfaces_without_overlap_are_reported(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    measurement = session.result(3).measurement
    boundary, shift = measurement.reconstruction.boundary, np.array([100.0, 0.0, 0.0])
    moved = replace(
        boundary, center_mm=boundary.center_mm + shift[:2], points_mm=boundary.points_mm + shift
    )
    aside = replace(measurement, reconstruction=replace(measurement.reconstruction, boundary=moved))
    by_scheme = {"fit": measurement, "ers": aside}
    monkeypatch.setattr(comparison, "by_scheme", lambda _session, _frame, scheme: by_scheme[scheme])
    compared = comparison.compared(session, 3, ("fit", "ers"), Options())
    assert compared.difference is None
    assert compared.text == "Fit minus ERS, from the same dots: the two surfaces do not overlap."
    assert compared.rows
