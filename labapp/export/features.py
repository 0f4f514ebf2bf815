"""Tables of weld features with ±, and penetration measured on sections: CSV and MATLAB."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from labapp.config.csv_tables import read_columns
from labapp.core.dynamics.penetration import (
    Kind,
    LeftOut,
    ModelSettings,
    PenetrationModel,
    validated_model,
)
from labapp.core.dynamics.weld_series import WeldSeries
from labapp.core.surface.measures import WITH_SIGMA, sigma_name
from labapp.core.values import FloatArray
from labapp.errors import InputError
from labapp.export.dynamics import MeasuredSurface
from labapp.files import as_bytes, write_file
from labapp.text import csv_text, number_cell

LARGEST = 1 << 29
"""Largest table, bytes."""

WANTED = "a table of features, as `labapp penetration table` writes it"

PARTS = ("noise", "level")


def feature_sigmas(name: str, columns: Mapping[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return the σ of a feature from noise and from level, shape (n,) each; NaN if unknown.

    Parameters
    ----------
    name
        One of `WITH_SIGMA`.
    columns
        Columns of `measures.csv`. If parts of the ± are missing, all of it counts as noise.
    """

    def part(which: str) -> FloatArray:
        missing = np.full(len(columns[name]), np.nan)
        return np.asarray(columns.get(sigma_name(name, which), missing), float)

    level, setup = (np.nan_to_num(part(which)) for which in ("level", "setup"))
    total = part("")
    return np.sqrt(np.maximum(total**2 - level**2 - setup**2, 0.0)), level + 0 * total


def weld_series(
    name: str, time_s: FloatArray, columns: Mapping[str, FloatArray], features: Sequence[str]
) -> WeldSeries:
    """Return features of a recording from the columns of `measures.csv`, without sections."""
    value = np.column_stack([columns[each] for each in features]).astype(float)
    sigmas = [feature_sigmas(each, columns) for each in features]
    noise, level = (np.column_stack(of) for of in zip(*sigmas, strict=True))
    unknown = np.full((2, len(time_s)), np.nan)
    return WeldSeries(name, np.asarray(time_s, float), value, noise, level, *unknown)


def measured_series(
    name: str, measured: Iterable[MeasuredSurface], features: Sequence[str] = WITH_SIGMA
) -> WeldSeries:
    """Return features of the frames of a session or a results folder.

    Raises
    ------
    InputError
        If no frame has a surface.
    """
    times: list[float] = []
    rows: list[dict[str, float]] = []
    for one in measured:
        times.append(one.time_s)
        rows.append(dict(one.sizes))
    if not rows:
        raise InputError(name, "frames", "none with a surface", "some that were measured")
    columns = {key: np.array([row.get(key, np.nan) for row in rows], float) for key in rows[0]}
    return weld_series(name, np.array(times), columns, features)


@dataclass(frozen=True)
class FeatureTable:
    """Features of welds, and their penetration measured on sections or scans."""

    features: tuple[str, ...]
    """Some of `WITH_SIGMA`."""
    target: str
    """Name of the penetration, such as ``back_width_mm``; empty without sections."""
    welds: tuple[WeldSeries, ...]

    def chosen(self, features: Sequence[str]) -> Self:
        """Return the table with some of its features, in the given order.

        Raises
        ------
        InputError
            If one is not in the table.
        """
        for name in features:
            if name not in self.features:
                right = f"some of {', '.join(self.features)}"
                raise InputError("features", "name", name, right)
        places = [self.features.index(name) for name in features]
        welds = (
            replace(
                one,
                value=one.value[:, places],
                noise=one.noise[:, places],
                level=one.level[:, places],
            )
            for one in self.welds
        )
        return replace(self, features=tuple(features), welds=tuple(welds))

    def fit(
        self,
        kind: Kind,
        settings: ModelSettings,
        progress: Callable[[int, int], object] = lambda _done, _of: None,
    ) -> tuple[PenetrationModel, LeftOut]:
        """Fit a model, and cross-validate it by leaving out one weld at a time.

        Parameters
        ----------
        kind
            ``arx``: linear, with explicit orders; ``gp``: a Gaussian process, which needs the extra
            ``models``.
        settings
            Features, target, orders, and threshold of full penetration.
        progress
            Called with the number of fits done and the total; may raise to stop.

        Raises
        ------
        InputError
            If a feature is missing, sections are too few, or scikit-learn is not installed.
        """
        try:
            return validated_model(self.chosen(settings.features).welds, kind, settings, progress)
        except ImportError as error:
            raise needs_extra("scikit-learn") from error
        except (ValueError, np.linalg.LinAlgError) as error:
            right = "more welds with sections of different penetration"
            raise InputError("fit", "welds", str(error), right) from error

    # --- files --------------------------------------------------------------------------------

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the table: ``.csv``, or ``.mat`` for MATLAB (``struct2table(features)``).

        Raises
        ------
        InputError
            If it cannot be written, or has another suffix.
        """
        path = Path(path)
        suffix = path.suffix.lower()
        if suffix not in (".csv", ".mat"):
            raise InputError(path, "name", suffix or "no suffix", ".csv or .mat")
        names = [name for one in self.welds for name in [one.name] * len(one.time_s)]
        columns = self._columns()
        if suffix == ".csv":
            cells = [
                [number_cell(value) for value in column.tolist()] for column in columns.values()
            ]
            rows = zip(names, *cells, strict=True)
            write_file(path, as_bytes(csv_text([["recording", *columns], *rows])))
            return
        from scipy.io import savemat

        content = io.BytesIO()
        fields: dict[str, Any] = {"recording": np.array(names, object)[:, None]}
        fields |= {name: column[:, None] for name, column in columns.items()}
        savemat(content, {"features": fields}, long_field_names=True)
        write_file(path, content.getvalue())

    def _columns(self) -> dict[str, FloatArray]:
        def joined(of: str) -> FloatArray:
            return np.concatenate([getattr(one, of) for one in self.welds])

        columns = {"time_s": joined("time_s")}
        value, noise, level = (joined(of) for of in ("value", "noise", "level"))
        for k, name in enumerate(self.features):
            columns[name] = value[:, k]
            columns[sigma_name(name, "noise")] = noise[:, k]
            columns[sigma_name(name, "level")] = level[:, k]
        if self.target:
            columns[self.target] = joined("target")
            columns[sigma_name(self.target)] = joined("target_sigma")
        return columns

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read a table that `write` wrote as CSV, or one with the same columns.

        Raises
        ------
        InputError
            If it is not such a table.
        """
        path = Path(path)
        words, columns = read_columns(path, WANTED, LARGEST, ("recording",))
        names = words.get("recording")
        for name, values in columns.items():
            if "_sigma" in name and (values < 0).any():
                raise InputError(path, name, f"{values[values < 0][0]:g}", "0 or more, or nothing")
        features = tuple(name for name in columns if name in WITH_SIGMA)
        if not names or "time_s" not in columns or not features:
            right = f"rows with recording, time_s and some of {', '.join(WITH_SIGMA)}"
            raise InputError(path, "columns", ", ".join(columns) or "none", right)
        known = {"time_s", *features, *(sigma_name(f, part) for f in features for part in PARTS)}
        others = [name for name in columns if name not in known]
        targets = [name for name in others if sigma_name(name) in others or len(others) == 1]
        if len(others) > 2 or (others and len(targets) != 1):
            raise InputError(path, "columns", ", ".join(others), "one of penetration, and its ±")
        target = targets[0] if targets else ""
        welds = tuple(_welds(path, names, columns, features, target))
        return cls(features, target, welds)


def _welds(
    path: Path,
    names: Sequence[str],
    columns: Mapping[str, FloatArray],
    features: Sequence[str],
    target: str,
) -> Iterator[WeldSeries]:
    """Yield the series of each recording, from the rows of a table."""
    unknown = np.full(len(names), np.nan)
    of = np.array(names)
    for name in dict.fromkeys(names):
        rows = np.flatnonzero(of == name)

        def taken(column: str, rows: Any = rows) -> FloatArray:
            return np.asarray(columns.get(column, unknown)[rows])

        time_s = taken("time_s")
        if not (np.diff(time_s) > 0).all() or not np.isfinite(time_s).all():
            raise InputError(path, f"time_s of {name}", "not ascending", "times that ascend")
        value, noise, level = (
            np.column_stack([taken(sigma_name(f, part) if part else f) for f in features])
            for part in ("", *PARTS)
        )
        measured = taken(target), taken(sigma_name(target)) if target else unknown[rows]
        yield WeldSeries(name, time_s, value, noise, level, *measured)


def needs_extra(package: str) -> InputError:
    """Return the error for a missing package of the extra ``models``."""
    return InputError(
        "penetration", package, "is not installed", "this package: pip install 'labapp[models]'"
    )
