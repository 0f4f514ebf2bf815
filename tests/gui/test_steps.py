"""The states of the steps, and what they say to do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labapp.config.setup import parse_setup
from labapp.errors import InputError
from labapp.gui.shell.steps import STEPS, Mark, setup_to_do, states
from labapp.session.session import Session
from tests.gui.conftest import SAMPLES, CopySample

LASER = "[laser]\nprojection_angle_deg = 31.14\ndistance_mm = 31.48\n"
PATTERN = "[pattern]\nrows = 19\ncolumns = 19\ninter_beam_angle_deg = 0.77\n"
TYPED = "the electrode, the imaging plane"
CALIBRATE = "calibrate the picture (step 3)"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", f"Enter the laser, the pattern, {TYPED}; {CALIBRATE}"),
        (LASER, f"Enter the pattern, {TYPED}; {CALIBRATE}"),
        (
            LASER.replace("distance_mm = 31.48\n", "") + PATTERN,
            f"Enter distance of the laser, {TYPED}; {CALIBRATE}",
        ),
        (
            LASER + PATTERN + "[electrode]\nheight_mm = 5\n"
            "[imaging_plane]\ndistance_mm = 50\nwidth_mm = 101.6\nheight_mm = 101.6\n",
            f"Enter s and h of the imaging plane; {CALIBRATE}",
        ),
        (
            LASER.replace("31.48", "-3") + PATTERN,
            "Correct distance of the laser: -3 is not a number above 0 and below 10000 (mm); "
            f"enter {TYPED}; {CALIBRATE}",
        ),
        (
            LASER + PATTERN + "rowz = 19\n",
            "Correct rowz of the pattern: unknown key; expected rows, the most similar key; "
            f"enter {TYPED}; {CALIBRATE}",
        ),
    ],
)
def test_missing_setup_values_are_listed_as_instructions(text: str, words: str) -> None:
    with pytest.raises(InputError) as raised:
        parse_setup(text, "setup")
    assert setup_to_do(raised.value.problems) == words


def test_states_of_a_new_session(tmp_path: Path) -> None:
    with Session.create(tmp_path / "new.labsession") as session:
        step_states = states(session)
    assert step_states["setup"].mark is Mark.READY
    assert step_states["setup"].why.startswith("Enter the laser")
    assert (
        step_states["laser"].why
        == step_states["plane"].why
        == ("Not calibrated yet, and no values were entered")
    )
    assert setup_to_do(()) == ""


def test_doubtful_setup_needs_attention(copy_sample: CopySample) -> None:
    with Session.open(copy_sample("gtaw")) as session:
        assert states(session)["setup"].mark is Mark.DONE
        session.update_setup({"laser": {"projection_angle_deg": 89.0}})
        assert states(session)["setup"].mark is Mark.ATTENTION


def test_line_pattern_renames_the_dots_step(tmp_path: Path) -> None:
    (dots,) = (step for step in STEPS if step.key == "dots")
    assert dots.of(None).title == "Dots"
    with Session.create(tmp_path / "new.labsession") as session:
        assert dots.of(session) == dots
        session.update_setup({"pattern": {"kind": "lines"}})
        renamed = dots.of(session)
        assert renamed.title == "Pattern"
        assert "lines" in renamed.hint
        assert all(step.of(session) == step for step in STEPS if step is not dots)


def test_results_that_are_out_of_date_need_attention_in_every_step_that_shows_them(
    copy_sample: CopySample,
) -> None:
    shown = ("surface", "trends", "export")
    with Session.open(copy_sample("blocked_rows")) as session:
        assert states(session)["trends"].mark is Mark.READY
        session.set_settings(replace(session.settings, correspondence="S/S"))
        found = states(session)
    assert {found[key].mark for key in shown} == {Mark.ATTENTION}
    assert len({found[key].why for key in shown}) == 1


def test_recording_without_any_surface_needs_attention(tmp_path: Path) -> None:
    dark, setup = tmp_path / "dark.npy", SAMPLES / "gtaw" / "setup.toml"
    np.save(dark, np.zeros((2, 640, 480), np.uint8))
    with Session.create(tmp_path / "new.labsession") as session:
        session.import_recording(dark)
        session.set_setup(setup.read_text())
        assert states(session)["surface"].mark is Mark.READY
        session.measure([0])
        assert states(session)["surface"].mark is Mark.READY
        session.measure([1])
        step_states = states(session)
    assert {step_states[key].mark for key in ("dots", "surface", "trends", "export")} == {
        Mark.ATTENTION
    }


def test_damaged_calibration_needs_attention_and_leaves_the_other_steps(
    copy_sample: CopySample,
) -> None:
    with Session.open(copy_sample("gtaw")) as session:
        before = states(session)
        with session._database.transaction() as connection:
            connection.execute(
                "UPDATE document SET content = x'4c414231' WHERE kind = 'plane-calibration'"
            )
    with Session.open(session.path) as session:
        after = states(session)
    assert after["plane"].mark is Mark.ATTENTION
    assert "plane-calibration" in after["plane"].why
    untouched = set(before) - {"laser", "plane"}  # both compare the calibrations with the set-up
    assert {key: after[key] for key in untouched} == {key: before[key] for key in untouched}
