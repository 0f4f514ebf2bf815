"""The sample run: where it is, and the pictures that show what was measured in it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path

import labapp
from labapp.errors import InputError
from labapp.media import open_source
from labapp.session.pictures import (
    write_frame_picture,
    write_surface_picture,
    write_trend_picture,
)
from labapp.session.summary import Summary


def sample_folder() -> Path:
    """Folder of the sample run, beside the package in the repository.

    Raises
    ------
    InputError
        If it is not there, as in an installed package.
    """
    folder = Path(labapp.__file__).parents[1] / "sample_sessions" / "gtaw"
    if not folder.is_dir():
        raise InputError(folder, "sample run", "missing", "a checkout of labapp's repository")
    return folder


def draw_pictures(recording: Path, summary: Summary, out: Path) -> Iterator[tuple[str, str | None]]:
    """Draw pictures of a run into its folder.

    Yields
    ------
    name, problem
        Each picture's file name, and None or why it could not be drawn.
    """
    if summary.example is None:
        return
    frame, measurement = summary.example
    assert measurement.reconstruction is not None
    with open_source(recording) as source:
        image = source.frame(frame).image
    timed = all(time_s is not None for _, time_s, _ in summary.frames)
    axis = [time_s if timed else index for index, time_s, _ in summary.frames]
    label = "time (s)" if timed else "frame"
    series = {name: summary.series(f"{name}_mm") for name in ("width", "length", "height")}
    pictures: dict[str, Callable[[Path], None]] = {
        f"frame_{frame:06d}.png": partial(
            write_frame_picture, image=image, measurement=measurement
        ),
        "trends.png": partial(write_trend_picture, axis=axis, label=label, series=series),
        f"surface_{frame:06d}.png": partial(
            write_surface_picture, reconstruction=measurement.reconstruction
        ),
    }
    for name, draw in pictures.items():
        try:
            draw(out / name)
        except ImportError as error:
            yield name, f"{error.name} is not installed (pip install 'labapp[gui]')"
        except BrokenProcessPool:
            yield name, "OpenGL cannot be used here"
        except OSError as error:
            yield name, str(error.strerror)
        else:
            yield name, None
