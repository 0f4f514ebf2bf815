"""What the bench-check page shows: mirrors and their pictures, and what follows for the bench."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from labapp.config.setup import Setup, parse_setup, unchecked_setup
from labapp.core.bench_check.check import UNDETERMINED, BenchCheck, CheckedPicture, check_bench
from labapp.core.bench_check.forecast import EXPECTED, forecast
from labapp.core.bench_check.labelling import Picture
from labapp.core.bench_check.mirrors import Ball, Cap, Mirror, Plate
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.geometry.uncertainty import INDEX, QUANTITIES
from labapp.core.images.find_dots import DotSettings, find_mirror_dots
from labapp.core.values import FloatArray
from labapp.gui.digits import ResultRow, round_factor, rounded
from labapp.media import GreyImage
from labapp.media.formats.images import IMAGE_SUFFIXES
from labapp.session.record import BenchCheckRecord, MirrorPicture, Record
from labapp.session.session import Session
from labapp.text import now

PICTURES = IMAGE_SUFFIXES
"""How names of pictures end that can be dropped on the page."""

KINDS = (("plate", "Flat plate"), ("cap", "Cap or thumb tack"), ("ball", "Bearing ball"))
"""Kinds of mirror, and how they are named."""

USUAL: Mapping[str, tuple[float, float | None]] = {
    "plate": (0.0, None),
    "cap": (0.91, 9.75),
    "ball": (10.0, 10.0),
}
"""Height and diameter that a mirror of a kind has at first, mm."""

REACH_PX = 8.0
"""How near to a dot the pointer must be."""

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True, eq=False)
class Chosen:
    """A picture in the list."""

    name: str
    """Of its file."""
    image: GreyImage
    """Grey levels, shape (rows, columns)."""
    kind: str = "plate"
    height_mm: float = 0.0
    diameter_mm: float | None = None
    """The mirror in it, see `MirrorPicture`."""

    @property
    def mirror(self) -> Mirror:
        """The mirror."""
        if self.kind == "plate" or self.diameter_mm is None:
            return Plate(self.height_mm)
        if self.kind == "cap":
            return Cap(self.diameter_mm, self.height_mm)
        return Ball(self.diameter_mm, self.height_mm)

    @property
    def mirror_words(self) -> str:
        """The mirror in words."""
        name = self.mirror.name
        return name[:1].upper() + name[1:]

    @property
    def problem(self) -> str:
        """Why there is no such mirror; empty if there can be."""
        if self.kind == "cap" and not self.height_mm > 0:
            return "A cap is higher than 0 mm"
        return ""

    def of_kind(self, kind: str) -> Chosen:
        """The same picture with the usual mirror of another kind."""
        height, diameter = USUAL[kind]
        return replace(self, kind=kind, height_mm=height, diameter_mm=diameter)


def kept(session: Session) -> tuple[Chosen, ...]:
    """The pictures of the check that the session keeps."""
    found = session.bench_check
    return tuple(
        Chosen(
            one.name, session.picture(one.picture_sha256), one.kind, one.height_mm, one.diameter_mm
        )
        for one in (found.pictures if found else ())
    )


# --- the check ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Checked:
    """A check that was made here."""

    chosen: tuple[Chosen, ...]
    setup_text: str
    """The pictures and the set-up that it was made with."""
    check: BenchCheck
    record: BenchCheckRecord
    """The check as a session stores it; its pictures are not stored yet."""

    @property
    def words(self) -> str:
        """The verdict in a sentence."""
        return (
            f"✓ {_fit_words(self.record)}" if self.usable else f"▲ {_sentence(self.check.reason)}"
        )

    @property
    def usable(self) -> bool:
        """Whether the adjusted set-up may be used."""
        return self.check.status == "ok"

    @property
    def suspects(self) -> tuple[tuple[str, str], ...]:
        """Quantities that are off by far more than their ±: (key, name)."""
        return tuple((one.key, _sentence(one.name, "")) for one in self.check.suspects)


def check(
    chosen: Sequence[Chosen],
    setup_file: tuple[str, Path],
    settings: DotSettings,
    progress: Progress,
    free: Sequence[str] = (),
) -> Checked:
    """Adjust the set-up to pictures of known mirrors; `CannotMeasure` says why not.

    Parameters
    ----------
    setup_file, settings
        Text and path of the set-up, and how dots are found. What an earlier check has told of the
        bench is left out, or its pictures would count twice.
    progress
        Called with parts done, parts in all, and what is being done; may raise.
    free
        Quantities that are to be found from the pictures alone, see `check_bench`.
    """
    text, path = setup_file
    setup = parse_setup(unchecked_setup(text, path), path)
    pictures, parts = [], 2 * len(chosen) + 1
    for n, one in enumerate(chosen):
        progress(n, parts, f"dots of {one.name}")
        dots = find_mirror_dots(one.image, settings)
        rows, columns = one.image.shape
        pictures.append(Picture(one.name, one.mirror, dots, (rows, columns)))
    progress(len(chosen), parts, "adjusting the set-up")
    found = check_bench(pictures, setup.rig, setup.calibration, free)
    kept = []
    for n, (one, checked) in enumerate(zip(chosen, found.pictures, strict=True)):
        progress(len(chosen) + 1 + n, parts, f"measuring {one.mirror.name}")
        kept.append(_kept(one, checked, found, setup.calibration))
    changes = found.changes
    columns = ("before", "before_sigma", "after", "after_sigma")
    values = {name: np.array([getattr(one, name) for one in changes]) for name in columns}
    keys = tuple(one.key for one in changes)
    record = BenchCheckRecord(now(), tuple(kept), keys, **values, free=tuple(free))
    return Checked(tuple(chosen), text, found, record)


def _kept(
    one: Chosen, checked: CheckedPicture, found: BenchCheck, before: ImageCalibration
) -> MirrorPicture:
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
    )


def _fit_words(record: BenchCheckRecord) -> str:
    count = sum(len(one.ray) for one in record.pictures)
    square = np.concatenate([np.sum(one.residual_mm**2, axis=-1) for one in record.pictures])
    rms_um = 1000 * float(np.sqrt(np.mean(square)))
    return (
        f"{count} dots fit the known mirrors: what is left, {rms_um:.0f} µm on the plane, is noise."
    )


def _sentence(words: str, end: str = ".") -> str:
    return words[:1].upper() + words[1:] + end


# --- what is shown of it ------------------------------------------------------------------------


def kept_words(session: Session) -> str:
    """The stored check in words; empty without one."""
    found = session.bench_check
    if found is None:
        return ""
    day = found.date[:10]
    if session.setup_problems or not session.setup.checked:
        return f"▲ Checked on {day}, and the set-up was changed since: check again."
    return f"✓ In use since {day}. {_fit_words(found)}"


@dataclass(frozen=True)
class QuantityRow:
    """A line of the table of quantities."""

    texts: tuple[str, str, str, str, str, str, str]
    """Name, value and ± before, value and ± after, unit, and whether the pictures determine it."""
    determined: bool


COLUMNS = ("Quantity", "Before", "±", "After", "±", "Unit", "Determined")

DETERMINED, NOT_DETERMINED = "● yes", "○ no"


def quantity_rows(record: BenchCheckRecord) -> tuple[QuantityRow, ...]:
    """Quantities before and after a check; one that is known hardly better is not determined."""
    rows = []
    arrays = (record.before, record.before_sigma, record.after, record.after_sigma)
    for key, *values in zip(record.quantities, *arrays, strict=True):
        if key not in INDEX:
            continue
        one = QUANTITIES[INDEX[key]]
        before, before_sigma, after, after_sigma = map(float, values)
        determined = after_sigma <= UNDETERMINED * before_sigma
        texts = (
            *(_sentence(one.name, ""), *rounded(before, before_sigma)),
            *(*rounded(after, after_sigma), one.unit),
            DETERMINED if determined else NOT_DETERMINED,
        )
        rows.append(QuantityRow(texts, determined))
    return tuple(rows)


def mirror_rows(record: BenchCheckRecord) -> tuple[ResultRow, ...]:
    """Every mirror's size as the adjusted bench measures it, beside what is known of it."""
    names = {"plate": "Plate", "cap": "Cap", "ball": "Ball"}
    rows = []
    for picture in record.pictures:
        for name, known, measured, sigma in picture.measured:
            off = f" ({100 * (measured / known - 1):+.2f} %)" if abs(known) > 0.05 else ""
            note = (
                f"{picture.name}: known {known:.3f} mm, measured {measured:.3f} mm{off}; "
                "±: noise of the dots alone"
            )
            words = f"{names[picture.kind]}, {name} (known {known:.3f})"
            rows.append(ResultRow(words, measured, sigma, "mm", 3, note))
    return tuple(rows)


@dataclass(frozen=True)
class Overlay:
    """What is drawn over a picture."""

    dot_px: FloatArray
    """The dots with a ray, shape (n, 2)."""
    arrows_px: FloatArray
    """From each dot towards where the adjusted bench has it, enlarged, shape (2n, 2): beginnings
    and ends in turn.
    """
    numbers: tuple[tuple[str, float, float, bool], ...]
    """Words at places: (text, u, v, whether it is a row's); each at its first dot."""
    words: str
    """What is drawn, and how much the arrows are enlarged."""


def overlay(picture: MirrorPicture, height_px: int) -> Overlay:
    """Dots, their rays' numbers, and residuals to be seen in a picture of such a height."""
    residual = picture.computed_px - picture.dot_px
    length = np.hypot(*residual.T)
    # Nine in ten become a thirtieth of the picture at most.
    times = round_factor(height_px / 30 / max(float(np.quantile(length, 0.9)), 1e-6))
    ends = picture.dot_px + times * residual
    arrows = np.stack([picture.dot_px, ends], axis=1).reshape(-1, 2)
    longest_um = 1000 * float(np.hypot(*picture.residual_mm.T).max())
    words = (
        f"Arrows: residuals × {times:g}, the longest {longest_um:.0f} µm on the plane. "
        "i: rows, j: columns of the rays"
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
    """The ray of the dot at a place, and its residual; empty where there is none."""
    off = np.hypot(*(picture.dot_px - [u, v]).T)
    if not len(off) or off.min() > REACH_PX:
        return ""
    k = int(np.argmin(off))
    (i, j), um = picture.ray[k].tolist(), 1000 * np.hypot(*picture.residual_mm[k])
    return f"Ray ({i}, {j}): residual {um:.0f} µm"


def predicted(setup: Setup, record: Record) -> tuple[ResultRow, ...]:
    """± of the height of the pool that is expected, now and after each set of pictures."""
    width, height = record.expected_width_mm, record.expected_height_mm
    pool = Cap(width, height) if width and height and height > 0 else EXPECTED
    note = f"Standard uncertainty of the height of a pool {pool.name}"
    return tuple(
        ResultRow(_sentence(one.name, ""), one.total_sigma_mm, None, "mm", 4, note)
        for one in forecast(setup.rig, pool=pool)
    )
