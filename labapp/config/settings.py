"""Checks of the settings of a measurement that a user names, and choice of its methods."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, get_args, get_type_hints

from labapp.core.images.find_dots import DotSettings
from labapp.core.matching.match_settings import MatchSettings
from labapp.core.pipeline import Settings
from labapp.core.rows.find_lattice import LatticeSettings
from labapp.core.schemes import SCHEMES, algorithm_names
from labapp.core.schemes.irs import IrsSettings
from labapp.errors import InputError, require, unknown_name


def check_settings(settings: Settings, source: str) -> None:
    """Check the names in settings; ``source`` is the function that received them.

    Raises
    ------
    InputError
        If they are not `Settings`, or name a scheme, an algorithm, a correspondence or a method
        that does not exist.
    """
    require(settings, Settings, source, "settings", "labapp.core.pipeline.Settings")
    named = (
        ("scheme", settings.scheme, tuple(SCHEMES)),
        ("algorithm", settings.algorithm, algorithm_names()),
        ("correspondence", settings.correspondence, _choices(Settings, "correspondence")),
        ("dots.method", settings.dots.method, _choices(DotSettings, "method")),
        ("lattice.method", settings.lattice.method, _choices(LatticeSettings, "method")),
    )
    for field, value, known in named:
        if value not in known:
            raise unknown_name(source, f"settings.{field}", value, known)


def check_overridden(settings: Settings, source: str) -> None:
    """Check that no part of the settings contains a choice that `Settings` overrides.

    Raises
    ------
    InputError
        If ``match.correspondence`` or ``irs.algorithm`` differs from that of `Settings`, and from
        its default.
    """
    overridden = (
        ("match", "correspondence", settings.match.correspondence, MatchSettings.correspondence),
        ("irs", "algorithm", settings.irs.algorithm, IrsSettings.algorithm),
    )
    for part, field, value, default in overridden:
        if value not in (default, getattr(settings, field)):
            expected = f"settings.{field}, which overrides it"
            raise InputError(source, f"settings.{part}.{field}", repr(value), expected)


def check_algorithm(settings: Settings, source: str | Path, field: str = "algorithm") -> None:
    """Check that the scheme has the algorithm; the default is allowed for every scheme.

    Raises
    ------
    InputError
        If the scheme does not have the algorithm, and would ignore it; at this source and field.
    """
    own = SCHEMES[settings.scheme].algorithms
    if settings.algorithm not in (Settings.algorithm, *own):
        owners = [name for name, one in SCHEMES.items() if settings.algorithm in one.algorithms]
        which = "which alone has it" if len(owners) == 1 else "which have it"
        expected = f"scheme {' or '.join(owners)}, {which}, instead of {settings.scheme}"
        if own:
            expected = f"one of {', '.join(own)}"
        raise InputError(source, field, settings.algorithm, expected)


def with_methods(
    settings: Settings, detector: str | None = None, rows: str | None = None
) -> Settings:
    """Return settings with another detector and search for rows; None: unchanged."""
    dots: Any = {"method": detector or settings.dots.method}
    lattice: Any = {"method": rows or settings.lattice.method}
    return replace(
        settings,
        dots=replace(settings.dots, **dots),
        lattice=replace(settings.lattice, **lattice),
    )


def _choices(owner: type, field: str) -> tuple[str, ...]:
    return get_args(get_type_hints(owner)[field])


def differences(value: Any, usual: Any, within: str = "") -> dict[str, tuple[Any, Any]]:
    """Return the fields of a dataclass that differ: full dotted name → own and usual value."""
    found: dict[str, tuple[Any, Any]] = {}
    for field in fields(value):
        mine, other = getattr(value, field.name), getattr(usual, field.name)
        if is_dataclass(mine) and type(mine) is type(other):
            found |= differences(mine, other, f"{within}{field.name}.")
        elif mine != other:
            found[within + field.name] = mine, other
    return found
