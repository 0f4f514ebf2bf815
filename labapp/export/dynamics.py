"""Dynamics of the pool: analysis of results, tables, pictures, a film of one mode."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from labapp.core.dynamics.analysis import Dynamics, DynamicsSettings, analyse
from labapp.core.dynamics.modes import RHO, RINGS, SPOKES, ModeCourse, SurfaceSeries
from labapp.core.dynamics.steps import RESPONSE_QUANTITIES
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.interpolation import CloughTocherSurface
from labapp.core.surface.measures import SHAPES, SIZES, WITH_SIGMA, sigma_names
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.shape import shape_of
from labapp.core.surface.surface import Surface
from labapp.core.values import FloatArray
from labapp.errors import InputError, unknown_name
from labapp.export.frame_result import FrameResult
from labapp.text import csv_text, number_cell, split_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from labapp.export.rendering.scene import Scene

FIGURES = (
    *("frequency_hz", "damping_per_s", "amplitude_mm", "phase_deg"),
    *("direction_deg", "turning"),
)

FILM_FRAMES, FILM_HZ, FILM_PERIODS = 48, 24.0, 3
"""Pictures per period in a film of one mode, pictures per second, periods."""

FILM_SWING = 0.3
"""Amplitude in the film, as a fraction of the pool's largest height."""


class MeasuredSurface(NamedTuple):
    """A frame with a surface."""

    frame: int
    time_s: float
    surface: Surface
    boundary: Boundary
    sizes: Mapping[str, float]
    """Sizes by name, as in `Measures`."""


def measured_of(results: Iterable[FrameResult]) -> Iterator[MeasuredSurface]:
    """Yield the frames that have a surface.

    Raises
    ------
    InputError
        If one of them has no time.
    """
    for one in results:
        found, sizes = one.measurement.reconstruction, one.measurement.measures
        if found is not None and sizes is not None:
            if one.time_s is None:
                raise no_time_base()
            yield MeasuredSurface(
                one.frame, one.time_s, found.unbounded, found.boundary, vars(sizes)
            )


def no_time_base() -> InputError:
    """Return the error for frames without times, which have no frequencies."""
    right = "a recording that has a time base: import it with a frame rate"
    return InputError("dynamics", "time", "unknown", right)


def dynamics_of(
    measured: Iterable[MeasuredSurface],
    signals: Mapping[str, tuple[FloatArray, FloatArray]] | None = None,
    settings: DynamicsSettings | None = None,
) -> Dynamics:
    """Analyse the dynamics of the pool over a recording.

    Parameters
    ----------
    measured
        Frames with a surface, in order (`measured_of`); consumed one by one.
    signals
        Name → times in the recording, s, and values.
    settings
        None: the defaults.

    Raises
    ------
    InputError
        If there are too few frames, or a name, the band or the segment is invalid.
    """
    chosen = settings or DynamicsSettings()
    if chosen.of not in WITH_SIGMA:
        raise unknown_name("dynamics", "of", chosen.of, WITH_SIGMA)
    rows: list[list[float]] = []
    sigmas: list[list[float]] = []
    parts = "height_sigma_setup_mm", *sigma_names("level")

    def collected() -> Iterator[tuple[int, float, Surface, Boundary]]:
        for frame, time_s, surface, boundary, sizes in measured:
            shape = [sizes.get(name, np.nan) for name in SHAPES]
            if not np.isfinite(shape).all():  # results of an older version
                shape = shape_of(surface, boundary).tolist()
            rows.append([*(sizes[name] for name in SIZES), *shape])
            sigmas.append([sizes.get(name, np.nan) for name in parts])
            yield frame, time_s, surface, boundary

    surfaces = SurfaceSeries.of(collected())
    if chosen.band_hz is not None and len(surfaces.time_s) > 1:
        low, half = chosen.band_hz[0], 0.5 / float(np.median(np.diff(surfaces.time_s)))
        if low > half * (1 - 1e-6):
            allowed = f"frequencies up to {half:.4g} Hz, half the frame rate"
            raise InputError("dynamics", "band_hz", f"from {low:g} Hz", allowed)
    series = dict(zip(WITH_SIGMA, np.array(rows).reshape(-1, len(WITH_SIGMA)).T, strict=True))
    highest = max(np.max(np.abs([series["height_mm"], series["depth_mm"]]), initial=0), 1e-9)
    setup, *level = (
        float(np.mean(of[np.isfinite(of)])) if np.isfinite(of).any() else 0.0
        for of in np.array(sigmas).reshape(-1, len(parts)).T
    )
    levels = dict(zip(WITH_SIGMA, level, strict=True))
    try:
        return analyse(surfaces, series, signals or {}, chosen, setup / highest, levels)
    except ValueError as error:
        raise InputError("dynamics", "frames", str(error), "a longer recording or part") from error


# --- tables -----------------------------------------------------------------------------------


def dynamics_tables(found: Dynamics) -> dict[str, str]:
    """Return the tables as CSV, by file name."""
    courses = [
        (f"{one.name} {k}".replace(" 0", ""), one.coefficient_mm[:, k])
        for one in found.all_modes
        for k in range(len(one.shape))
    ]
    series = {
        "frame": found.surfaces.frame,
        "time_s": found.surfaces.time_s,
        **found.series,
        **{f"mode {name} mm": values for name, values in courses},
    }
    mean, gram = found.spectrogram.mean(), found.spectrogram
    pairs = ("", "_sigma")
    return {
        "series.csv": _columns(series),
        "modes.csv": csv_text(
            [
                ["mode", "share", *(f"{n}{s}" for n in FIGURES for s in pairs), "others_hz"],
                *(_mode_row(one) for one in found.all_modes),
            ]
        ),
        "spectrum.csv": _columns(
            {
                "frequency_hz": mean.frequency_hz,
                "density_per_hz": mean.density,
                "low_95_per_hz": mean.low,
                "high_95_per_hz": mean.high,
            }
        ),
        "spectrogram.csv": _columns(
            {"time_s": gram.time_s}
            | {
                f"{hz:.6g} Hz": row
                for hz, row in zip(gram.frequency_hz, gram.density.T, strict=True)
            }
        ),
        "peak.csv": _columns(vars(found.peak)),
        "events.csv": csv_text(_event_rows(found)),
        "responses.csv": csv_text(_response_rows(found)),
    }


def _event_rows(found: Dynamics) -> Iterator[list[str]]:
    yield ["series", "time_s", "time_sigma_s", "change", "slope_change_per_s"]
    for name, events in found.events.items():
        for one in events:
            yield [
                name,
                *map(number_cell, (one.time_s, one.sigma_s, one.change, one.slope_change_per_s)),
            ]


def _response_rows(found: Dynamics) -> Iterator[list[str]]:
    names = [f"{name}{part}" for name in RESPONSE_QUANTITIES for part in ("", "_sigma")]
    yield ["signal", "series", "step_s", "signal_change", "order", "before", *names]
    for one in found.responses:
        step, fit = one.step, one.response
        pairs = [
            number_cell(of[name]) for name in RESPONSE_QUANTITIES for of in (fit.value, fit.sigma)
        ]
        where = [one.signal, one.series, number_cell(step.time_s), number_cell(step.change)]
        yield [*where, str(fit.order), number_cell(fit.before), *pairs]


def _mode_row(one: ModeCourse) -> list[str]:
    figures = one.figures
    cells = [number_cell(x) for n in FIGURES for x in figures.get(n, (np.nan, np.nan))]
    others = " ".join(f"{o.frequency_hz:.4g}" for o in one.oscillations[1:])
    return [one.name, number_cell(one.share), *cells, others]


def _columns(columns: Mapping[str, Any]) -> str:
    rows = zip(*columns.values(), strict=True)
    return csv_text([list(columns), *(list(map(number_cell, row)) for row in rows)])


# --- pictures ---------------------------------------------------------------------------------


def draw_spectrogram(plot: Any, found: Dynamics) -> None:
    """Draw the spectrogram in dB with the tracked peak, on Matplotlib axes."""
    gram = found.spectrogram
    db = 10 * np.log10(np.maximum(gram.density.T, 1e-30))
    low, high = np.nanpercentile(db, [20, 100])
    # Segments overlap by half: each is drawn as its middle half.
    width = gram.segment_s / (2 if len(gram.time_s) > 1 else 1)
    times = np.append(gram.time_s, gram.time_s[-1] + width) - width / 2
    step = gram.frequency_hz[0]
    hertz = np.append(gram.frequency_hz, gram.frequency_hz[-1] + step) - step / 2
    colours = {"vmin": low, "vmax": high, "cmap": "Blues", "rasterized": True}
    image = plot.pcolormesh(times, hertz, db, **colours)
    peak = found.peak
    bars = {"fmt": "C3.-", "linewidth": 0.8, "markersize": 3}
    plot.errorbar(peak.time_s, peak.frequency_hz, peak.frequency_sigma_hz, **bars)
    plot.set(xlabel="time (s)", ylabel="frequency (Hz)")
    plot.figure.colorbar(image, ax=plot, label=f"{density_label(found.settings.of)}, dB")


def density_label(name: str) -> str:
    """Name and unit of a series' power spectral density."""
    words, unit = split_unit(name)
    squared = f"({unit})²" if unit.endswith(("²", "³")) else f"{unit}²"
    return f"{words} ({squared if unit else 1}/Hz)"


def draw_spectrum(plot: Any, found: Dynamics) -> None:
    """Draw the mean spectrum with its 95 % interval."""
    mean = found.spectrogram.mean()
    plot.fill_between(mean.frequency_hz, mean.low, mean.high, alpha=0.3, linewidth=0)
    plot.semilogy(mean.frequency_hz, mean.density)
    plot.set(xlabel="frequency (Hz)", ylabel=density_label(found.settings.of))
    plot.set_title(f"{found.spectrogram.method}, 95 %", fontsize="small", loc="right")


def draw_series(plot: Any, found: Dynamics, name: str) -> None:
    """Draw a series with its events, the steps of signals and the fitted responses."""
    plot.plot(found.surfaces.time_s, found.series[name], ".", markersize=2, color="0.5")
    for event in found.events.get(name, ()):
        plot.axvline(event.time_s, color="C1", linewidth=0.8)
    for one in found.responses:
        if one.series == name:
            plot.plot(*one.response.fitted, color="C0")
            plot.axvline(one.step.time_s, color="C2", linestyle="--", linewidth=0.8)
    plot.set(xlabel="time (s)", ylabel=name)


def draw_mode(plot: Any, found: Dynamics, one: ModeCourse, turn: float = 0.0) -> None:
    """Draw the height of a mode from above, at a fraction of its period after the crest."""
    shape = mode_heights(one, turn)
    closed = _closed(found.surfaces.nodes_mm), _closed(shape[:, None])
    (x, y), z = np.moveaxis(closed[0], -1, 0), closed[1][..., 0]
    plot.contourf(x, y, z, np.linspace(-1.05, 1.05, 22), cmap="RdBu_r")
    plot.set(aspect="equal", xlabel="X (mm)", ylabel="Y (mm)")
    figures = one.figures
    text = "no significant oscillation"
    if figures:
        hertz, mm = figures["frequency_hz"], figures["amplitude_mm"]
        text = f"{hertz[0]:.2f} ± {hertz[1]:.2g} Hz\n{1e3 * mm[0]:.1f} ± {1e3 * mm[1]:.1f} µm"
    plot.set_title(f"{one.name}, {one.share:.0%}\n{text}", fontsize="small")


def dynamics_pictures(found: Dynamics) -> dict[str, Figure]:
    """Return the figures by name: ``dynamics`` and ``modes``."""
    from labapp.studies.plotting import INCHES, new_figure

    with new_figure(INCHES, 7.5) as whole:
        gram, spectrum, *series = whole.subplots(5, 1)
        draw_spectrogram(gram, found)
        draw_spectrum(spectrum, found)
        for plot, name in zip(series, ("width_mm", "length_mm", "height_mm"), strict=True):
            draw_series(plot, found, name)
    with new_figure(INCHES, 4.2) as modes:
        for plot, one in zip(modes.subplots(2, 4).flat, found.all_modes, strict=False):
            draw_mode(plot, found, one)
    return {"dynamics": whole, "modes": modes}


def dynamics_files(found: Dynamics, film: str | None = None) -> dict[str, bytes]:
    """Return tables (CSV), pictures (PNG) and, if a mode is named, its film (MP4), by file name.

    Raises
    ------
    InputError
        If there is no such mode, or 3-D pictures cannot be drawn.
    """
    from labapp.studies.plotting import as_bytes

    tables = {name: text.encode() for name, text in dynamics_tables(found).items()}
    pictures = dynamics_pictures(found).items()
    films = {} if film is None else {"mode.mp4": _mode_film(found, film)}
    return tables | {f"{name}.png": as_bytes(figure) for name, figure in pictures} | films


def mode_heights(one: ModeCourse, turn: float) -> FloatArray:
    """Return a mode of amplitude 1 at the k nodes, at a fraction of its period, shape (k,)."""
    if not one.oscillations:
        return np.asarray(one.shape[0] * np.cos(2 * np.pi * turn))
    amplitude = one.oscillations[0].amplitude / one.figures["amplitude_mm"][0]
    crest = np.exp(-1j * np.radians(one.figures["phase_deg"][0]))
    return np.asarray((amplitude * crest * np.exp(2j * np.pi * turn)).real @ one.shape)


def mode_scenes(found: Dynamics, one: ModeCourse) -> Iterator[Scene]:
    """Yield scenes of one period of a mode on the mean surface, with enlarged amplitude."""
    from labapp.export.rendering.scene import scene_of

    mean, figures = found.surfaces.mean_mm, one.figures
    swing = FILM_SWING * float(np.abs(mean).max())
    stamp = f"mode {one.name}"
    if figures:
        size = figures["amplitude_mm"][0]
        stamp += f", {figures['frequency_hz'][0]:.2f} Hz, {1e3 * size:.1f} µm ×{swing / size:.3g}"
    nodes = found.surfaces.nodes_mm.reshape(RINGS, SPOKES, 2)
    spoke = (nodes[-1] - nodes[0]) / (RHO[-1] - RHO[0])
    center = (nodes[0] - RHO[0] * spoke).mean(axis=0)
    theta = np.degrees(np.arctan2(spoke[:, 1], spoke[:, 0]))
    order = np.argsort(theta)
    rim = np.column_stack([center + spoke, np.zeros(SPOKES)])
    boundary = Boundary(center, theta[order], rim[order])
    limits = float(mean.min() - swing), float(mean.max() + swing)
    box = np.column_stack([rim[:, :2].min(0), rim[:, :2].max(0)]).T
    within = np.column_stack([box, limits])
    none = np.empty((0, 3))
    for k in range(FILM_FRAMES):
        height = mean + swing * mode_heights(one, k / FILM_FRAMES)
        points = np.vstack([np.column_stack([found.surfaces.nodes_mm, height]), rim])
        surface = CloughTocherSurface(points)
        empty = np.empty((0, 2), np.int64), none, none[:, :2], none[:, 0]
        scene = scene_of(Reconstruction("fit", surface, boundary, *empty), limits=limits)
        yield replace(scene, within_mm=within, stamp=stamp)


def _mode_film(found: Dynamics, name: str) -> bytes:
    """Film of one mode; errors as `dynamics_files`."""
    from labapp.export.rendering.film import write_video
    from labapp.export.rendering.studio import draw_there, drawing_errors, drawing_process

    every = {one.name.replace(" ", ""): one for one in found.all_modes}
    wanted = name.replace(" ", "").upper()
    if wanted not in every:
        raise InputError("--film", "mode", name, f"one of {', '.join(every)}")
    with drawing_errors("film"), drawing_process() as process:
        pictures = list(process.map(draw_there, mode_scenes(found, every[wanted])))
    count = FILM_PERIODS * FILM_FRAMES
    with TemporaryDirectory() as folder:
        path = Path(folder) / "mode.mp4"
        write_video(path, pictures * FILM_PERIODS, np.arange(count + 1) / FILM_HZ)
        return path.read_bytes()


def _closed(values: FloatArray) -> FloatArray:
    """Arrange values at the nodes as closed rings, shape (RINGS, SPOKES + 1, …)."""
    rings = values.reshape(RINGS, SPOKES, -1)
    return np.concatenate([rings, rings[:, :1]], axis=1)
