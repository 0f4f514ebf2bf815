"""Pictures in the list of the bench check, and the mirrors that they show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from labapp.core.bench_check.mirrors import Ball, Cap, Mirror, Plate
from labapp.media import GreyImage
from labapp.session.record import BenchEntries, MirrorEntry, MirrorPicture
from labapp.session.session import Session
from labapp.text import capitalized

KINDS = (("plate", "Flat plate"), ("cap", "Cap or thumb tack"), ("ball", "Bearing ball"))
"""Kinds of mirror, and their names."""

USUAL: Mapping[str, tuple[float, float | None]] = {
    "plate": (0.0, None),
    "cap": (0.91, 9.75),
    "ball": (10.0, 10.0),
}
"""Default height and diameter of a mirror by its kind, mm."""


@dataclass(frozen=True, eq=False)
class ListedPicture:
    """A picture in the list."""

    name: str
    """Name of its file."""
    image: GreyImage
    """Grey levels, shape (rows, columns)."""
    kind: str = "plate"
    height_mm: float = 0.0
    diameter_mm: float | None = None
    """The mirror in it, see `MirrorPicture`."""
    height_sigma_mm: float | None = None
    """Standard uncertainty of the height; None: the usual one."""
    level_sigma_deg: float | None = None
    """Standard uncertainty of a plate's level; None: the usual one."""
    sha256: str = ""
    """Its SHA-256 in the session; empty in a session that is open read-only."""

    @property
    def usual_mirror(self) -> Mirror:
        """The mirror with usual uncertainties."""
        if self.kind == "plate" or self.diameter_mm is None:
            return Plate(self.height_mm)
        if self.kind == "cap":
            return Cap(self.diameter_mm, self.height_mm)
        return Ball(self.diameter_mm, self.height_mm)

    @property
    def usual_height_sigma_mm(self) -> float:
        """Standard uncertainty of the height if none is entered, mm."""
        usual = self.usual_mirror
        return float(usual.sigma[usual.parameters.index("height_mm")])

    @property
    def mirror(self) -> Mirror:
        """The mirror."""
        made = self.usual_mirror
        if self.height_sigma_mm is not None:
            made = replace(made, height_sigma_mm=self.height_sigma_mm)
        if self.level_sigma_deg is not None and isinstance(made, Plate):
            made = replace(made, tilt_sigma_deg=self.level_sigma_deg)
        return made

    @property
    def mirror_words(self) -> str:
        """Text describing the mirror."""
        return capitalized(self.mirror.name)

    @property
    def problem(self) -> str:
        """Reason why the mirror is impossible; empty if it is not."""
        if self.kind == "cap" and not self.height_mm > 0:
            return "A cap is higher than 0 mm"
        return ""

    def of_kind(self, kind: str) -> ListedPicture:
        """The same picture with the usual mirror of another kind."""
        height, diameter = USUAL[kind]
        return ListedPicture(self.name, self.image, kind, height, diameter, sha256=self.sha256)

    @classmethod
    def of_kept(cls, one: MirrorPicture, image: GreyImage) -> ListedPicture:
        """A picture of a stored check."""
        made = cls(
            *(one.name, image, one.kind, one.height_mm, one.diameter_mm),
            sha256=one.picture_sha256,
        )
        usual = dict(zip(made.mirror.parameters, made.mirror.sigma.tolist(), strict=True))
        own = {name: sigma for name, sigma in one.pose_sigma if sigma != usual.get(name)}
        sigmas = own.get("height_mm"), own.get("tilt_x_deg")
        return replace(made, height_sigma_mm=sigmas[0], level_sigma_deg=sigmas[1])

    @classmethod
    def of_entry(cls, one: MirrorEntry, image: GreyImage) -> ListedPicture:
        """A picture of those not applied yet."""
        sizes = one.height_mm, one.diameter_mm, one.height_sigma_mm, one.level_sigma_deg
        return cls(one.name, image, one.kind, *sizes, one.picture_sha256)

    @property
    def entry(self) -> MirrorEntry:
        """The picture as the session stores it until it is applied."""
        return MirrorEntry(*self._key, self.sha256)

    def is_of(self, one: MirrorPicture) -> bool:
        """Whether a stored check has this picture with this mirror."""
        return ListedPicture.of_kept(one, self.image)._key == self._key

    @property
    def _key(self) -> tuple[str, str, float, float | None, float | None, float | None]:
        sizes = self.height_mm, self.diameter_mm, self.height_sigma_mm, self.level_sigma_deg
        return self.name, self.kind, *sizes


def stored_pictures(session: Session) -> tuple[ListedPicture, ...]:
    """Pictures that are not applied yet; without any, those of the check in use.

    Raises
    ------
    InputError
        If one is missing or damaged.
    """
    entries, check = session.bench_entries, session.bench_check
    if entries is not None:
        return tuple(
            ListedPicture.of_entry(one, session.picture(one.picture_sha256))
            for one in entries.pictures
        )
    return tuple(
        ListedPicture.of_kept(one, session.picture(one.picture_sha256))
        for one in (check.pictures if check else ())
    )


def enter(session: Session, chosen: Sequence[ListedPicture]) -> None:
    """Store the pictures of the list until they are applied, unless they are those in use."""
    check = session.bench_check
    kept = check.pictures if check else ()
    in_use = len(kept) == len(chosen) and all(
        one.is_of(other) and one.sha256 == other.picture_sha256
        for one, other in zip(chosen, kept, strict=True)
    )
    entries = None if in_use else BenchEntries(tuple(one.entry for one in chosen))
    session.set_entries("bench", entries)
