"""Comparison of dot detectors: labapp, trackpy, OpenCV and scikit-image.

Run as ``python tests/benchmarks/detectors.py [--frames N] [--cache FOLDER]``. The frames are those
of `labapp benchmark`. trackpy and scikit-image are in the dependency group ``benchmark``; if one is
not installed, that is printed.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import platformdirs
import typer
from scipy.spatial import cKDTree

from labapp.core.images.band_pass import band_pass_dots, quick_dots, tuning_of
from labapp.core.images.dots import Dots, Image
from labapp.core.pipeline import Settings
from labapp.core.values import FloatArray
from labapp.media import open_source
from labapp.simulated.benchmark import TRUE_PX, Spread, Video, make_video

COUNT = 40
"""Frames that every detector searches."""


@dataclass(frozen=True)
class Detected:
    """Scores of a detector.

    Parameters
    ----------
    name
        The detector.
    time
        Processor time per frame.
    recall, precision
        Share of the visible dots that it found; share of its detections that are dots.
    error_px
        Root mean square distance of detected dots from their true positions, px.
    """

    name: str
    time: Spread
    recall: float
    precision: float
    error_px: float


def detectors(size_px: float) -> Iterator[tuple[str, Callable[[Image], FloatArray] | str]]:
    """Yield name and function of each detector, or for a missing one how to install it.

    Parameters of other packages follow their documentation, for Gaussian dots of the given
    standard deviation.
    """
    settings = Settings().dots.band_pass

    opencv: Any = cv2  # its type hints lack this detector

    def blobs(image: Image) -> FloatArray:
        chosen = opencv.SimpleBlobDetector_Params()
        chosen.filterByColor, chosen.blobColor = True, 255
        chosen.filterByArea, chosen.minArea = True, float(size_px**2)
        chosen.maxArea = float(60 * size_px**2)
        chosen.filterByCircularity = chosen.filterByConvexity = chosen.filterByInertia = False
        chosen.minThreshold, chosen.maxThreshold, chosen.thresholdStep = 25.0, 200.0, 5.0
        chosen.minDistBetweenBlobs = 3.0 * size_px
        keypoints = opencv.SimpleBlobDetector_create(chosen).detect(image)
        return np.array([point.pt for point in keypoints]).reshape(-1, 2)

    def make_trackpy(trackpy: Any) -> Callable[[Image], FloatArray]:
        diameter = 2 * round(2 * size_px) + 1
        return lambda image: np.asarray(
            trackpy.locate(image, diameter, minmass=20 * size_px**2)[["x", "y"]]
        )

    def make_dog(feature: Any) -> Callable[[Image], FloatArray]:
        return lambda image: feature.blob_dog(
            np.asarray(image, float) / 255.0,
            min_sigma=0.7 * size_px,
            max_sigma=1.6 * size_px,
            threshold=0.03,
        )[:, 1::-1]

    yield "labapp, whole search", lambda image: band_pass_dots(image, settings).image_px
    yield "OpenCV SimpleBlobDetector", blobs
    for name, module, package, create in (
        ("trackpy locate", "trackpy", "trackpy", make_trackpy),
        ("scikit-image blob_dog", "skimage.feature", "scikit-image", make_dog),
    ):
        try:
            yield name, create(importlib.import_module(module))
        except ImportError:
            yield name, f"not installed: pip install {package}"


def compare_detectors(video: Video, count: int) -> list[Detected | tuple[str, str]]:
    """Return the scores of every detector on ``count`` frames of the video; see `detectors`."""
    frames = np.linspace(0, len(video.dots) - 1, count).astype(int).tolist()
    with open_source(video.path) as source:
        images = [source.frame(number).image for number in frames]
    settings = Settings().dots.band_pass
    tuning = tuning_of(images[0], settings)

    def quick(image: Image) -> FloatArray:
        dots: Dots = quick_dots(image, tuning, settings)
        return dots.image_px

    true = [video.dots[number][0] for number in frames]
    scores: list[Detected | tuple[str, str]] = [_detected("labapp, warm", quick, images, true)]
    for name, detector in detectors(tuning.size_px):
        if isinstance(detector, str):
            scores.append((name, detector))
        else:
            scores.append(_detected(name, detector, images, true))
    return scores


def _detected(
    name: str,
    detector: Callable[[Image], FloatArray],
    images: list[Image],
    true: list[FloatArray],
) -> Detected:
    times, hits, found_count, errors = [], 0, 0, []
    detector(images[0])
    for image, true_px in zip(images, true, strict=True):
        start_s = time.process_time()
        found = detector(image)
        times.append(time.process_time() - start_s)
        found_count += len(found)
        if len(found) == 0:
            continue
        distance, nearest = cKDTree(found).query(true_px)
        _, nearest_found = cKDTree(true_px).query(found)
        pairs = (nearest_found[nearest] == np.arange(len(true_px))) & (distance <= TRUE_PX)
        hits += int(pairs.sum())
        errors += distance[pairs].tolist()
    shown = sum(map(len, true))
    error = float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan")
    return Detected(name, Spread.of(times), hits / shown, hits / max(found_count, 1), error)


def main(frames: int = 2000, cache: Path | None = None) -> None:
    """Simulate the video, or reuse it, and print a line per detector."""
    folder = cache or Path(platformdirs.user_cache_dir("labapp")) / "benchmark"
    folder.mkdir(parents=True, exist_ok=True)
    head = f"{'median':>9}{'99 %':>9}  ms{'recall':>9}{'precision':>11}{'error':>8}  px"
    typer.echo(f"{'dots of a frame':26}{head}")
    for one in compare_detectors(make_video(folder, frames), COUNT):
        if isinstance(one, tuple):
            typer.echo(f"{one[0]:26} {one[1]}")
            continue
        spread = f"{one.time.median:9.2f}{one.time.worst:9.2f}    "
        scores = f"{one.recall:9.4f}{one.precision:11.4f}{one.error_px:8.3f}"
        typer.echo(f"{one.name:26}{spread}{scores}")


if __name__ == "__main__":
    typer.run(main)
