from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from labapp.core.values import CannotMeasure
from labapp.export.heights import profile
from labapp.export.rendering.scene import DIFFERENCE_MAP
from labapp.gui.pages.surface import comparison, presenter
from labapp.gui.pages.surface.presenter import Options
from labapp.gui.shell.steps import why_not_measurable
from labapp.session.results.measured import scheme_name
from labapp.session.session import Session
from labapp.text import SETUP_MARKS
from tests.gui.conftest import CopySample


@pytest.fixture
def session(copy_sample: CopySample) -> Iterator[Session]:
    with Session.open(copy_sample("gtaw")) as opened:
        yield opened


def test_a_measured_frame_is_told_with_its_figures(session: Session) -> None:
    told = presenter.shown(session, 3)
    assert told.state == "measured"
    measures = told.result.measurement.measures
    assert [row.name for row in told.sizes] == [name for name, *_ in presenter.SIZES]
    width = told.sizes[0]
    assert (width.value, width.sigma) == (measures.width_mm, measures.width_sigma_mm)
    name, value, sigma, unit = width.texts
    assert (name, unit) == ("Width", "mm")
    # As many decimals as σ with two significant digits has.
    assert len(value.split(".")[1]) == len(sigma.split(".")[1])
    assert float(value) == pytest.approx(measures.width_mm, abs=measures.width_sigma_mm / 10)
    assert [row.value for row in told.errors] == [
        *(measures.are_mm, measures.mre_mm, measures.are_inner_mm, measures.mre_inner_mm)
    ]


def test_it_is_marked_how_far_the_set_up_of_a_surface_can_be_relied_on(session: Session) -> None:
    assert list(session.measure([4]))
    assert presenter.shown(session, 4).setup_words.startswith(SETUP_MARKS["entered"])
    session.update_setup({"laser": {"distance_mm": 31.0}})
    assert presenter.shown(session, 4).setup_words == ""


def test_it_says_where_the_figures_come_from(session: Session) -> None:
    result = session.result(3)
    words = presenter.provenance(result)
    assert words.startswith("Frame 3 · Fit · dots found automatically · labapp ")
    assert result.version in words
    assert result.measured[:10] in words
    by_hand = replace(
        result, measurement=replace(result.measurement, correction=object()), scheme="irs-opa"
    )
    assert "IRS, one point (OPA) · dots corrected by hand" in presenter.provenance(by_hand)


def test_the_correspondences_that_were_tried_are_told(session: Session) -> None:
    told = presenter.shown(session, 3)
    match = told.result.measurement.match
    assert [row.name for row in told.trials] == ["S/S ✓", "S/I", "I/I"]
    assert [row.value for row in told.trials] == [trial.residual_mm for trial in match.trials]
    assert told.verdict == f"S/S: the next best is {match.margin:.0f} times as far off."
    one = replace(match, trials=match.trials[:1])
    assert presenter.verdict(one) == "S/S: no other correspondence gives a surface."
    none = replace(match.trials[1], residual_mm=np.inf)
    rows = presenter.trial_rows(replace(match, trials=(match.trials[0], none)))
    assert rows[1].texts == ("S/I", "no surface", "", "")


def test_a_frame_without_a_surface_says_why(copy_sample: CopySample) -> None:
    with Session.open(copy_sample("blocked_rows")) as session:
        seen = session.overview()
        frame = int(seen.frame[[status == "no-match" for status in seen.status]][0])
        told = presenter.shown(session, frame)
        assert told.state == "failed"
        assert told.words.startswith("No surface (no-match): ")
        assert session.result(frame).measurement.reason in told.words
        assert told.sizes == told.errors == ()
        with pytest.raises(CannotMeasure, match="no matched dots"):
            comparison.by_scheme(session, frame, "ers")
        made = comparison.compared(session, frame, ("fit", "ers"), Options())
        assert made.scenes == (None, None)
        assert made.difference is None
        assert "measure it first" in made.words[0]


def test_what_changed_since_makes_figures_stale(session: Session) -> None:
    session.set_settings(replace(session.settings, correspondence="S/S"))
    told = presenter.shown(session, 3)
    assert told.state == "stale"
    assert told.words == "These figures are out of date. Since then the settings were changed."
    assert told.sizes  # they are still to be seen
    session.undo()
    assert presenter.shown(session, 3).state == "measured"


def test_another_scheme_is_not_measured_yet(session: Session) -> None:
    session.set_settings(presenter.with_scheme(session.settings, "irs-epa-rc"))
    told = presenter.shown(session, 3)
    assert told.state == "unmeasured"
    assert told.words == "Frame 3 is not measured by IRS, edge points, both (EPA-RC) yet."
    assert told.reconstruction is None


@pytest.mark.parametrize("name", presenter.SCHEMES)
def test_a_scheme_chosen_by_name_is_kept_under_it(session: Session, name: str) -> None:
    assert scheme_name(presenter.with_scheme(session.settings, name)) == name


def test_the_scene_shows_what_was_ticked(session: Session) -> None:
    result = session.result(3)
    rig = presenter.rig_of(result)
    reconstruction = result.measurement.reconstruction
    cut = profile(reconstruction)

    def made(options: Options, limits: tuple[float, float] | None = None) -> object:
        return presenter.scene(result.measurement, rig, options, limits, cut)

    full = made(Options(rays=True), (0.0, 1.0))
    assert full.limits == (0.0, 1.0)
    assert len(full.points_mm) == len(full.rays_mm["incident"]) == len(reconstruction.points_mm)
    assert set(full.lines_mm) == {"boundary", "section"}
    # The section line lies on the surface.
    x, y, z = full.lines_mm["section"].T
    np.testing.assert_allclose(reconstruction.surface.height(x, y), z)
    bare = made(Options(points=False, boundary=False, electrode=False, exaggeration=1.0))
    assert len(bare.points_mm) == 0
    assert set(bare.lines_mm) == {"section"}
    assert bare.rays_mm == {}
    assert (bare.electrode, bare.exaggeration) == (False, 1.0)
    by_sigma = made(Options(colour="sigma"), (0.0, 1.0))
    assert by_sigma.label == "± height (mm)"
    assert by_sigma.limits[1] == pytest.approx(reconstruction.sigma_mm.max(), rel=0.01)


def test_all_frames_can_share_one_scale(session: Session) -> None:
    low, high = presenter.height_limits(session.overview())
    measures = [session.result(int(k)).measurement.measures for k in session.frames]
    assert low == min(each.depth_mm for each in measures)
    assert high == max(each.height_mm for each in measures)


def test_computed_dots_are_off_by_the_residuals(session: Session) -> None:
    measurement = session.result(3).measurement
    captured, computed = presenter.reflected_dots(measurement)
    np.testing.assert_allclose(computed - captured, measurement.reconstruction.residual_mm)
    scale = presenter.error_scale(captured, computed)
    longest = np.linalg.norm(computed - captured, axis=1).max() * scale
    assert 0.02 < longest / np.ptp(captured, axis=0).max() <= 0.1
    assert presenter.error_scale(captured, captured) == 1000
    assert presenter.error_scale(captured[:0], captured[:0]) == 1


def test_two_schemes_are_compared_on_the_same_dots(session: Session) -> None:
    before = session.measured_by
    made = comparison.compared(session, 3, ("fit", "ers"), Options())
    assert session.measured_by == before  # nothing is kept of it
    assert made.words == ("", "")
    ers = comparison.by_scheme(session, 3, "ers")
    fit = session.result(3).measurement
    assert made.scenes[0].limits == made.scenes[1].limits
    assert made.difference.colour_map == DIFFERENCE_MAP
    name, one, other, difference, unit = made.rows[0]
    assert (name, unit) == ("Width", "mm")
    assert one.split(" ± ")[1]
    assert "±" not in other  # ERS gives none
    wanted = fit.measures.width_mm - ers.measures.width_mm
    assert float(difference.replace("−", "-")) == pytest.approx(wanted, abs=0.001)
    assert [row[0] for row in made.rows[-5:]] == ["ARE", "MRE", "ARE-I", "MRE-I", "Own ARE"]
    assert made.text.startswith("Fit minus ERS, from the same dots")


def test_a_scheme_compared_with_itself_does_not_differ(session: Session) -> None:
    made = comparison.compared(session, 3, ("ers", "ers"), Options())
    np.testing.assert_array_equal(made.difference.values, 0.0)
    assert {row[3] for row in made.rows} == {"0.000", "0.0000"}
    assert comparison.other_scheme("fit") != "fit"
    assert comparison.other_scheme("ers") != "ers"


def test_why_nothing_can_be_measured(session: Session, copy_sample: CopySample) -> None:
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


def test_surfaces_that_do_not_overlap_are_said_to(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = session.result(3).measurement
    here, way = found.reconstruction.boundary, np.array([100.0, 0.0, 0.0])
    moved = replace(here, center_mm=here.center_mm + way[:2], points_mm=here.points_mm + way)
    aside = replace(found, reconstruction=replace(found.reconstruction, boundary=moved))
    one = {"fit": found, "ers": aside}
    monkeypatch.setattr(comparison, "by_scheme", lambda _session, _frame, scheme: one[scheme])
    made = comparison.compared(session, 3, ("fit", "ers"), Options())
    assert made.difference is None
    assert made.text == "Fit minus ERS, from the same dots: the two surfaces do not overlap."
    assert made.rows
