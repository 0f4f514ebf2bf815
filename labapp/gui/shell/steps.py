"""The steps of the guided way and how far each is: computed from the session, never stored."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np

from labapp.errors import InputError
from labapp.words import several

if TYPE_CHECKING:
    from labapp.session.measured import Overview
    from labapp.session.session import Session


class Mark(Enum):
    """How far a step is."""

    TODO = "to do"
    READY = "ready"
    DONE = "done"
    ATTENTION = "needs attention"


@dataclass(frozen=True)
class Step:
    """One step of the guided way.

    Parameters
    ----------
    key
        Its name in code.
    title
        Its name for the operator.
    hint
        What to do there, in two or three sentences.
    """

    key: str
    title: str
    hint: str


STEPS = (
    Step(
        "setup",
        "Set-up",
        "Note the experiment, go through the safety list, and enter what is bolted to the bench. "
        "The drawing shows which rays come back.",
    ),
    Step(
        "laser",
        "Laser",
        "Put the cross-hair lens on the laser and measure the three lengths of the cross, more "
        "than once. The laser's angle and distance follow.",
    ),
    Step(
        "plane",
        "Imaging plane",
        "Take a picture of the target on the imaging plane. O′ and the axes are found in it; drag "
        "any of them that is not where it should be.",
    ),
    Step(
        "capture",
        "Recording",
        "Import a video, images or a stack, or capture one with a camera. What is imported is read "
        "through once, and stays where it is.",
    ),
    Step(
        "dots",
        "Dots",
        "Check the dots and their rows. Where the program is in doubt it says so: put right what "
        "is wrong, and go on to the next frame.",
    ),
    Step(
        "surface",
        "Surface",
        "Measure the frames and look at the surface. The residuals tell whether to trust it.",
    ),
    Step(
        "trends",
        "Trends",
        "See how the pool changes over the recording. Click a point to go to its frame.",
    ),
    Step("export", "Export", "Tick what you want to take along, and choose a folder."),
)


@dataclass(frozen=True)
class State:
    """How far a step is, and why: the words that explain its mark and its disabled buttons."""

    mark: Mark
    why: str


def states(session: Session | None, seen: Overview | None = None) -> dict[str, State]:
    """State of every step, by its key; ``seen`` is the session's overview, if it is at hand."""
    if session is None:
        return {step.key: State(Mark.TODO, "Open or make a session first") for step in STEPS}
    problems: tuple[InputError, ...] = ()
    try:
        _ = session.setup
    except InputError as error:
        problems = error.problems
    missing = setup_to_do(problems)
    parts = {problem.field.partition(".")[0] for problem in problems}
    laser_used, plane_used = calibrations_in_use(session)
    return {
        "setup": State(Mark.READY, missing) if missing else State(Mark.DONE, "Complete"),
        "laser": _calibrated(session.laser_calibration, laser_used, "laser" in parts),
        "plane": _calibrated(session.plane_calibration, plane_used, "image_calibration" in parts),
        **_frame_states(session, missing, seen),
    }


PARTS = {
    "laser": "the laser",
    "pattern": "the dot pattern",
    "electrode": "the electrode",
    "imaging_plane": "the imaging plane",
}
"""Sections of the set-up that are typed in, in words."""


def setup_to_do(problems: Iterable[InputError]) -> str:
    """What to do for the set-up to be complete, in words; empty if nothing."""
    enter, wrong, calibrate = [], [], []
    for problem in problems:
        part, _, key = problem.field.partition(".")
        if part == "image_calibration":
            calibrate = ["calibrate the picture (step Imaging plane)"]
        elif part not in PARTS:
            wrong.append(f"take out {problem.field}: {problem.expected}")
        elif problem.value == "missing":
            enter.append(PARTS[part])
        else:
            told = f"{PARTS[part]}, {key.replace('_', ' ')}"
            wrong.append(f"put right {told}: {problem.value} is not {problem.expected}")
    typed = [f"enter {', '.join(dict.fromkeys(enter))}"] if enter else []
    words = "; ".join([*wrong, *typed, *calibrate])
    return words[:1].upper() + words[1:]


READ_ONLY = "The session is open read-only: nothing can be changed"


def read_only(session: Session | None) -> str:
    """That a session is open read-only, and what that means; empty if it can be changed."""
    return READ_ONLY if session is not None and session.read_only else ""


def recording_gone(session: Session) -> str:
    """That the recording is not where it was, and what to do; empty if it is."""
    missing = session.missing_recording
    return "" if missing is None else f"{missing.name} is not where it was: say where it is now"


def calibrations_in_use(session: Session) -> tuple[bool, bool]:
    """Whether the set-up has the laser, and the imaging plane, that the calibrations found.

    False without a calibration, and where other values were entered after it.
    """
    keys = tomllib.loads(session.setup_text)
    laser, plane = session.laser_calibration, session.plane_calibration
    found = (
        {}
        if laser is None
        else {
            "projection_angle_deg": laser.found.angle_deg,
            "distance_mm": laser.found.distance_mm,
        }
    )
    return (
        laser is not None and _entered(keys.get("laser"), found),
        plane is not None and _entered(keys.get("image_calibration"), plane.found.setup_keys),
    )


def _entered(keys: Any, found: Mapping[str, Any]) -> bool:
    """Whether a section of the set-up holds what was found, but for rounding."""
    try:
        pairs = [(keys[name], value) for name, value in found.items() if value is not None]
        return all(np.allclose(one, other, rtol=1e-6) for one, other in pairs)
    except (KeyError, TypeError, ValueError):
        return False


def _calibrated(kept: object, used: bool, needed: bool) -> State:
    if used:
        return State(Mark.DONE, "Calibrated")
    if kept is not None:
        return State(Mark.READY, "Other values were entered after the calibration")
    if needed:
        return State(Mark.READY, "Not calibrated yet, and no values were entered")
    return State(Mark.READY, "Not calibrated here: the values were entered")


def _frame_states(session: Session, missing: str, seen: Overview | None) -> dict[str, State]:
    recording, gone = session.recording, recording_gone(session)
    if recording is None:
        first = State(Mark.TODO, "Import a recording first")
        return {
            "capture": State(Mark.READY, "No recording yet"),
            **dict.fromkeys(("dots", "surface", "trends", "export"), first),
        }
    seen = seen or session.overview()
    status = np.array(seen.status, dtype=object)
    measured = int((status != "").sum())
    without = int(((status != "") & (status != "ok")).sum())
    stale = int(seen.stale.sum())
    count = len(seen.frame)
    capture = State(Mark.DONE, several(count, "frame"))
    if gone:
        capture = State(Mark.ATTENTION, gone)
    blocked = f"Set-up: {missing}" if missing else ""
    if blocked and not measured:
        surface = State(Mark.TODO, blocked)
    elif stale:
        surface = State(
            Mark.ATTENTION, f"{stale} of {several(count, 'frame')} no longer stand: measure again"
        )
    elif measured < count:
        surface = State(
            Mark.READY, f"{count - measured} of {several(count, 'frame')} not measured yet"
        )
    else:
        told = f"All {count} frames are" if count > 1 else "The frame is"
        if without:
            told = f"{count - without} of {several(count, 'frame')} are"
        missing = f", {without} could not be" if without else ""
        surface = State(Mark.DONE, f"{told} measured{missing}")
    dots = State(Mark.READY, f"{several(count - measured, 'frame')} to be measured")
    if measured == count:
        dots = State(Mark.DONE, "The dots of all frames make a surface")
    if stale:
        dots = State(Mark.READY, f"{several(stale, 'frame')} to be measured again")
    if without:
        missing = several(without, "frame")
        dots = State(Mark.ATTENTION, f"{missing} could not be measured: look at their dots")
    results = (
        State(Mark.READY, several(measured, "frame"))
        if measured
        else State(Mark.TODO, "Measure some frames first")
    )
    export = State(Mark.ATTENTION, surface.why) if stale else results
    return {
        "capture": capture,
        "dots": dots,
        "surface": surface,
        "trends": results,
        "export": export,
    }


def first_step(session: Session) -> str:
    """Key of the step to begin with: results if there are some, else what is to be done next."""
    if session.recording is not None:
        measured = any(status != "" for status in session.overview().status)
        return "surface" if measured else "dots"
    return "capture" if states(session)["setup"].why == "Complete" else "setup"
