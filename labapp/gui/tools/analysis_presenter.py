"""Data of the error analysis window: its options, and texts of its results."""

from __future__ import annotations

import re
from pathlib import Path

from labapp.session.session import Session
from labapp.studies import SCHEME_NAMES

BUDGET = "budget"

PARTS = (
    (BUDGET, "Error budget of the set-up",
        "What each source does to the height of the expected pool, with fit"),
    ("CE", "CE: configuration (a minute)", "28 caps, the laser where it stood in §8.3.1"),
    ("LE", "LE: system limitation (10 min)",
        "The least error of the caps with the laser at 25° to 35° and 25 to 35 mm"),
    ("ME", "ME: methodology (10 min)", "The same as LE with 39 × 39 rays, 0.385° apart"),
    ("measurement", "Thumb tack of §8.2 (a minute)", "Rendered frames of it, measured"),
    ("images", "Image processing (minutes)", "Rendered frames of the 28 caps, measured"),
    ("parameters", "Parameter deviation (minutes)",
        "What the calibration's uncertainties do, one by one and by Monte Carlo"),
)  # fmt: skip
"""Parts that can be computed: key, text and explanation."""

SCHEME_CHOICES = (("", "all of them"), *((scheme, scheme) for scheme in SCHEME_NAMES))

OPENED, USUAL = "opened", "usual"
SETUPS = ((OPENED, "of the session"), (USUAL, "of §8.3.1, 4″ plane"))

USUAL_MM = (6.0, 7.0, 0.3)
"""Width, length and height of the pool if none is expected, mm."""


SetupOf = tuple[Path, str]
"""A session's file, and its set-up as text."""

LINES = (
    "The session is of a line pattern, which has no error budget: take the set-up of §8.3.1, or "
    "open a session of dots."
)


def has_setup(session: Session | None) -> bool:
    """Whether a session has a complete set-up of a pattern of dots."""
    return session is not None and not session.has_lines and not session.setup_problems


def setup_of(session: Session | None) -> SetupOf | None:
    """File and set-up, as text, of a session."""
    return None if session is None else (session.path, session.setup_text)


def of_former_setup(session: Session | None, of: SetupOf | None) -> str:
    """Text about a budget for another set-up than the session's; empty if it is for this one.

    ``of`` is the set-up for which the budget is; None if it is not that of a session.
    """
    if of is None or of == setup_of(session):
        return ""
    return f"▲ The budget is for the former set-up of {of[0].stem}: press Run for the present one."


def expected_mm(session: Session | None) -> tuple[float, float, float]:
    """Width, length and height of a session's expected pool, or the usual ones, mm."""
    if session is None:
        return USUAL_MM
    record = session.record
    noted = (record.expected_width_mm, record.expected_length_mm, record.expected_height_mm)
    width, length, height = (one or usual for one, usual in zip(noted, USUAL_MM, strict=True))
    return width, length, height


def result_title(name: str) -> str:
    """Title of a table or picture: "Figure 8-6: CE" for ``figure_8_6_CE``."""
    stem, _, kind = name.partition(".")
    figure = re.fullmatch(r"figure_(\d+)_(\d+)_(.+)", stem)
    words = (figure[3] if figure else stem).replace("_", " ")
    words = re.sub(r"\bare\b", "ARE", words)
    if figure:
        return f"Figure {figure[1]}-{figure[2]}: {words}"
    return f"{words[:1].upper()}{words[1:]}" + (", picture" if kind else "")
