"""Data of the bench-check page: mirrors, their pictures, and the result for the bench."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from labapp.config.setup import Setup, parse_setup, unchecked_setup
from labapp.core.bench_check.check import (
    UNDETERMINED,
    BenchCheck,
    CheckedPicture,
    check_bench,
)
from labapp.core.bench_check.forecast import (
    CANDIDATES,
    EXPECTED,
    BlindSpot,
    blind_spots,
    forecast,
    height_sigma,
)
from labapp.core.bench_check.labelling import MirrorDots
from labapp.core.bench_check.mirrors import Cap
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.uncertainty import INDEX, QUANTITIES
from labapp.core.images.find_dots import DotSettings, find_mirror_dots
from labapp.core.values import CannotMeasure, FloatArray
from labapp.gui.digits import round_factor
from labapp.gui.pages.bench_check.listed_picture import ListedPicture
from labapp.session.record import BenchCheckRecord, MirrorPicture, Record
from labapp.session.session import Session
from labapp.text import capitalized, now, plain, with_sigma

REACH_PX = 8.0
"""Largest distance, px, of the pointer from a dot."""

Progress = Callable[[int, int, str], None]


# --- the check ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class CheckResult:
    """A check made on this page."""

    chosen: tuple[ListedPicture, ...]
    setup_text: str
    """The pictures and the set-up used."""
    check: BenchCheck
    record: BenchCheckRecord
    """The check in the form that a session stores; its pictures are not yet stored."""
    height_sigma_mm: tuple[float, float] | None = None
    """± of the expected pool's height before and after; None if it cannot be measured."""
    blind: tuple[BlindSpot, ...] = ()
    """Heights of mirrors whose errors the pictures hardly reveal."""

    @property
    def words(self) -> str:
        """Text of the verdict, and of the next action."""
        if self.usable:
            parts = [f"✓ {_fit_words(self.record)}", *self._freed()]
            if self.height_sigma_mm is not None:
                before, after = self.height_sigma_mm
                parts.append(f"Expected ± of the pool's height: {before:.2g} → {after:.2g} mm.")
            parts += [
                f"An error of the height in {one.picture} below {one.noticed_mm:.2g} mm is not "
                f"noticed, and puts the pool's height off by up to {one.pool_mm:.2g} mm: add a "
                "picture of another mirror, or make sure of it."
                for one in self.blind
            ]
            return " ".join((*parts, "Press Apply to use the adjusted set-up."))
        reason = f"▲ {_sentence(self.check.reason)}"
        if not self.suspects:
            return reason
        return (
            f"{reason} Are the mirror's kind, size and height right? Then measure the quantity "
            "again and correct it, or have it found from the pictures."
        )

    def _freed(self) -> list[str]:
        """Texts of the quantities determined from the pictures alone."""
        found = []
        for one in self.check.changes:
            if one.key in self.check.free:
                before, after = plain(one.before, 2), with_sigma(one.after, one.after_sigma)
                found.append(
                    f"{_sentence(one.name, '')}, found from the pictures: {before} → {after} "
                    f"{one.unit}. Measure it again to be sure."
                )
        return found

    @property
    def usable(self) -> bool:
        """Whether the adjusted set-up may be used."""
        return self.check.status == "ok"

    @property
    def suspects(self) -> tuple[tuple[str, str], ...]:
        """Quantities whose error far exceeds their ±: (key, name); none if a size is wrong."""
        is_quantity = self.check.status == "quantity-off"
        suspects = self.check.suspects if is_quantity else ()
        return tuple((one.key, _sentence(one.name, "")) for one in suspects)


def check(
    chosen: Sequence[ListedPicture],
    setup_file: tuple[str, Path],
    settings: DotSettings,
    progress: Progress,
    free: Sequence[str] = (),
    pool: Cap = EXPECTED,
) -> CheckResult:
    """Adjust the set-up to pictures of known mirrors; `CannotMeasure` gives a reason.

    Parameters
    ----------
    setup_file, settings
        Text and path of the set-up, and the settings of the detector. Results of an earlier check
        are ignored, as its pictures would otherwise count twice.
    progress
        Called with the parts done, their total, and the current stage; may raise.
    free
        Quantities determined from the pictures alone, see `check_bench`.
    """
    text, path = setup_file
    setup = parse_setup(unchecked_setup(text, path), path)
    pictures, parts = [], 2 * len(chosen) + 1
    for n, one in enumerate(chosen):
        progress(n, parts, f"dots of {one.name}")
        try:
            dots = find_mirror_dots(one.image, settings)
        except CannotMeasure as answer:
            raise CannotMeasure(answer.status, f"{one.name}: {answer.reason}") from answer
        rows, columns = one.image.shape
        pictures.append(MirrorDots(one.name, one.mirror, dots, (rows, columns)))
    progress(len(chosen), parts, "adjusting the set-up")
    found = check_bench(pictures, setup.bench, free)
    kept = []
    for n, (one, checked) in enumerate(zip(chosen, found.pictures, strict=True)):
        progress(len(chosen) + 1 + n, parts, f"measuring {one.mirror.name}")
        kept.append(_kept(one, checked, setup.calibration))
    changes = found.changes
    columns = ("before", "before_sigma", "after", "after_sigma")
    values = {name: np.array([getattr(one, name) for one in changes]) for name in columns}
    keys = tuple(one.key for one in changes)
    record = BenchCheckRecord(now(), tuple(kept), keys, **values, free=tuple(free))
    return CheckResult(tuple(chosen), text, found, record, *_of_pool(found, pool))


def check_sizes(session: Session, chosen: Sequence[ListedPicture]) -> None:
    """Raise `CannotMeasure` if the size of a picture differs from that of the camera's others.

    These are the recording, the picture of the imaging plane, or the first in the list.
    """
    recording, plane = session.recording, session.plane_calibration
    if recording is not None:
        shape, of = (recording.rows, recording.columns), "the recording"
    elif plane is not None:
        shape, of = session.picture(plane.picture_sha256).shape, "the imaging plane's picture"
    else:
        shape, of = chosen[0].image.shape, chosen[0].name
    for one in chosen:
        if one.image.shape != shape:
            (rows, columns), (usual_rows, usual_columns) = one.image.shape, shape
            raise CannotMeasure(
                "wrong-size",
                f"{one.name} is {columns} × {rows} px, {of} {usual_columns} × {usual_rows} px: "
                "take it with the same camera and settings",
            )


def _of_pool(
    found: BenchCheck, pool: Cap
) -> tuple[tuple[float, float] | None, tuple[BlindSpot, ...]]:
    """± of the pool's height before and after, and errors that would not be noticed."""
    try:
        before, after = (height_sigma(rig, pool) for rig in (found.before, found.rig))
        blind = blind_spots(found, pool)
    except CannotMeasure:
        return None, ()
    return (before.total_sigma_mm, after.total_sigma_mm), blind


def _kept(one: ListedPicture, checked: CheckedPicture, before: ImageCalibration) -> MirrorPicture:
    dots = checked.picture.dots
    dot_px = np.column_stack([dots.u_px, dots.v_px])[checked.dot]
    return MirrorPicture(
        one.name,
        one.kind,
        one.height_mm,
        one.diameter_mm,
        "",
        checked.ray,
        dot_px,
        before.to_image(checked.plane_mm - checked.residual_mm),
        checked.residual_mm,
        tuple(
            (size.name, size.known_mm, size.measured_mm, size.sigma_mm) for size in checked.sizes
        ),
        tuple((size.independent_mm, size.independent_sigma_mm) for size in checked.sizes),
        tuple(zip(one.mirror.parameters, one.mirror.sigma.tolist(), strict=True)),
    )


def _fit_words(record: BenchCheckRecord) -> str:
    count = sum(len(one.ray) for one in record.pictures)
    square = np.concatenate([np.sum(one.residual_mm**2, axis=-1) for one in record.pictures])
    rms_um = 1000 * float(np.sqrt(np.mean(square)))
    return (
        f"{count} dots fit the known mirrors; their residual, {rms_um:.0f} µm RMS on the plane, is "
        "noise-like."
    )


def _sentence(words: str, end: str = ".") -> str:
    return capitalized(words) + end


# --- what is shown of it ------------------------------------------------------------------------


def kept_words(session: Session) -> str:
    """Text of the stored check; empty if there is none."""
    found = session.bench_check
    if found is None:
        return ""
    day = found.date[:10]
    if session.setup_problems or not session.setup.check_date:
        return (
            f"▲ The set-up was changed after this check of {day} and is no longer checked. Check "
            "again, or undo the change."
        )
    return f"✓ In use: checked on {day}. {_fit_words(found)}"


@dataclass(frozen=True)
class QuantityRow:
    """A row of the table of quantities."""

    group: str
    """Object to which the quantity belongs."""
    texts: tuple[str, str, str, str, str]
    """Name, value ± before, value ± after, unit, and whether the pictures determine it."""


COLUMNS = ("Quantity", "Before", "After", "Unit", "")

DETERMINED, NOT_DETERMINED = "●", "○"

LEGEND = (
    f"±: standard uncertainty. {DETERMINED} determined by the pictures; {NOT_DETERMINED} hardly: "
    f"its ± is still more than {UNDETERMINED:.0%} of that before"
).replace("%", " %")
"""Legend of the signs in the table."""


def quantity_rows(record: BenchCheckRecord) -> tuple[QuantityRow, ...]:
    """Quantities before and after a check; one that is hardly better known is not determined.

    Exactly known quantities, such as those of a missing glass, are left out.
    """
    rows = []
    arrays = (record.before, record.before_sigma, record.after, record.after_sigma)
    for key, *values in zip(record.quantities, *arrays, strict=True):
        if key not in INDEX:
            continue
        one = QUANTITIES[INDEX[key]]
        before, before_sigma, after, after_sigma = map(float, values)
        if before_sigma == 0.0:
            continue
        determined = after_sigma <= UNDETERMINED * before_sigma
        group, _, name = one.name.partition(", ")
        texts = (
            name if len(name) == 1 else _sentence(name, ""),  # s and h are symbols
            with_sigma(before, before_sigma),
            with_sigma(after, after_sigma),
            one.unit,
            DETERMINED if determined else NOT_DETERMINED,
        )
        rows.append(QuantityRow(_sentence(group, ""), texts))
    groups = list(dict.fromkeys(row.group for row in rows))  # later quantities join their group
    return tuple(sorted(rows, key=lambda row: groups.index(row.group)))


MIRROR_COLUMNS = ("True, mm", "Adjusted", "Without it")


def mirror_rows(record: BenchCheckRecord) -> tuple[tuple[str, str, str], ...]:
    """Size of every mirror: true, measured with the adjusted set-up, and measured without it.

    The last is empty for a check stored by an earlier version.
    """
    names = {"plate": "Plate", "cap": "Cap", "ball": "Ball"}
    rows = []
    for picture in record.pictures:
        for one, independent in zip_longest(picture.measured, picture.independent):
            name, known, measured, sigma = one
            words = f"{names[picture.kind]}, {name} {plain(known, 3)}"
            alone = "" if independent is None else with_sigma(*independent)
            rows.append((words, with_sigma(measured, sigma), alone))
    return tuple(rows)


@dataclass(frozen=True)
class Overlay:
    """Overlay of a picture."""

    dot_px: FloatArray
    """Dots with a known ray, shape (n, 2), px."""
    arrows_px: FloatArray
    """Enlarged arrows from each dot towards its position by the adjusted bench, shape (2n, 2):
    starts and ends in turn.
    """
    numbers: tuple[tuple[str, float, float, bool], ...]
    """Labels (text, u, v, whether it is a row's), each at the first dot."""
    words: str
    """Text of the content, and of the enlargement of the arrows."""


def overlay(picture: MirrorPicture, height_px: int) -> Overlay:
    """Dots, numbers of their rays, and residuals enlarged for a picture of this height."""
    residual = picture.computed_px - picture.dot_px
    length = np.hypot(*residual.T)
    # Nine of ten end before the next dot, so that the dots stay visible.
    spacing = float(np.median(cKDTree(picture.dot_px).query(picture.dot_px, k=2)[0][:, 1]))
    longest = min(height_px / 30, spacing)
    times = round_factor(longest / max(float(np.quantile(length, 0.9)), 1e-6))
    ends = picture.dot_px + times * residual
    arrows = np.stack([picture.dot_px, ends], axis=1).reshape(-1, 2)
    longest_um = 1000 * float(np.hypot(*picture.residual_mm.T).max())
    words = (
        f"Lines: residuals × {times:g}, from each dot to where the adjusted set-up has it; the "
        f"longest is {longest_um:.0f} µm. i, j: row and column of the ray"
    )
    return Overlay(picture.dot_px, arrows, _numbers(picture), words)


def _numbers(picture: MirrorPicture) -> tuple[tuple[str, float, float, bool], ...]:
    """Numbers of rows and columns, each at its first dot: the first, the last, and every fifth."""
    made = []
    for axis, letter in ((0, "i"), (1, "j")):
        numbers = np.unique(picture.ray[:, axis]).tolist()
        for number in numbers:
            if number % 5 and number not in (numbers[0], numbers[-1]):
                continue
            line = np.flatnonzero(picture.ray[:, axis] == number)
            first = line[np.argmin(picture.ray[line, 1 - axis])]
            u, v = picture.dot_px[first].tolist()
            made.append((f"{letter}{number}", u, v, axis == 0))
    return tuple(made)


def ray_words(picture: MirrorPicture, u: float, v: float) -> str:
    """Text of the ray and residual of the dot at a position; empty if there is none."""
    off = np.hypot(*(picture.dot_px - [u, v]).T)
    if not len(off) or off.min() > REACH_PX:
        return ""
    k = int(np.argmin(off))
    (i, j), um = picture.ray[k].tolist(), 1000 * np.hypot(*picture.residual_mm[k])
    return f"Ray ({i}, {j}): residual {um:.0f} µm"


def expected_cap(record: Record) -> Cap:
    """The expected pool of the record, or a usual one."""
    width, height = record.expected_width_mm, record.expected_height_mm
    return Cap(width, height) if width and height and height > 0 else EXPECTED


@dataclass(frozen=True)
class Predicted:
    """Predicted effect of pictures on the ± of the expected pool's height."""

    words: str
    """Text of the pool, and of what is not predicted."""
    rows: tuple[tuple[str, str], ...]
    """Set of pictures, and the resulting ± in mm; the first row is without pictures."""


def predicted(setup: Setup, record: Record) -> Predicted:
    """Predict the ± of the expected pool's height, now and after each set of pictures.

    Raises
    ------
    CannotMeasure
        If that pool cannot be measured with this set-up.
    """
    pool = expected_cap(record)
    try:
        made = forecast(setup.rig, CANDIDATES, pool)
    except CannotMeasure as answer:
        words = f"a pool like a {pool.name} cannot be measured with this set-up: {answer.reason}"
        raise CannotMeasure(answer.status, words) from answer
    rows = [(one.name, f"{one.total_sigma_mm:.4f}") for one in made]
    rows += [(name, NO_DOTS) for name in CANDIDATES if name not in {one.name for one in made}]
    rows[0] = "no picture: as it is now", rows[0][1]
    words = (
        f"Predicted ± of the height of a pool {pool.diameter_mm:g} mm wide and {pool.height_mm:g} "
        "mm high:"
    )
    return Predicted(words, tuple((_sentence(name, ""), sigma) for name, sigma in rows))


NO_DOTS = "no dots"
"""Text for a set with a picture that would have no dots on the imaging plane."""
