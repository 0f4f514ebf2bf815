"""The steps of the window and the state of each: computed from the session, never stored."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING

from labapp.errors import InputError
from labapp.session.calibrations import calibrations_in_use
from labapp.session.results.statuses import is_failed
from labapp.text import capitalized, pluralize, split_unit

if TYPE_CHECKING:
    from labapp.session.results.measured import Overview
    from labapp.session.session import Session


class Mark(Enum):
    """State of a step."""

    TODO = "to do"
    READY = "ready"
    DONE = "done"
    ATTENTION = "needs attention"


@dataclass(frozen=True)
class State:
    """State of a step, and its reason: the text that explains its mark and disabled buttons."""

    mark: Mark
    why: str


@dataclass(frozen=True)
class Offer:
    """A button of a page that is not an action of the window."""

    text: str
    tip: str
    do: Callable[[], object]


@dataclass(frozen=True)
class Lead:
    """Text of a page without content: what it will show, and the actions to get there."""

    words: str
    actions: tuple[str | Offer, ...]
    """Names of the window's actions, or the page's own buttons; the first is recommended."""


SETUP_ACTIONS = ("load_setup", "last_setup", "other_setup", "enter_setup")
MEASURE_ACTIONS = ("measure", "measure_frame")

PARTS = {
    "laser": "the laser",
    "pattern": "the pattern",
    "electrode": "the electrode",
    "imaging_plane": "the imaging plane",
}
"""Names of the sections of the set-up that are entered by the user."""


def setup_to_do(problems: Iterable[InputError]) -> str:
    """Text of the actions needed to complete the set-up; empty if there are none."""
    missing: dict[str, list[str]] = {}
    wrong, calibrate = [], []
    for problem in problems:
        part, _, key = problem.field.partition(".")
        if part == "image_calibration":
            number = next(k for k, step in enumerate(STEPS, 1) if step.key == "plane")
            calibrate = [f"calibrate the picture (step {number})"]
        elif part not in PARTS:
            wrong.append(f"take out {problem.field}: {problem.expected}")
        elif problem.value == "unknown key":
            of = f"{key} of {PARTS[part]}"
            wrong.append(f"correct {of}: unknown key; expected {problem.expected}")
        elif problem.value == "missing":
            missing.setdefault(PARTS[part], []).extend([split_unit(key)[0]] if key else [])
        else:
            of = f"{split_unit(key)[0]} of {PARTS[part]}"
            wrong.append(f"correct {of}: {problem.value} is not {problem.expected}")
    enter = [
        f"{', '.join(names[:-1])} and {names[-1]} of {part}".removeprefix(" and ")
        if names
        else part
        for part, names in missing.items()
    ]
    typed = [f"enter {', '.join(enter)}"] if enter else []
    words = "; ".join([*wrong, *typed, *calibrate])
    return capitalized(words)


READ_ONLY = "The session is open read-only: nothing can be changed"


def read_only(session: Session | None) -> str:
    """Message if a session is open read-only; empty if it can be changed."""
    return READ_ONLY if session is not None and session.read_only else ""


def recording_gone(session: Session, where: str = " (step Recording)") -> str:
    """Message if the recording is missing, and what to do ``where``; empty if it is not."""
    missing = session.missing_recording
    return "" if missing is None else f"{missing.name} is missing: locate it{where}"


def why_not_measurable(session: Session) -> str:
    """Reason why no frame can be measured now, and what to do; empty if frames can be."""
    if session.read_only:
        return READ_ONLY
    if not len(session.frames):
        return "Import a recording first"
    if gone := recording_gone(session):
        return gone
    to_do = setup_to_do(session.setup_problems)
    return f"The set-up is not complete. {to_do}" if to_do else ""


@dataclass(frozen=True)
class Facts:
    """Data from which the steps' states are computed."""

    session: Session
    problems: tuple[InputError, ...] = ()
    """Problems of the set-up."""
    count: int = 0
    measured: int = 0
    failed: int = 0
    stale: int = 0
    """Number of all frames, of those with a result, of failed and of stale ones."""

    @property
    def checked(self) -> str:
        """Date of the bench check, see `Setup`."""
        return "" if self.problems else self.session.setup.check_date

    @property
    def to_do(self) -> str:
        """Text of what the set-up lacks; empty if nothing."""
        return setup_to_do(self.problems)

    def lacks(self, part: str) -> bool:
        """Whether something in a section of the set-up is missing or wrong."""
        return any(problem.field.partition(".")[0] == part for problem in self.problems)


def _facts(session: Session, seen: Overview | None) -> Facts:
    problems = session.setup_problems
    if session.recording is None:
        return Facts(session, problems)
    seen = seen or session.overview()
    return Facts(
        session,
        problems,
        count=len(seen.frame),
        measured=sum(status != "" for status in seen.status),
        failed=sum(map(is_failed, seen.status)),
        stale=int(seen.stale.sum()),
    )


def _setup(facts: Facts) -> State:
    from labapp.core.recording.residual_check import DOUBTFUL

    if facts.to_do:
        return State(Mark.READY, facts.to_do)
    if facts.session.setup_status == DOUBTFUL:
        return State(Mark.ATTENTION, "Complete, but doubtful: see the tab Bench")
    return State(Mark.DONE, "Complete")


def _laser(facts: Facts) -> State:
    if facts.session.laser_entries is not None:
        return State(Mark.READY, "What was entered waits to be applied")
    used, _ = calibrations_in_use(facts.session)
    return _calibrated(facts, facts.session.laser_calibration, used, facts.lacks("laser"))


def _plane(facts: Facts) -> State:
    if facts.session.plane_entries is not None:
        return State(Mark.READY, "The points in the picture wait to be applied")
    _, used = calibrations_in_use(facts.session)
    return _calibrated(
        facts, facts.session.plane_calibration, used, facts.lacks("image_calibration")
    )


NO_BENCH_CHECK = (
    "The session is of a line pattern, and the bench check is for a pattern of dots: go on to the "
    "next step"
)


def no_bench_check(session: Session | None) -> str:
    """Reason why a session's bench cannot be checked; empty if it can."""
    return NO_BENCH_CHECK if session is not None and session.has_lines else ""


def _bench_check(facts: Facts) -> State:
    kept = facts.session.bench_check
    if why := no_bench_check(facts.session):
        return State(Mark.TODO, why)
    if facts.problems:
        return State(Mark.TODO, f"Set-up: {facts.to_do}")
    entries = facts.session.bench_entries
    if entries is not None and entries.pictures:
        count = pluralize(len(entries.pictures), "picture")
        return State(Mark.READY, f"{count} of mirrors wait to be checked and applied")
    if facts.checked:
        return State(Mark.DONE, f"Checked against a known mirror on {facts.checked[:10]}")
    if kept is not None:
        return State(Mark.ATTENTION, "The set-up was changed after the check: check again")
    return State(Mark.READY, "Optional: not checked against a known mirror")


def _calibrated(facts: Facts, kept: object, used: bool, needed: bool) -> State:
    if used:
        return State(Mark.DONE, "Calibrated")
    if kept is not None and facts.checked:
        return State(Mark.DONE, "Calibrated, and adjusted by the bench check")
    if kept is not None:
        return State(Mark.READY, "Other values were entered after the calibration")
    if needed:
        return State(Mark.READY, "Not calibrated yet, and no values were entered")
    return State(Mark.READY, "Not calibrated here: the values were entered")


def _capture(facts: Facts) -> State:
    if facts.session.recording is None:
        return State(Mark.READY, "No recording yet")
    gone = recording_gone(facts.session)
    if (replaced := facts.session.replaced_recording) is not None:
        gone = f"{replaced.name} is not the imported recording: locate that (step Recording)"
    return (
        State(Mark.ATTENTION, gone) if gone else State(Mark.DONE, pluralize(facts.count, "frame"))
    )


def _dots(facts: Facts) -> State:
    if facts.failed:
        missing, seen = pluralize(facts.failed, "frame"), _seen(facts.session)
        return State(Mark.ATTENTION, f"{missing} could not be measured: check the {seen}")
    if facts.stale:
        return State(Mark.READY, f"{pluralize(facts.stale, 'frame')} to be measured again")
    if facts.measured == facts.count:
        return State(Mark.DONE, f"The {_seen(facts.session)} of all frames are measured")
    return State(Mark.READY, f"{pluralize(facts.count - facts.measured, 'frame')} to be measured")


def _seen(session: Session) -> str:
    return "lines" if session.has_lines else "dots"


def _surface(facts: Facts) -> State:
    frames = pluralize(facts.count, "frame")
    if facts.to_do and not facts.measured:
        return State(Mark.TODO, f"Set-up: {facts.to_do}")
    if facts.stale:
        return State(Mark.ATTENTION, f"{facts.stale} of {frames} out of date: measure again")
    if facts.measured < facts.count:
        return State(Mark.READY, f"{facts.count - facts.measured} of {frames} not measured yet")
    if facts.failed == facts.count:
        return State(Mark.ATTENTION, no_surface(facts.count))
    if facts.failed:
        measured = f"{facts.count - facts.failed} of {frames} are measured"
        return State(Mark.DONE, f"{measured}, {facts.failed} could not be")
    every = f"All {facts.count} frames are" if facts.count > 1 else "The frame is"
    return State(Mark.DONE, f"{every} measured")


def no_surface(count: int) -> str:
    """Text if none of the measured frames has a surface."""
    return f"None of {count} frames has a surface" if count > 1 else "The frame has no surface"


def results(facts: Facts) -> State:
    """State of a step that needs only results: ready as soon as there are any up to date."""
    if facts.stale:
        return State(Mark.ATTENTION, _surface(facts).why)
    if facts.measured and facts.failed == facts.measured:
        return State(
            Mark.ATTENTION, f"{no_surface(facts.measured)}: check the {_seen(facts.session)}"
        )
    if facts.measured:
        return State(Mark.READY, pluralize(facts.measured, "frame"))
    return State(Mark.TODO, "Measure some frames first")


@dataclass(frozen=True)
class Step:
    """One step of the guided procedure."""

    key: str
    """Name in code; the page is in ``labapp.gui.pages.KEY.page``."""
    title: str
    """Name for the operator."""
    hint: str
    """Instructions in two or three sentences."""
    page: str
    """Name of the page's class."""
    state: Callable[[Facts], State] = results
    needs_frames: bool = True
    """Whether it needs a recording; ``state`` is not called before there is one."""
    shows: str = ""
    """Contents of the page as soon as there are any, one sentence."""
    needs_results: bool = False
    """Whether the page is empty until a frame is measured."""
    lines: tuple[str, str, str] = ("", "", "")
    """Replacements of ``title``, ``hint`` and ``shows`` for a pattern of lines; empty: none."""

    def of(self, session: Session | None) -> Step:
        """The step with the texts for the pattern of a session."""
        if session is None or not self.lines[0] or not session.has_lines:
            return self
        title, hint, shows = self.lines
        return replace(self, title=title, hint=hint, shows=shows)


STEPS = (
    Step(
        "setup",
        "Set-up",
        "Note the experiment, go through the safety list, and enter the dimensions of the bench. "
        "The drawing shows which rays come back.",
        "SetupPage",
        _setup,
        needs_frames=False,
    ),
    Step(
        "laser",
        "Laser",
        "Put the cross-hair lens on the laser and measure the three lengths of the cross, more "
        "than once. The laser's angle and distance follow.",
        "LaserPage",
        _laser,
        needs_frames=False,
    ),
    Step(
        "plane",
        "Imaging plane",
        "Take a picture of the target on the imaging plane. O′ and the axes are found in it; drag "
        "any of them that is not where it should be.",
        "PlanePage",
        _plane,
        needs_frames=False,
    ),
    Step(
        "bench_check",
        "Bench check",
        "Take a picture of a mirror of known shape under the laser: a flat plate, a thumb tack, a "
        "bearing ball. Its dots show where laser and plane really are. A plate and a cap "
        "together give the most information. This step is optional.",
        "BenchCheckPage",
        _bench_check,
        needs_frames=False,
    ),
    Step(
        "capture",
        "Recording",
        "Import a video, images or a stack, or capture one with a camera. What is imported is read "
        "through once, and stays where it is.",
        "CapturePage",
        _capture,
        needs_frames=False,
    ),
    Step(
        "dots",
        "Dots",
        "Check the dots and their rows. Dots in doubt are marked: correct what is wrong, and go on "
        "to the next frame.",
        "DotsPage",
        _dots,
        shows="The dots of each frame, numbered by row and column.",
        lines=(
            "Pattern",
            "Check the lines and their numbers. Cut, join, number or delete what is wrong, and go "
            "on to the next frame.",
            "The lines of each frame, numbered from the lowest up.",
        ),
    ),
    Step(
        "surface",
        "Surface",
        "Measure the frames and look at the surface. The residuals show whether to trust it.",
        "SurfacePage",
        _surface,
        shows="The surface of the pool in 3-D, its width, length and height with their ±.",
        needs_results=True,
    ),
    Step(
        "trends",
        "Trends",
        "See how the pool changes over the recording. Click a point to go to its frame.",
        "TrendsPage",
        shows="Width, length and height of the pool over the recording.",
        needs_results=True,
    ),
    Step(
        "export",
        "Export",
        "Tick what is to be exported, and choose a folder.",
        "ExportPage",
        shows="Tables, surfaces, pictures and the report, to be written into a folder.",
        needs_results=True,
    ),
)
"""The steps; step list, menu, keys, guide and window are made from this tuple."""


def states(session: Session | None, seen: Overview | None = None) -> dict[str, State]:
    """State of every step by its key; ``seen`` is the session's overview if already available."""
    if session is None:
        return {step.key: State(Mark.TODO, "Open or make a session first") for step in STEPS}
    try:
        facts = _facts(session, seen)
    except InputError as error:
        return {step.key: _damaged(error) for step in STEPS}
    return {step.key: _state(step, facts) for step in STEPS}


def _state(step: Step, facts: Facts) -> State:
    """State of a step; its damaged data do not hide the states of the others."""
    if step.needs_frames and facts.session.recording is None:
        return State(Mark.TODO, "Import a recording first")
    try:
        return step.state(facts)
    except InputError as error:
        return _damaged(error)


def _damaged(error: InputError) -> State:
    return State(Mark.ATTENTION, f"Damaged in the file: {error.field}: {error.value}")


def lead(
    step: Step, session: Session, seen: Overview | None = None, measuring: bool = False
) -> Lead | None:
    """Substitute for the page of a step without content; None if the page has content.

    Parameters
    ----------
    seen
        The session's overview if already available.
    """
    facts = _facts(session, seen)
    if session.recording is None:
        return Lead(step.shows, ("import",)) if step.needs_frames else None
    if facts.measured or not step.needs_results:
        return None
    if measuring:
        return Lead(f"{step.shows} It appears with the first frame measured.", ("cancel",))
    if facts.problems:
        begun = all("." in problem.field for problem in facts.problems)
        names = (SETUP_ACTIONS[-1], *SETUP_ACTIONS[:-1]) if begun else SETUP_ACTIONS
        missing = setup_to_do(facts.problems) if begun else "The set-up is missing"
        return Lead(f"{step.shows} {missing}.", names)
    return Lead(step.shows, MEASURE_ACTIONS)


def first_step(session: Session) -> str:
    """Key of the first step to show: results if there are any, otherwise the next to do."""
    if session.recording is not None:
        measured = {status for status in session.overview().status if status != ""}
        if "followed" in measured and "ok" not in measured:
            return "trends"  # a single line is tracked, but gives no surface
        return "surface" if measured else "dots"
    return "capture" if states(session)["setup"].mark is Mark.DONE else "setup"


def first_frame(session: Session) -> int | None:
    """The first frame with a surface; None if there is none."""
    if session.recording is None:
        return None
    seen = session.overview()
    found = (frame for frame, status in zip(seen.frame, seen.status, strict=True) if status == "ok")
    return next((int(frame) for frame in found), None)
