"""The files of the tour: a folder such as an operator would prepare."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

import cv2
import numpy as np

from labapp.config.setup import read_setup
from labapp.media import GreyImage
from labapp.session.copies import copy_sample
from labapp.session.samples import sample_folder
from labapp.simulation.camera import CameraView
from labapp.simulation.forward import trace
from labapp.simulation.outlined_pool import OutlinedPool
from labapp.simulation.render import Look, render

CROSS_MM = (4.65, 6.23, 2.75)
"""l₁, l₂, l₃ of the laser of the sample at a fan angle of 10°."""

PX_PER_MM = 30
CENTRE_PX = (320, 200)
SCALE_PX = ((120, 440), (420, 440))
"""Ends of the 10 mm scale in the picture of the cross."""


def lay_out(folder: Path) -> None:
    """Write the files that the tour opens into a folder.

    ``measurements`` has the set-up, recording, calibration pictures and logged table of a run;
    ``blocked`` has a session with frames that cannot be measured.

    Raises
    ------
    InputError
        If the samples are missing.
    """
    measurements = folder / "measurements"
    (measurements / "earlier").mkdir(parents=True)
    for name in ("setup.toml", "calibration.png", "recording.avi"):
        shutil.copyfile(sample_folder("gtaw") / name, measurements / name)
    cv2.imwrite(str(measurements / "cross_hair.png"), cross_hair())
    cv2.imwrite(str(measurements / "plate.png"), plate(measurements / "setup.toml"))
    blank = np.full((480, 640), 90, np.uint8)
    cv2.imwrite(str(measurements / "no_target.png"), blank)
    (measurements / "current.csv").write_text(logged(), "utf-8")
    (measurements / "damaged.labsession").write_text("no session", "utf-8")
    copy_sample("blocked_rows", folder / "blocked")


def cross_hair() -> GreyImage:
    """A picture of the cross hair with a 10 mm scale, from above, shape (480, 640)."""
    image = np.full((480, 640), 30, np.uint8)
    u, v = CENTRE_PX
    near, far, across = (round(length * PX_PER_MM) for length in CROSS_MM)
    cv2.line(image, (u, v - near), (u, v + far), 255, 5, cv2.LINE_AA)
    cv2.line(image, (u - across, v), (u + across, v), 255, 5, cv2.LINE_AA)
    (left, line), (right, _) = SCALE_PX
    cv2.rectangle(image, (left - 20, line), (right + 20, line + 34), 170, -1)
    for mm in range(11):
        at = left + mm * PX_PER_MM
        cv2.line(image, (at, line), (at, line + (22 if mm % 5 == 0 else 13)), 0, 2)
    return np.asarray(cv2.GaussianBlur(image, (5, 5), 0))


def plate(setup: Path) -> GreyImage:
    """The camera image of a flat plate in place of the workpiece, shape (640, 480)."""
    calibration = tomllib.loads(setup.read_text("utf-8"))["image_calibration"]
    points = {key: tuple(x) if isinstance(x, list) else x for key, x in calibration.items()}
    corners_mm = 30.0 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    mirror = OutlinedPool(lambda x, y: np.zeros_like(x), corners_mm)
    reflections = trace(mirror, read_setup(setup).rig)
    rng = np.random.default_rng(5)
    image = render(reflections, CameraView(**points), Look(glow=0.0), rng).image
    return np.asarray(image, np.uint8)


def places() -> dict[str, tuple[float, float]]:
    """Positions (u, v) of the ends of cross and scale in that picture by name, px."""
    u, v = CENTRE_PX
    near, far, across = (length * PX_PER_MM for length in CROSS_MM)
    return {
        "laser's side": (u, v - near),
        "far side": (u, v + far),
        "left": (u - across, v),
        "right": (u + across, v),
        "scale 1": SCALE_PX[0],
        "scale 2": SCALE_PX[1],
    }


def logged() -> str:
    """Logged time, current and voltage as CSV text."""
    time_s = np.arange(0.0, 0.5, 0.002)
    rng = np.random.default_rng(4)
    current = 75 + 4 * np.sin(2 * np.pi * 8 * time_s) + rng.normal(0, 0.4, len(time_s))
    voltage = 11.5 - 0.05 * (current - 75) + rng.normal(0, 0.05, len(time_s))
    table = zip(time_s, current, voltage, strict=True)
    lines = [f"{t:.3f},{i:.2f},{u:.3f}" for t, i, u in table]
    return "\n".join(["time_s,current_A,voltage_V", *lines]) + "\n"
