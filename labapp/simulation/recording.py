"""A simulated recording with its ground truth, written into a folder."""

from __future__ import annotations

import csv
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import ClassVar, Protocol

import cv2
import numpy as np
import numpy.typing as npt
import tifffile

from labapp.core.geometry.rig import Rig
from labapp.core.values import BoolArray, FloatArray
from labapp.simulation.calibration.target import Target, TargetLook, render_target
from labapp.simulation.camera import CameraView
from labapp.simulation.forward import PoolSurface, Reflections, trace
from labapp.simulation.parallel import Progress, held, hold, processes, wait_for
from labapp.simulation.render import GreyImage, Look, Picture, RenderedFrame, ray_brightness, render
from labapp.simulation.torch import Torch
from labapp.system import interrupts_blocked

TARGET = Target()

MOMENTS = 15
"""Number of samples over the exposure of a moving pool; odd, so that one is in the middle."""

AHEAD = 4
"""Number of frames rendered ahead of the one being written."""

TRUTH_COLUMNS = (
    "frame", "time_s", "width_mm", "length_mm", "height_mm", "depth_mm", "area_mm2", "volume_mm3",
    "peak_x_mm", "peak_y_mm", "dots", "second_reflections",
)  # fmt: skip
DOT_COLUMNS = (
    "frame", "ray_row", "ray_column", "u_px", "v_px", "visible", "x_mm", "y_mm", "z_mm",
    "blocked", "hits_again",
)  # fmt: skip


class TruePool(PoolSurface, Protocol):
    """Pool surface with the methods needed for the ground truth."""

    def inside(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        """Whether (x, y) is within the boundary."""
        ...

    def boundary_mm(self) -> FloatArray:
        """Points of the boundary, shape (n, 3), mm."""
        ...

    def after(self, seconds: float) -> TruePool:
        """The same pool ``seconds`` later; itself if nothing moves."""
        ...


@dataclass(frozen=True)
class RecordedFrame(RenderedFrame):
    """A rendered frame, perhaps the sum of several exposures, and its ground truth."""

    pool: TruePool
    reflections: Reflections
    """The ground truth, in the middle of the exposure."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Description of a simulated recording; its random numbers follow from the seed."""

    file: str
    """Name of the recording: a video (``.avi``, ``.mkv``), a TIFF stack (``.tif``), or a folder of
    PNG files (no suffix).
    """
    rig: Rig
    view: CameraView
    look: Look
    """The bench, the camera's view of the imaging plane, and the appearance of the frames."""
    pools: tuple[TruePool, ...]
    """The pool of each frame, in the middle of its exposure."""
    seed: int
    frame_rate_hz: float | None = None
    """Frames per second; None if the recording has no time base."""
    exposure_s: float = 0.0
    """Exposure time of a frame; motion during it blurs the dots of a moving pool."""
    torches: tuple[Torch, ...] = ()
    """The torch in each frame; if empty, all rays above the rig's electrode tip are blocked."""
    exposures: int = 1
    """Number of exposures added up to a frame."""
    first_number: int = 0
    """Number in the name of the first PNG file."""

    truth_columns: ClassVar[tuple[str, ...]] = TRUTH_COLUMNS
    dot_columns: ClassVar[tuple[str, ...]] = DOT_COLUMNS

    def frame(self, index: int) -> RecordedFrame:
        """Render frame ``index``, counted from 0, independently of the others."""
        torch = self.torches[index] if self.torches else None
        pools = _over_exposure(self.pools[index], self.exposure_s)
        moments = [trace(pool, self.rig, torch) for pool in pools]
        middle = moments[len(moments) // 2]
        brightness = ray_brightness(
            middle.absent.shape, self.look.unevenness, np.random.default_rng([self.seed, 0])
        )
        rng = np.random.default_rng([self.seed, 1, index])
        exposed = [
            render(moments, self.view, self.look, rng, brightness) for _ in range(self.exposures)
        ]
        image = exposed[0].image
        if self.exposures > 1:
            image = np.sum([one.image for one in exposed], axis=0, dtype=np.uint16)
        return RecordedFrame(image, exposed[0].dot_px, exposed[0].shown, self.pools[index], middle)

    def calibration_picture(self) -> GreyImage:
        """Render the calibration picture, grey levels, shape (height, width)."""
        rng = np.random.default_rng([self.seed, 2])
        return render_target(TARGET, self.view, TargetLook(), rng)

    def write_run(
        self,
        folder: Path,
        setup: str,
        workers: int = 1,
        progress: Progress | None = None,
    ) -> None:
        """Write recording, calibration picture, setup file and truth into ``folder``.

        Parameters
        ----------
        folder
            Created if missing.
        progress
            Called for each frame and while waiting for one; may raise to stop.

        Raises
        ------
        OSError
            If the folder or a file in it cannot be written.
        """
        folder.mkdir(parents=True, exist_ok=True)
        _write_png(folder / "calibration.png", self.calibration_picture())
        (folder / "setup.toml").write_text(setup, encoding="utf-8")
        with (
            _table(folder / "truth.csv", self.truth_columns) as truth,
            _table(folder / "dots_truth.csv", self.dot_columns) as dots,
        ):
            done = 0

            def report() -> None:
                if progress is not None:
                    progress("frames", done, len(self.pools))

            def images() -> Iterator[Picture]:
                nonlocal done
                for one in self._frames(workers, report):
                    truth.writerow(one.truth)
                    dots.writerows(one.dots)
                    yield one.image
                    done += 1
                    report()

            self._write_recording(folder / self.file, images())

    def _frames(self, workers: int, poll: Callable[[], None]) -> Iterator[_Rendered]:
        """Render every frame in order; ``poll`` is called while waiting for one."""
        numbers = iter(range(len(self.pools)))
        if workers == 1:
            yield from (_render(self, number) for number in numbers)
            return
        with processes(workers, hold, partial, _render, self) as pool:
            waiting: deque[Future[_Rendered]] = deque()
            with interrupts_blocked():
                waiting += (pool.submit(_render_there, n) for n in islice(numbers, workers + AHEAD))
            while waiting:
                yield wait_for(waiting.popleft(), poll)
                waiting += (pool.submit(_render_there, n) for n in islice(numbers, 1))

    def _write_recording(self, path: Path, images: Iterator[Picture]) -> None:
        if path.suffix == ".tif":
            sixteen = self.exposures > 1 or self.look.bits != 8
            tifffile.imwrite(
                path,
                images,
                shape=(len(self.pools), self.view.height_px, self.view.width_px),
                dtype=np.uint16 if sixteen else np.uint8,
                photometric="minisblack",
                compression="zlib",
            )
        elif path.suffix:
            assert self.frame_rate_hz is not None
            size = (self.view.width_px, self.view.height_px)
            write_video(path, images, self.frame_rate_hz, size)
        else:
            path.mkdir(exist_ok=True)
            for n, image in enumerate(images, self.first_number):
                _write_png(path / f"frame_{n}.png", image)


def _over_exposure(pool: TruePool, exposure_s: float) -> list[TruePool]:
    """The pool at evenly spaced times over an exposure centred on the pool's time."""
    if exposure_s == 0 or pool.after(exposure_s) is pool:
        return [pool]
    steps = (np.arange(MOMENTS) - (MOMENTS - 1) / 2) / MOMENTS
    return [pool.after(exposure_s * float(step)) for step in steps]


# --- frames in processes of their own -----------------------------------------------------------


@dataclass(frozen=True)
class _Rendered:
    """Picture and table rows of a frame to be written."""

    image: Picture
    truth: Mapping[str, str]
    dots: list[Mapping[str, str]]


def _render(recording: Recording, number: int) -> _Rendered:
    frame = recording.frame(number)
    truth = _truth_row(number, recording.frame_rate_hz, frame)
    return _Rendered(frame.image, truth, list(_dot_rows(number, frame)))


def _render_there(number: int) -> _Rendered:
    """Render a frame of the recording that this process holds."""
    rendered: _Rendered = held()(number)
    return rendered


# --- files --------------------------------------------------------------------------------------


def write_video(
    path: Path,
    images: Iterable[npt.NDArray[np.uint8 | np.uint16]],
    frame_rate_hz: float,
    size_px: tuple[int, int],
) -> None:
    """Write 8-bit grey frames of (width, height) ``size_px`` as lossless FFV1.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    codec = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path), codec, frame_rate_hz, size_px, isColor=False)
    if not writer.isOpened():
        raise OSError(f"cannot write {path}")
    for image in images:
        writer.write(image)
    writer.release()


def _number(value: float) -> str:
    return f"{value:.5f}".replace("-0.00000", "0.00000")


def _area_and_volume(pool: TruePool) -> tuple[float, float]:
    """Area within the boundary, mm², and volume under the surface, mm³, on a grid of 0.02 mm."""
    rim = pool.boundary_mm()
    step = 0.02
    x, y = np.meshgrid(*(np.arange(rim[:, n].min(), rim[:, n].max(), step) for n in range(2)))
    x, y = x + step / 2, y + step / 2
    return (
        float(pool.inside(x, y).sum()) * step**2,
        float(np.nansum(pool.height(x, y))) * step**2,
    )


def _truth_row(n: int, frame_rate_hz: float | None, frame: RecordedFrame) -> Mapping[str, str]:
    size = frame.pool.size
    area, volume = _area_and_volume(frame.pool)
    values = (size.width_mm, size.length_mm, size.height_mm, size.depth_mm, area, volume)
    # As in `labapp reconstruct`: the lowest point of a concave pool.
    peak = size.peak_mm if size.height_mm >= -size.depth_mm else size.bottom_mm
    again = frame.reflections.lit & ~frame.reflections.blocked & frame.reflections.hits_again
    row = [
        str(n),
        "" if frame_rate_hz is None else f"{n / frame_rate_hz:.5f}",
        *(_number(value) for value in (*values, *peak)),
        str(int(frame.shown.sum())),
        str(int(again.sum())),
    ]
    return dict(zip(TRUTH_COLUMNS, row, strict=True))


def _dot_rows(n: int, frame: RecordedFrame) -> Iterator[Mapping[str, str]]:
    seen = frame.reflections
    for i, j in np.argwhere(seen.lit):
        u, v = frame.dot_px[i, j]
        row = [
            *map(str, (n, i + 1, j + 1)),
            *("" if np.isnan(value) else f"{value:.3f}" for value in (u, v)),
            str(int(frame.shown[i, j])),
            *(f"{value:.5f}" for value in seen.point_mm[i, j]),
            str(int(seen.blocked[i, j])),
            str(int(seen.hits_again[i, j])),
        ]
        yield dict(zip(DOT_COLUMNS, row, strict=True))


def _write_png(path: Path, image: npt.NDArray[np.uint8 | np.uint16]) -> None:
    if not cv2.imwrite(str(path), image):
        raise OSError(f"cannot write {path}")


@contextmanager
def _table(path: Path, columns: tuple[str, ...]) -> Iterator[csv.DictWriter[str]]:
    """Write a CSV file row by row; values of columns that it does not have are left out."""
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.DictWriter(file, columns, extrasaction="ignore", lineterminator="\n")
        rows.writeheader()
        yield rows
