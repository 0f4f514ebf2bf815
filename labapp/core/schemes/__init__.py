"""Registry of the reconstruction schemes, which compute a surface from matched dots.

A scheme is a module of this package and an entry of `SCHEMES`, which is the only list of schemes.
The modules are imported on first use, so that the command line can list schemes quickly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from labapp.core.geometry.rig import Rig
    from labapp.core.match import Match
    from labapp.core.surface.reconstruction import Reconstruction

LEAST_DOTS = 9
"""Minimum number of matched dots for a surface."""


class Words(NamedTuple):
    """Display names of a scheme: a short one, and a long one for lists of choices."""

    short: str
    long: str

    @property
    def title(self) -> str:
        """The long name up to the first colon."""
        return self.long.partition(":")[0]


@dataclass(frozen=True)
class Scheme:
    """A reconstruction scheme.

    Parameters
    ----------
    name
        Identifier for options and stored results, without a hyphen; also the name of its module and
        of its settings in `pipeline.Settings`.
    about
        Description for the help of the command line.
    words
        Display names; for a scheme with several algorithms, those of each algorithm, the default
        first. Such a scheme has settings with a field ``algorithm``.
    settings
        Name of the class of its settings, in its module; stored in session files, so it must never
        change. Empty: it has none.
    """

    name: str
    about: str
    words: Words | Mapping[str, Words]
    settings: str = ""

    @property
    def algorithms(self) -> tuple[str, ...]:
        """Names of its algorithms; empty if it has only one."""
        return () if isinstance(self.words, Words) else tuple(self.words)

    def algorithm(self, chosen: str) -> str:
        """Return the chosen algorithm, or the first if it has not that one; empty without any."""
        return chosen if chosen in self.algorithms else next(iter(self.algorithms), "")

    @property
    def settings_class(self) -> Any:
        """Class of its settings; the scheme must have some."""
        return getattr(self._module, self.settings)

    def reconstruct(self, match: Match, rig: Rig, settings: Any) -> Reconstruction:
        """Reconstruct the pool surface from matched dots; settings are None if it has none.

        Raises
        ------
        CannotMeasure
            If no surface is found.
        """
        reconstruction: Reconstruction = self._module.reconstruct(match, rig, settings)
        return reconstruction

    @property
    def _module(self) -> Any:
        return import_module(f"{__name__}.{self.name}")


SCHEMES: dict[str, Scheme] = {
    scheme.name: scheme
    for scheme in (
        Scheme("fit", "least-squares fit", Words("fit", "Fit: all dots at once"), "FitSettings"),
        Scheme("ers", "ERS (ch. 7)", Words("ERS", "ERS: extrapolation"), "ErsSettings"),
        Scheme(
            "irs",
            "IRS (ch. 6)",
            {
                "opa": Words("IRS, OPA", "IRS, one point (OPA)"),
                "epa-r": Words("IRS, EPA-R", "IRS, edge points, rows (EPA-R)"),
                "epa-c": Words("IRS, EPA-C", "IRS, edge points, columns (EPA-C)"),
                "epa-rc": Words("IRS, EPA-RC", "IRS, edge points, both (EPA-RC)"),
            },
            "IrsSettings",
        ),
        Scheme(
            "zonal",
            "zonal integration of slopes (Southwell)",
            Words("zonal", "Zonal: slopes between neighbours"),
            "ZonalSettings",
        ),
        Scheme(
            "modal",
            "modal integration of slopes (Zernike)",
            Words("modal", "Modal: Zernike polynomials"),
            "ModalSettings",
        ),
    )
}
"""All schemes by name, in the order in which they are offered."""


def algorithm_names() -> tuple[str, ...]:
    """Names of the algorithms of all schemes, each once."""
    return tuple(dict.fromkeys(name for one in SCHEMES.values() for name in one.algorithms))


def scheme_words() -> dict[str, Words]:
    """Display names of every scheme and algorithm, by the name under which results are stored."""
    found: dict[str, Words] = {}
    for name, scheme in SCHEMES.items():
        if isinstance(scheme.words, Words):
            found[name] = scheme.words
        else:
            found |= {f"{name}-{algorithm}": words for algorithm, words in scheme.words.items()}
    return found
