"""The Python API for scripts: measure an image or a recording, and get tables, grids and plots.

`measure` is `labapp.measure`. Tables need pandas, grids xarray; both come with the extra ``data``.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
import numpy.typing as npt

from labapp.config.settings import check_algorithm, check_overridden, check_settings
from labapp.config.setup import Setup, read_setup
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.pipeline import Measurement, Settings
from labapp.core.recording.residual_check import ResidualRecord, SetupVerdict, judged_status
from labapp.core.surface.measures import sigma_name
from labapp.core.values import FloatArray
from labapp.errors import PATH, InputError, check_positive, require, unknown_name
from labapp.export.frame_result import FrameResult
from labapp.export.meshes import open_mesh, refuse_too_large
from labapp.export.tables import TABLES, frame_tables
from labapp.media import Frame, open_source
from labapp.run.measurers import ColdMeasurer, WarmMeasurer
from labapp.run.runner import run, select_frames, with_setup_check

if TYPE_CHECKING:
    import matplotlib.axes
    import pandas as pd
    import xarray as xr

    from labapp.core.dynamics.analysis import Dynamics
    from labapp.core.dynamics.penetration import PenetrationModel, Prediction
    from labapp.session.session import Session
    from labapp.session.signals import Signals

TableName = Literal["measures", "dots", "points", "boundary"]

MOST_NODES = 50_000_000
"""Most nodes of all grids of `Results.surfaces`: 400 MB."""

CONTOUR_LEVELS = 40
"""Contour levels of a plotted surface."""

MANY_FRAMES = 40
"""Frames from which a plot over time has no markers."""


def measure(
    source: str | os.PathLike[str] | npt.NDArray[Any],
    setup: str | os.PathLike[str] | Setup,
    *,
    frames: str = ":",
    settings: Settings | None = None,
    follow: bool = False,
    progress: Callable[[FrameResult], object] | None = None,
) -> Results:
    """Measure the pool in an image, a stack of images or a recording.

    A frame that cannot be measured does not raise: its status and reason say why.

    Parameters
    ----------
    source
        Greyscale image, shape (height, width), or stack of images, shape (n, height, width), of
        any real type; or the path of a recording or of an image.
    setup
        Path of the setup file, or a set-up read from one (`labapp.config.setup.read_setup`).
    frames
        Frames to measure: ``START:STOP:STEP`` as in a Python slice, or the number of one frame.
    settings
        Settings of the measurement; None: the defaults of `labapp.core.pipeline.Settings`.
    follow
        Whether to start from the previous frame's result, which is more than ten times as fast.
    progress
        Called with the result of each frame.

    Returns
    -------
    Results
        The result of each frame.

    Raises
    ------
    InputError
        If the recording or the setup file cannot be read, the array is not an image or a stack of
        images, or an argument is invalid.

    Warns
    -----
    UserWarning
        If the set-up has an unusual value.
    """
    require(source, (*PATH, np.ndarray), "measure", "source", "a path or an array of grey levels")
    require(setup, (*PATH, Setup), "measure", "setup", "a setup file's path or a Setup")
    if isinstance(setup, str) and "\n" in setup:
        raise InputError("measure", "setup", "text of several lines", "a setup file's path")
    loaded = setup if isinstance(setup, Setup) else read_setup(setup)
    for unusual in loaded.warnings:
        warnings.warn(f"set-up: {unusual}", stacklevel=2)
    chosen = Settings() if settings is None else settings
    check_settings(chosen, "measure")
    check_overridden(chosen, "measure")
    check_algorithm(chosen, "measure", "settings.algorithm")
    if not (progress is None or callable(progress)):
        raise InputError("measure", "progress", repr(progress), "a function of a FrameResult")
    with ExitStack() as at_end:
        if isinstance(source, np.ndarray):
            count, read = len(_images(source)), _reader(_images(source))
        else:
            recording = at_end.enter_context(open_source(source))
            count, read = len(recording), recording.frame
        measurer = (WarmMeasurer if follow else ColdMeasurer)(read, loaded, chosen)
        record = ResidualRecord(loaded.rig)
        sinks = [] if progress is None else [progress]
        selected = select_frames(frames, count, "measure")
        found = list(run(selected, with_setup_check(measurer, record), sinks))
    verdict = record.verdict()
    status = judged_status(loaded.rig, verdict)  # of all frames together
    judged = (replace(r, measurement=replace(r.measurement, setup_status=status)) for r in found)
    return Results(tuple(judged), loaded.calibration, verdict)


@dataclass(frozen=True, repr=False)
class Results(Sequence[FrameResult]):
    """Results of frames, in order: a sequence of `FrameResult`.

    Parameters
    ----------
    results
        Result of each frame.
    calibration
        Pixel ↔ imaging plane.
    setup_check
        Check of the set-up by the residuals of all frames; None: not checked.
    """

    results: tuple[FrameResult, ...]
    calibration: ImageCalibration
    setup_check: SetupVerdict | None = None

    @classmethod
    def of_session(cls, session: Session) -> Results:
        """Return the results that a session has; frames that were not measured are left out.

        Parameters
        ----------
        session
            An open session.

        Returns
        -------
        Results
            With its calibration and the verdict on its set-up.
        """
        from labapp.session.session import Session

        require(session, Session, "Results.of_session", "session", "a Session")
        results = tuple(session.frame_results())
        return cls(results, session.setup.calibration, session.setup_verdict)

    # --- a sequence ---------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self.results)

    @overload
    def __getitem__(self, index: int) -> FrameResult: ...
    @overload
    def __getitem__(self, index: slice) -> Results: ...
    def __getitem__(self, index: int | slice) -> FrameResult | Results:
        if isinstance(index, slice):
            return Results(self.results[index], self.calibration, self.setup_check)
        return self.results[index]

    def __iter__(self) -> Iterator[FrameResult]:
        return iter(self.results)

    def __repr__(self) -> str:
        measured = [r.measurement.measures for r in self.results if r.measurement.measures]
        text = f"<labapp results: {len(self)} frames, {len(measured)} measured"
        if measured:
            heights = np.array([size.height_mm for size in measured])
            text += f", mean height {heights.mean():.3f} mm"
        return text + ">"

    # --- as data ------------------------------------------------------------------------------

    def dataframe(self, table: TableName = "measures") -> pd.DataFrame:
        """Return a table of all frames, with the columns and units of the CSV files.

        Parameters
        ----------
        table
            ``measures`` has one row per frame; ``dots``, ``points`` and ``boundary`` have many.

        Returns
        -------
        DataFrame
            Unknown values are NaN. ``attrs["units"]`` and ``attrs["descriptions"]`` hold the unit
            and the description of each column.

        Raises
        ------
        InputError
            If ``table`` is not the name of a table.
        """
        import pandas as pd

        if table not in tuple(TABLES):
            raise unknown_name("dataframe", "table", table, TABLES)
        columns = TABLES[table]
        parts = [frame_tables(result, self.calibration)[table] for result in self.results]
        values: dict[str, Any] = {
            column.name: np.concatenate([part[column.name] for part in parts]) if parts else []
            for column in columns
        }
        frame = pd.DataFrame(values)
        frame.attrs["units"] = {column.name: column.unit for column in columns}
        frame.attrs["descriptions"] = {column.name: column.description for column in columns}
        return frame

    def surfaces(self, spacing_mm: float = 0.1) -> xr.Dataset:
        """Return all surfaces on a common grid, NaN outside each frame's boundary.

        Parameters
        ----------
        spacing_mm
            Distance between neighbouring grid nodes, mm.

        Returns
        -------
        Dataset
            ``height``, dimensions (frame, y, x), mm above the work piece, with coordinates
            ``frame``, ``time``, ``y`` and ``x``. Frames without a surface are left out.

        Raises
        ------
        InputError
            If the spacing is not positive, or the grid would be very large.
        """
        import xarray as xr

        measured = [r for r in self.results if r.measurement.reconstruction is not None]
        x_mm, y_mm = _axes([r.measurement for r in measured], spacing_mm)
        nodes = np.meshgrid(x_mm, y_mm)
        height = np.full((len(measured), len(y_mm), len(x_mm)), np.nan)
        for grid, result in zip(height, measured, strict=True):
            reconstruction = result.measurement.reconstruction
            assert reconstruction is not None
            grid[...] = reconstruction.surface.height(*nodes)
        times = [np.nan if r.time_s is None else r.time_s for r in measured]
        mm = {"units": "mm"}
        return xr.Dataset(
            {"height": (("frame", "y", "x"), height, mm | {"long_name": "height of the surface"})},
            {
                "frame": [r.frame for r in measured],
                "time": ("frame", times, {"units": "s"}),
                "y": ("y", y_mm, mm | {"long_name": "Y, along the weld"}),
                "x": ("x", x_mm, mm | {"long_name": "X, across the weld"}),
            },
        )

    def dynamics(
        self,
        signals: Signals | None = None,
        of: str = "height_mm",
        band_hz: tuple[float, float] | None = None,
        segment_s: float | None = None,
    ) -> Dynamics:
        """Return the pool's modes, spectra, events and step responses over these frames.

        Parameters
        ----------
        signals
            Current, voltage and wire feed (`labapp.session.signals.read_signals`), for the step
            responses.
        of
            Series to analyse: a size column of the measures, or ``convexity_mm``, ``asymmetry``,
            ``wetting_slope_deg``.
        band_hz
            Lowest and highest frequency, Hz; None: all frequencies that the frame rate resolves.
        segment_s
            Duration of a segment of the spectrogram, s; None: an eighth of the recording.

        Returns
        -------
        Dynamics
            Modes, spectra, events and responses, each with its uncertainty.

        Raises
        ------
        InputError
            If frames have no time, fewer than 16 have a surface, or an argument is invalid.
        """
        from labapp.core.dynamics.analysis import DynamicsSettings
        from labapp.export.dynamics import dynamics_of, measured_of
        from labapp.session.signals import Signals

        timed = {}
        if signals is not None:
            require(signals, Signals, "dynamics", "signals", "those of read_signals, or None")
            timed = signals.timed()
        if segment_s is not None:
            check_positive(segment_s, "dynamics", "segment_s", "s")
        if band_hz is not None:
            right = "two frequencies, the lower one first (Hz)"
            require(band_hz, (tuple, list), "dynamics", "band_hz", right)
            low, high, *more = (*band_hz, None, None)
            if more[:-2] or not (_is_real(low) and _is_real(high) and low < high):
                raise InputError("dynamics", "band_hz", band_hz, right)
        return dynamics_of(measured_of(self), timed, DynamicsSettings(of, band_hz, segment_s))

    def penetration(self, model: PenetrationModel) -> Prediction:
        """Return the penetration that a model predicts over these frames.

        Parameters
        ----------
        model
            A fitted model, or one read by `labapp.export.penetration.read_model`.

        Returns
        -------
        Prediction
            Penetration of each frame, with its uncertainty.

        Raises
        ------
        InputError
            If frames have no time, or none has a surface.
        """
        from labapp.export.dynamics import measured_of
        from labapp.export.features import measured_series

        return model.predict(measured_series("results", measured_of(self), model.settings.features))

    # --- as plots -----------------------------------------------------------------------------

    def plot(
        self, size: str = "height_mm", axes: matplotlib.axes.Axes | None = None
    ) -> matplotlib.axes.Axes:
        """Plot a size over time, or over frames without times, with a band of ±1 σ.

        Parameters
        ----------
        size
            A column of the measures, such as ``width_mm``.
        axes
            Axes to plot in; None: those of a new figure.

        Returns
        -------
        Axes
            Where it was plotted.

        Raises
        ------
        InputError
            If there is no such column, or it is not numeric.
        """
        table = self.dataframe()
        numbers = map(str, table.select_dtypes("number"))
        sizes = [name for name in numbers if name not in ("frame", "time_s")]
        if size not in sizes:
            raise unknown_name("plot", "size", size, sizes)
        axes = _checked_axes("plot", axes)
        timed = bool(np.isfinite(table["time_s"]).all())
        at, value = table["time_s" if timed else "frame"].to_numpy(), table[size].to_numpy(float)
        (line,) = axes.plot(at, value, marker="." if len(at) < MANY_FRAMES else "")
        unit = table.attrs["units"][size]
        name = size if unit == "1" else size.removesuffix(f"_{unit}")
        sigma = sigma_name(size)
        if sigma in table:
            band = table[sigma].to_numpy(float)
            axes.fill_between(at, value - band, value + band, alpha=0.3, color=line.get_color())
        axes.set_xlabel("time (s)" if timed else "frame")
        if not timed:
            axes.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)
        shown = "" if unit == "1" else f" ({unit.replace('2', '²').replace('3', '³')})"
        axes.set_ylabel(name.replace("_", " ") + shown)
        return axes

    def plot_surface(
        self, index: int = 0, axes: matplotlib.axes.Axes | None = None, spacing_mm: float = 0.05
    ) -> matplotlib.axes.Axes:
        """Plot a frame's surface as a map of heights, with its boundary and reflection points.

        Parameters
        ----------
        index
            Index of the frame in these results.
        axes
            Axes to plot in; None: those of a new figure.
        spacing_mm
            Distance between the nodes of the surface that is drawn, mm.

        Returns
        -------
        Axes
            Where it was plotted.

        Raises
        ------
        InputError
            If the index is out of range, the frame has no surface, or the surface would have too
            many nodes.
        """
        from matplotlib.ticker import MaxNLocator

        valid = f"an index from 0 to {len(self) - 1}" if self.results else "results of some frames"
        require(index, (int, np.integer), "plot_surface", "index", valid)
        if not -len(self) <= index < len(self):
            raise InputError("plot_surface", "index", index, valid)
        index %= len(self)
        result = self.results[index]
        reconstruction = result.measurement.reconstruction
        if reconstruction is None:
            why = f"{result.measurement.status}: {result.measurement.reason}"
            raise InputError(f"frame {result.frame}", "surface", why, "a frame with a surface")
        axes = _checked_axes("plot_surface", axes)
        check_positive(spacing_mm, "plot_surface", "spacing_mm", "mm")
        refuse_too_large(reconstruction, spacing_mm)
        mesh = open_mesh(reconstruction, spacing_mm)  # up to the boundary; a grid ends in steps
        x, y, height = mesh.vertices_mm.T
        contours = axes.tricontourf(x, y, mesh.triangles, height, CONTOUR_LEVELS)
        bar = axes.figure.colorbar(contours, ax=axes, label="height (mm)")
        bar.locator = MaxNLocator(6)  # round numbers, instead of every fourth level
        bar.update_ticks()
        boundary = reconstruction.boundary.points_mm
        outline = np.vstack([boundary, boundary[:1]])
        axes.plot(outline[:, 0], outline[:, 1], color="black", linewidth=1)
        axes.plot(*reconstruction.points_mm[:, :2].T, ".", color="white", markersize=2)
        axes.use_sticky_edges = False  # room for the line of the boundary
        axes.set_aspect("equal")
        axes.set_xlabel("X (mm)")
        axes.set_ylabel("Y, along the weld (mm)")
        return axes


# --- parts ------------------------------------------------------------------------------------


def _images(source: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Images as an array, shape (n, height, width)."""
    right = "a grey image, shape (height, width), or images, shape (n, height, width)"
    if source.ndim not in (2, 3) or not source.size:
        raise InputError("source", "shape", str(source.shape), right)
    if source.dtype.kind not in "uif":
        raise InputError("source", "dtype", str(source.dtype), "integers or real numbers")
    return source if source.ndim == 3 else source[None]


def _reader(images: npt.NDArray[Any]) -> Callable[[int], Frame]:
    return lambda number: Frame(number, None, images[number])


def _axes(measured: Iterable[Measurement], spacing_mm: float) -> tuple[FloatArray, FloatArray]:
    """X and Y of a grid through the origin that encloses all boundaries, mm."""
    check_positive(spacing_mm, "surfaces", "spacing_mm", "mm")
    found = [m.reconstruction.boundary.points_mm[:, :2] for m in measured if m.reconstruction]
    if not found:
        return np.empty(0), np.empty(0)
    every = np.vstack(found)
    low, high = np.floor(every.min(axis=0) / spacing_mm), np.ceil(every.max(axis=0) / spacing_mm)
    if np.prod(high - low + 1) * len(found) > MOST_NODES:
        right = f"a spacing with at most {MOST_NODES} nodes in all"
        raise InputError("surfaces", "spacing_mm", str(spacing_mm), right)
    x_mm, y_mm = (np.arange(a, b + 1) * spacing_mm for a, b in zip(low, high, strict=True))
    return x_mm, y_mm


def _is_real(value: object) -> bool:
    """Whether a value is a finite number."""
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value))


def _checked_axes(source: str, axes: matplotlib.axes.Axes | None) -> matplotlib.axes.Axes:
    """The axes to plot in; those of a new figure if None."""
    from matplotlib.axes import Axes

    if axes is None:
        import matplotlib.pyplot as plt

        new_axes: matplotlib.axes.Axes = plt.subplots(layout="constrained")[1]
        return new_axes
    require(axes, Axes, source, "axes", "matplotlib axes, or None")
    return axes
