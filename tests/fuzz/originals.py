"""The undamaged files: small, so that damage affects relevant parts."""

from __future__ import annotations

import csv
import hashlib
import io
import os
import sqlite3
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np
import tifffile

from labapp.core.calibration.plane_calibration import PlaneCalibration
from labapp.core.images.dots import Dots
from labapp.core.match import Match, Trial
from labapp.core.pipeline import Measurement, Settings
from labapp.core.rows.correction import Correction
from labapp.core.rows.lattice import Lattice
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.interpolation import ThinPlateSurface
from labapp.core.surface.measures import Measures
from labapp.core.surface.reconstruction import Reconstruction
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.core.surface.surface import Surface
from labapp.export.folder import ExportChoice, export
from labapp.export.frame_result import FrameResult
from labapp.session.record import (
    BenchEntries,
    CrossPicture,
    LaserEntries,
    MirrorEntry,
    PlanePicture,
    Record,
)
from labapp.session.results.measured import Basis
from labapp.session.session import Session
from tests.media.cine_writer import write_cine
from tests.media.photron_writer import write_photron

ROOT = Path(__file__).parents[2]
SETUP = ROOT / "sample_sessions" / "gtaw" / "setup.toml"
SHAPE = (48, 64)


@dataclass(frozen=True)
class Originals:
    """The files by kind; each is in its own folder with the files that belong to it."""

    sessions: tuple[Path, ...]
    setups: tuple[Path, ...]
    recordings: tuple[Path, ...]
    tables: tuple[Path, ...]
    manifests: tuple[Path, ...]


def make_originals(folder: Path) -> Originals:
    recordings = _recordings(folder)
    return Originals(
        sessions=(
            _session(folder / "embedded", embed=True),
            _session(folder / "linked", embed=False),
            _new_session(folder / "new"),
        ),
        setups=_setups(folder / "setup"),
        recordings=recordings,
        tables=_tables(folder / "tables"),
        manifests=(_export(folder / "export"),),
    )


def pictures(count: int = 6, dtype: type = np.uint8) -> list[np.ndarray]:
    rng = np.random.default_rng(5)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    blob = [200 * np.exp(-((x - 8 * k) ** 2 + (y - 24) ** 2) / 40) for k in range(count)]
    return [(rng.integers(10, 40, SHAPE) + each).astype(dtype) for each in blob]


def dots_of(frame: int, count: int = 12) -> Dots:
    rng = np.random.default_rng(frame)
    u, v = np.meshgrid(np.arange(4) * 14.0 + 8, np.arange(count // 4) * 14.0 + 8)
    return Dots(u.ravel() + rng.uniform(-1, 1, count), v.ravel(), *rng.uniform(0.1, 9, (5, count)))


def lattice_of(count: int = 12) -> Lattice:
    row, column = np.repeat(np.arange(3, 0, -1), 4)[:count], np.tile(np.arange(1, 5), 3)[:count]
    return Lattice(row, column, (2, 3), ((2, 3), (1, 2)), frozenset({3}))


def measurement_of(frame: int, scheme: str = "fit") -> Measurement:
    """Return a plausible measurement with all fields; its numbers depend on the frame."""
    rng = np.random.default_rng([frame, len(scheme)])
    n = 12
    theta = np.arange(-180.0, 180.0, 30.0)
    circle = 3.0 * np.column_stack([np.cos(np.radians(theta)), np.sin(np.radians(theta))])
    points = np.column_stack([rng.uniform(-2, 2, (n, 2)), rng.uniform(0, 0.3, n)])
    basis = SplineBasis.over(np.array([-4.0, -4.0]), np.array([4.0, 4.0]), 2.0)
    spline = SplineSurface(basis, rng.normal(size=int(np.prod(basis.shape))))
    surface: Surface = spline if scheme == "fit" else ThinPlateSurface(points)
    lattice = lattice_of(n)
    return Measurement(
        status="ok",
        reason="",
        scheme=scheme,  # type: ignore[arg-type]
        dots=dots_of(frame, n),
        lattice=lattice,
        match=Match(
            orientation="S/S",
            dot=np.arange(n),
            ray=np.column_stack([lattice.row + 8, lattice.column + 7]),
            reflected=np.column_stack([lattice.row, lattice.column]),
            plane_mm=rng.uniform(0, 90, (n, 2)),
            plane_covariance_mm2=np.tile(np.eye(2), (n, 1, 1)),
            ray_states=rng.integers(-1, 2, (19, 19)),
            trials=(Trial("S/S", 0.1), Trial("I/I", 2.0)),
        ),
        reconstruction=Reconstruction(
            scheme=scheme,  # type: ignore[arg-type]
            surface=surface,
            boundary=Boundary(np.zeros(2), theta, np.column_stack([circle, np.zeros(len(theta))])),
            ray=np.column_stack([lattice.row + 8, lattice.column + 7]),
            points_mm=points,
            residual_mm=rng.normal(0, 0.1, (n, 2)),
            sigma_mm=np.full(n, 0.01),
        ),
        measures=Measures(*rng.uniform(0.1, 9, len(Measures.__dataclass_fields__)).tolist()),
    )


def keep(session: Session, frame: int, measurement: Measurement, scheme: str) -> None:
    """Store a result without measuring."""
    basis = Basis(session.setup, replace(session.settings, scheme=scheme))  # type: ignore[arg-type]
    session._results.put(
        frame, measurement, basis, session._documents.fingerprint("correction", frame)
    )


def _session(folder: Path, *, embed: bool) -> Path:
    folder.mkdir()
    recording = folder / "recording.npy"
    np.save(recording, np.stack(pictures(6, np.uint16 if embed else np.uint8)))
    path = folder / "run.labsession"
    record = Record(title="A run", operator="Ä. Weld", current_a=120.0, safety=(("gas", "now"),))
    with Session.create(path, record) as session:
        session.set_setup(SETUP.read_text("utf-8"))
        session.calibrate_laser([13.676], [18.561], [7.874])
        picture = cv2.imencode(".png", pictures(1)[0])[1].tobytes()
        sha256 = hashlib.sha256(picture).hexdigest()
        with session._database.transaction() as connection:
            row = (sha256, "target.png", picture)
            connection.execute("INSERT INTO picture VALUES (?, ?, ?)", row)
        plane = PlaneCalibration(
            (44.0, 590.0), (242.0, 588.0), 34.9, (43.0, 500.0), 15.9, (0.1, 0.1, 0.1), 90.0
        )
        session._documents.change(
            "plane", {("plane-calibration", -1): PlanePicture(6.35, plane, sha256)}
        )
        readings = (("13,7", "", "x"), ("", "18.5", ""))
        cross = CrossPicture(sha256, tuple((20.0 * k, 9.5) for k in range(6)), 25.0)
        session.set_entries("laser", LaserEntries(readings, 10.0, 0.1, 0.02, sha256, cross))
        moved = replace(plane, origin_px=(45.0, 590.0))
        session.set_entries("plane", PlanePicture(6.35, moved, sha256, (sha256,)))
        mirror = MirrorEntry("cap.png", "cap", 0.91, 9.75, 0.01, None, sha256)
        session.set_entries("bench", BenchEntries((mirror,)))
        session.import_recording(recording, ":5", frame_rate_hz=100.0, embed=embed)
        correction = Correction(dots_of(1), lattice_of(), np.arange(12) < 3)
        session.correct({1: correction, 2: correction})
        for frame in range(4):
            keep(session, frame, measurement_of(frame), "fit")
            keep(session, frame, measurement_of(frame, "ers"), "ers")
        keep(session, 3, Measurement("no-dots", "dark", "fit"), "fit")
        session.set_settings(Settings(scheme="ers"), "try ERS")
        session.set_record(replace(record, notes="x" * 2000))
        session.correct({3: correction})
        session.undo()
        session.undo()
        session.undo()
    return path


def _new_session(folder: Path) -> Path:
    folder.mkdir()
    with Session.create(folder / "new.labsession") as session:
        session.update_setup({"laser": {"distance_mm": 30.0}})
    return folder / "new.labsession"


def hot_journal(path: Path) -> None:
    """Leave the journal of an interrupted change beside a session, with half of the change."""
    copy = path.with_name("away.labsession")
    journal = Path(f"{copy}-journal")
    copy.write_bytes(path.read_bytes())
    connection = sqlite3.connect(copy, isolation_level=None)
    connection.execute("PRAGMA cache_size = 1")  # written before it is finished
    connection.execute("BEGIN IMMEDIATE")
    connection.execute("UPDATE change SET label = label || 'xxxxxxxxxxxxxxxx'")
    connection.execute("UPDATE document SET content = zeroblob(3000)")
    content, journal_content = copy.read_bytes(), journal.read_bytes()
    connection.execute("ROLLBACK")
    connection.close()
    copy.unlink()
    path.write_bytes(content)
    Path(f"{path}-journal").write_bytes(journal_content)


def _setups(folder: Path) -> tuple[Path, ...]:
    folder.mkdir()
    text = SETUP.read_text("utf-8")
    points = text[text.index("origin_px") :]
    matrix = "homography = [[0.17, 0.0, -7.0], [0.0, -0.17, 104.0], [0.0, 0.0, 1.0]]\n"
    full = text.replace("[electrode]", "absent = [[10, 10], [3, 4]]\n[electrode]")
    full = full.replace("height_mm = 101.6", "height_mm = 101.6\npitch_deg = 1.0\nyaw_deg = -2")
    contents = {"three_points": text, "homography": full.replace(points, matrix)}
    for name, content in contents.items():
        (folder / f"{name}.toml").write_text(content, "utf-8")
    return tuple(folder / f"{name}.toml" for name in contents)


def _recordings(folder: Path) -> tuple[Path, ...]:
    """Return the imported file of a recording of each format, each in its own folder."""

    def new_folder(name: str) -> Path:
        (folder / name).mkdir()
        return folder / name

    eight, sixteen = pictures(12), pictures(6, np.uint16)
    paths = [
        _encoded(new_folder("avi-ffv1") / "run.avi", eight, "-c:v ffv1 -g 4"),
        _encoded(new_folder("mkv-ffv1") / "run.mkv", eight, "-c:v ffv1 -slicecrc 1"),
        _encoded(new_folder("avi-mjpg") / "run.avi", eight, "-c:v mjpeg -q:v 3 -pix_fmt yuvj420p"),
        _encoded(new_folder("mp4-h264") / "run.mp4", eight, "-c:v libx264 -g 5 -pix_fmt yuv420p"),
        _encoded(new_folder("mkv-h264") / "run.mkv", eight, "-c:v libx264 -g 5 -pix_fmt yuv420p"),
        new_folder("tiff") / "run.tif",
        new_folder("tiff-zlib") / "run.tiff",
        write_cine(new_folder("cine") / "run.cine", eight, times=[k / 1000 for k in range(12)]),
        write_cine(new_folder("cine-packed") / "run.cine", sixteen, compression=256, RealBPP=10),
        write_photron(new_folder("photron"), sixteen, 12),
        write_photron(new_folder("photron-cih"), eight, 8, suffix=".cih"),
        new_folder("npy") / "run.npy",
        new_folder("npz") / "run.npz",
        new_folder("images"),
    ]
    tifffile.imwrite(paths[5], np.stack(sixteen), photometric="minisblack")
    tifffile.imwrite(paths[6], np.stack(eight), photometric="minisblack", compression="zlib")
    np.save(paths[11], np.stack(sixteen))
    np.savez_compressed(paths[12], frames=np.stack(eight))
    for k, picture in enumerate(eight[:4]):
        cv2.imwrite(str(paths[13] / f"frame{k}.png"), picture)
    return tuple(paths)


def _encoded(path: Path, frames: list[np.ndarray], options: str) -> Path:
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-f", "rawvideo"]
    command += ["-pix_fmt", "gray", "-s", f"{SHAPE[1]}x{SHAPE[0]}", "-r", "60", "-i", "-"]
    content = b"".join(frame.tobytes() for frame in frames)
    subprocess.run([*command, *options.split(), os.fspath(path)], input=content, check=True)
    return path


def _tables(folder: Path) -> tuple[Path, ...]:
    folder.mkdir()
    dots, lattice = dots_of(1), lattice_of()
    names = ["frame", "u_px", "v_px", "reflected_row", "reflected_column", "blocked", "source"]
    paths = []
    for name, separator in (("comma", ","), ("semicolon", ";"), ("tab", "\t")):
        text = io.StringIO()
        writer = csv.writer(text, delimiter=separator)
        writer.writerow(names)
        for k in range(len(dots)):
            blocked = int(lattice.row[k] == 3)
            position = [f"{dots.u_px[k]:.4f}", f"{dots.v_px[k]:.4f}"]
            writer.writerow([1, *position, lattice.row[k], lattice.column[k], blocked, "auto"])
        path = folder / f"{name}.csv"
        path.write_text(text.getvalue(), "utf-8")
        paths.append(path)
    return tuple(paths)


def _export(folder: Path) -> Path:
    from labapp.config.setup import read_setup

    measured = [FrameResult(k, k / 100, measurement_of(k)) for k in range(2)]
    choice = ExportChoice(surfaces=frozenset({"csv", "stl"}), spacing_mm=0.5)
    about = {"source": {"path": "v.avi"}}
    export(folder, measured, read_setup(SETUP).calibration, about, choice)
    return folder / "manifest.json"
