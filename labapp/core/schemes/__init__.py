"""The ways from matched dots to a surface, of one signature: here is their list.

A scheme is a file of this folder and an entry of `SCHEMES`; whoever offers, runs, names or draws
schemes reads them from here. Nothing is imported that computes: the command line lists them, too.
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


class Words(NamedTuple):
    """What people call a scheme: in a line with others, and in a list to choose from."""

    short: str
    long: str

    @property
    def title(self) -> str:
        """The long words without what is explained after a colon."""
        return self.long.partition(":")[0]


@dataclass(frozen=True)
class Scheme:
    """A way from matched dots to a surface.

    Parameters
    ----------
    name
        What it is chosen and kept by, without a hyphen; its module in this folder and its own
        settings in `pipeline.Settings` are called so, too.
    about
        What it is, for the help of the command line.
    words
        What people call it; where it has algorithms, each with its own.
    settings
        Class of its settings, in its module; in session files for ever. Empty: it has none.
    """

    name: str
    about: str
    words: Words | Mapping[str, Words]
    settings: str = ""

    @property
    def algorithms(self) -> tuple[str, ...]:
        """Names of its algorithms; empty where it has but one."""
        return () if isinstance(self.words, Words) else tuple(self.words)

    @property
    def settings_class(self) -> Any:
        """The class of its settings, which it must have."""
        return getattr(self._module, self.settings)

    def reconstruct(self, match: Match, rig: Rig, settings: Any) -> Reconstruction:
        """Reconstruct the pool surface from matched dots, by its settings; None: it has none.

        Raises
        ------
        CannotMeasure
            If it finds no surface.
        """
        found: Reconstruction = self._module.reconstruct(match, rig, settings)
        return found

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
            Words("zonal", "Zonal: slopes integrated between neighbours"),
            "ZonalSettings",
        ),
        Scheme(
            "modal",
            "modal integration of slopes (Zernike)",
            Words("modal", "Modal: Zernike polynomials fitted to slopes"),
            "ModalSettings",
        ),
    )
}
"""All schemes by name, in the order in which they are offered."""


def scheme_words() -> dict[str, Words]:
    """Words for every scheme with each of its algorithms, by the name results are kept under."""
    found: dict[str, Words] = {}
    for name, scheme in SCHEMES.items():
        if isinstance(scheme.words, Words):
            found[name] = scheme.words
        else:
            found |= {f"{name}-{algorithm}": words for algorithm, words in scheme.words.items()}
    return found
