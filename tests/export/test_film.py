"""The film: read with PyAV, it has every frame at its time, and is not blank."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.pipeline import Measurement
from labapp.errors import InputError
from labapp.export.folder import ExportChoice, export, verify_export
from labapp.export.frame_result import FrameResult
from labapp.export.rendering.film import Extent, film_scene, film_times, write_film, write_video
from labapp.export.rendering.scene import Scene
from labapp.export.rendering.studio import Picture, Studio

Frames = list[FrameResult]
SIZE = (480, 320)

FILM = ExportChoice(
    tables=frozenset({"measures"}),
    surfaces=frozenset(),
    pictures=frozenset({"film"}),
    view="top",
    size_px=SIZE,
)


@pytest.fixture
def frames(measured: Measurement, unmeasured: Measurement) -> Frames:
    """Frame 4 has no surface; frames 5 to 7 were not measured."""
    assert measured.measures is not None
    sizes = replace(measured.measures, height_mm=0.3, depth_mm=0.0)
    pool = replace(measured, measures=sizes)
    values = [(3, 0.30, pool), (4, 0.32, unmeasured), (8, 0.40, pool)]
    return [FrameResult(*value) for value in values]


@pytest.fixture
def extent(frames: Frames) -> Extent:
    extent = Extent()
    for result in frames:
        extent.add(result.measurement)
    return extent


class InlineExecutor(Executor):
    """Draws plain pictures immediately: the first is black, each further one lighter."""

    def __init__(self) -> None:
        self.scenes: list[Scene] = []

    def submit(self, work: object, scene: Scene) -> Future[Picture]:  # type: ignore[override]
        future: Future[Picture] = Future()
        future.set_result(np.full((32, 48, 3), 20 * len(self.scenes) % 256, np.uint8))
        self.scenes.append(scene)
        return future


def read(path: Path) -> tuple[list[float], list[float], list[np.ndarray]]:
    """Return start times of frames and durations of packets, s, and the pictures."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "mpeg4"
        durations = [float(p.duration * p.time_base) for p in container.demux(stream) if p.size]
    with av.open(str(path)) as container:
        decoded = list(container.decode(video=0))
    return [f.time for f in decoded], durations, [f.to_ndarray(format="bgr24") for f in decoded]


# --- times of frames -----------------------------------------------------------------------------


def test_film_times_leave_gaps_for_missing_frames(frames: Frames) -> None:
    numbered = [(result.frame, result.time_s) for result in frames]
    np.testing.assert_allclose(film_times(numbered), [0, 0.02, 0.1, 0.12])
    np.testing.assert_allclose(film_times(numbered, 5.0), [0, 0.2, 1.0, 1.2])
    untimed = [(3, 0.3), (4, None), (8, 0.4)]
    np.testing.assert_allclose(film_times(untimed), [0, 0.1, 0.5, 0.6])
    every_tenth = [(10, 1.0), (20, 1.1), (30, 1.2)]
    np.testing.assert_allclose(film_times(every_tenth, 25.0), [0, 0.04, 0.08, 0.12])
    np.testing.assert_allclose(film_times([(7, 0.7)]), [0, 0.1])
    np.testing.assert_allclose(film_times([(7, 0.7)], 25.0), [0, 0.04])


def test_film_has_every_frame_at_its_time(frames: Frames, extent: Extent, tmp_path: Path) -> None:
    path, progress = tmp_path / "film.mp4", list[int]()
    times_s = film_times([(result.frame, result.time_s) for result in frames])
    write_film(path, iter(frames), times_s, extent, InlineExecutor(), progress.append)
    starts, durations, pictures = read(path)
    np.testing.assert_allclose(starts, [0, 0.02, 0.1], atol=1e-9)
    np.testing.assert_allclose(durations, [0.02, 0.08, 0.02], atol=1e-9)
    assert [picture.shape for picture in pictures] == [(32, 48, 3)] * 3
    levels = [float(picture.mean()) for picture in pictures]
    np.testing.assert_allclose(levels, [0, 20, 40], atol=3)
    assert progress == [1, 2, 3]
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


@pytest.mark.parametrize("rate_hz", [0.5, 29.97, 500.0, 12_345.0, 60_000.0])
def test_any_frame_rate_is_preserved(tmp_path: Path, rate_hz: float) -> None:
    pictures = [np.full((16, 16, 3), 9, np.uint8)] * 7
    write_video(tmp_path / "a.mp4", pictures, np.arange(8) / rate_hz)
    starts, durations, _ = read(tmp_path / "a.mp4")
    np.testing.assert_allclose(starts, np.arange(7) / rate_hz, atol=1 / 60_000)
    assert sum(durations) == pytest.approx(7 / rate_hz, abs=1 / 60_000)


def test_too_high_frame_rate_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="export: film_rate_hz: 200000; expected at most 60000"):
        write_video(tmp_path / "a.mp4", [], np.arange(4) / 200_000)
    assert not list(tmp_path.iterdir())


def test_link_beside_the_film_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / ".a.mp4.part").symlink_to("mine.txt")
    write_video(tmp_path / "a.mp4", [np.zeros((16, 16, 3), np.uint8)], np.arange(2.0))
    assert (tmp_path / "mine.txt").read_text() == "mine"
    assert len(read(tmp_path / "a.mp4")[0]) == 1


# --- content -------------------------------------------------------------------------------------


def test_all_frames_share_extent_and_colours(frames: Frames, measured: Measurement) -> None:
    assert measured.reconstruction is not None
    assert measured.measures is not None
    boundary = measured.reconstruction.boundary
    shifted = replace(boundary, points_mm=boundary.points_mm + np.array([2.0, 0.0, 0.0]))
    other = replace(
        measured,
        reconstruction=replace(measured.reconstruction, boundary=shifted),
        measures=replace(measured.measures, height_mm=0.1, depth_mm=-0.4),
    )
    extent = Extent()
    assert not extent.known
    results = [*frames, FrameResult(9, None, other)]
    for result in results:
        extent.add(result.measurement)
    assert extent.limits == (-0.4, 0.3)
    np.testing.assert_allclose(extent.within_mm, [[-3, -3, -0.4], [5, 3, 0.3]])
    scenes = [film_scene(result, extent) for result in results]
    assert {scene.limits for scene in scenes} == {(-0.4, 0.3)}
    for scene in scenes:
        np.testing.assert_array_equal(scene.within_mm, extent.within_mm)
    assert [scene.stamp for scene in scenes] == [
        "frame 3, 0.3000 s",
        "frame 4, 0.3200 s",
        "frame 8, 0.4000 s",
        "frame 9",
    ]
    assert [scene.notice for scene in scenes] == [
        "",
        'cannot be measured: two references fit, "a" and "b"',
        "",
        "",
    ]
    assert [len(scene.triangles) > 0 for scene in scenes] == [True, False, True, True]


@pytest.mark.usefixtures("opengl")
def test_studio_keeps_its_viewpoint(frames: Frames, extent: Extent) -> None:
    studio = Studio(SIZE, "free")
    first, notice, again = (
        studio.draw(film_scene(replace(frames[k], frame=3, time_s=0.3), extent)) for k in (0, 1, 0)
    )
    studio.plotter.close()
    assert first.shape == (320, 480, 3)
    np.testing.assert_array_equal(first, again)
    # Text replaces the surface; the colour scale, at the right, is the same.
    blue, green, red = np.moveaxis(notice[:, :380].astype(int), 2, 0)
    assert not ((red > 180) & (green > 150) & (blue < 90)).any()
    assert (notice[60:140, 50:330] < 128).sum() > 500
    np.testing.assert_array_equal(notice[80:, 400:], first[80:, 400:])


# --- export -------------------------------------------------------------------------------------


def test_export_contains_the_film(
    frames: Frames, calibration: ImageCalibration, tmp_path: Path
) -> None:
    pytest.importorskip("pyvista")
    out, progress = tmp_path / "out", list[int]()
    choice = replace(FILM, film_rate_hz=10.0)
    written = export(out, frames, calibration, {}, choice, progress=progress.append)
    assert [file.name for file in written] == ["film.mp4", "measures.csv"]
    assert verify_export(out) == []
    assert progress == [1, 2, 3, 4, 5, 6]
    starts, _, pictures = read(out / "film.mp4")
    np.testing.assert_allclose(starts, [0, 0.1, 0.5], atol=1e-9)
    assert {picture.shape for picture in pictures} == {(320, 480, 3)}
    first, notice, last = (picture.astype(int) for picture in pictures)
    assert np.ptp(first) > 200
    # Frames 3 and 8 differ in the stamp only; frame 4 lacks the surface.
    assert np.abs(first - last)[40:].mean() < 1
    assert np.abs(first - notice)[40:].mean() > 5


def test_no_film_without_any_surface(
    unmeasured: Measurement, calibration: ImageCalibration, tmp_path: Path
) -> None:
    written = export(tmp_path / "out", [FrameResult(0, None, unmeasured)], calibration, {}, FILM)
    assert [file.name for file in written] == ["measures.csv"]


# --- failures ------------------------------------------------------------------------------------


class Stopped(Exception):
    pass


@pytest.mark.parametrize("at", [1, 2, 3])
def test_stopped_film_leaves_no_file(
    frames: Frames, extent: Extent, tmp_path: Path, at: int
) -> None:
    def stop(done: int) -> None:
        if done == at:
            raise Stopped

    times_s = film_times([(result.frame, result.time_s) for result in frames])
    with pytest.raises(Stopped):
        write_film(tmp_path / "film.mp4", frames, times_s, extent, InlineExecutor(), stop)
    assert not list(tmp_path.iterdir())


def test_film_is_started_before_all_frames_are_read(
    frames: Frames, extent: Extent, tmp_path: Path
) -> None:
    read_count = 0

    def results() -> Iterator[FrameResult]:
        nonlocal read_count
        for number in range(40):
            read_count += 1
            yield FrameResult(number, None, frames[0].measurement)

    ahead: list[int] = []
    write_film(
        tmp_path / "film.mp4",
        results(),
        np.arange(41) / 10,
        extent,
        InlineExecutor(),
        lambda done: ahead.append(read_count - done),
    )
    assert max(ahead) <= 4
    assert len(read(tmp_path / "film.mp4")[0]) == 40


FULL_DISK = """
    import resource, sys
    import numpy as np
    from pathlib import Path
    from labapp.export.rendering.film import write_video

    path, generator = Path(sys.argv[1]), np.random.default_rng(0)
    path.write_bytes(b"earlier")
    pictures = (generator.integers(0, 256, (240, 320, 3)).astype(np.uint8) for _ in range(60))
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, resource.RLIM_INFINITY))
    try:
        write_video(path, pictures, np.arange(61) / 10)
    except OSError as error:
        print(error.strerror)
    print([found.name for found in path.parent.iterdir()], path.read_bytes())
"""


def test_full_disk_leaves_the_earlier_file(tmp_path: Path) -> None:
    """The limit is set in the operating system."""
    process = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(FULL_DISK), str(tmp_path / "film.mp4")],
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": ":".join(sys.path)},
    )
    assert (process.returncode, process.stderr) == (0, "")
    assert process.stdout.splitlines() == ["File too large", "['film.mp4'] b'earlier'"]


def test_time_base_resolves_fractions_of_a_frame(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", [np.zeros((16, 16, 3), np.uint8)], np.array([0, 1 / 30]))
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].time_base == Fraction(1, 60_000)
