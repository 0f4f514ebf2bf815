"""A scenario: a pool on a bench in front of a camera (TOML), from which a recording is simulated.

It is a setup file with the additional tables [pool], [torch], [camera], [look] and [recording].
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from labapp.bundled import bundled
from labapp.config.scenario_keys import RECORDINGS, SHAPES, TABLES, TERMS, pool_rules
from labapp.config.setup import parse_setup
from labapp.config.setup_keys import SECTIONS
from labapp.config.setup_text import points_of
from labapp.config.toml_keys import check_keys, parse_toml, read_text, unknown_key
from labapp.core.geometry.rig import Rig
from labapp.core.values import FloatArray
from labapp.errors import InputError, unknown_name
from labapp.simulation.camera import CameraView, Lens
from labapp.simulation.pools import Dent, Footprint, LowRear, Pool, Term, Wave
from labapp.simulation.recording import Recording, TruePool
from labapp.simulation.render import Look
from labapp.simulation.surface_files import read_pool
from labapp.simulation.torch import ConeTorch

A_SCENARIO = "a scenario (TOML, UTF-8)"

OPTIONAL = ("torch", "camera", "look")

SLOWEST_VIDEO_HZ, FASTEST_VIDEO_HZ = 0.01, 1000.0
"""Frame rates that FFmpeg stores in an AVI file; beyond, it drops frames and changes the rate."""

COURSE_HZ = (0.3, 3.0)
"""Range of the frequencies by which a pool's size fluctuates."""

SWINGS = 6
"""Minimum number of oscillations that make up a fluctuation."""


@dataclass(frozen=True)
class Scenario:
    """A valid scenario."""

    recording: Recording
    """The recording that it describes."""
    setup: str
    """The setup file of its bench, as text."""
    text: str
    """The scenario as read."""

    @property
    def title(self) -> str:
        """First comment of the file; empty without one."""
        first = self.text.partition("\n")[0]
        return first.lstrip("# ").rstrip(". \r") if first.startswith("#") else ""


def shipped_scenarios() -> list[Path]:
    """Scenarios that come with labapp."""
    return sorted(bundled("resources/simulations").glob("*.toml"))


def find_scenario(name: Path) -> Path:
    """Find the scenario of a command line: a file, or the name of one in labapp, such as "egg".

    Raises
    ------
    InputError
        If there is no such scenario.
    """
    shipped = {path.stem: path for path in shipped_scenarios()}
    if name.is_file() or name.suffix or name.parent != Path():
        return name
    if str(name) not in shipped:
        raise unknown_name("SCENARIO", "scenario", str(name), [*shipped, "a scenario file"])
    return shipped[str(name)]


def read_scenario(
    path: str | os.PathLike[str], frames: int | None = None, seed: int | None = None
) -> Scenario:
    """Read and check a scenario.

    Parameters
    ----------
    path
        The file. A surface that it names is searched in the same folder.
    frames, seed
        Values that replace those of the file.

    Raises
    ------
    InputError
        If the file, or a surface that it names, cannot be read or anything in it is unknown,
        missing or impossible; all problems are reported together (`InputError.problems`).
    """
    path = Path(path)
    text = read_text(path, A_SCENARIO)
    values = parse_toml(text, path, A_SCENARIO)
    values, torch = _without_travel(values)
    bench = {
        table: keys for table, keys in values.items() if table in SECTIONS and table != "torch"
    }
    bench |= torch
    setup = tomlkit.dumps(bench)
    problems = _check(path, values)
    try:
        rig = parse_setup(setup, path).rig
    except InputError as error:
        problems = [*error.problems, *problems]
    calibration = bench.get("image_calibration")
    if isinstance(calibration, dict) and "homography" in calibration:
        expected = "the three points, as no other camera is simulated"
        problems.append(InputError(path, "image_calibration", "a homography", expected))
    if "focal_px" in bench.get("camera_lens", {}):
        expected = "no such value, as the distortion is not simulated"
        problems.append(InputError(path, "camera_lens", "a lens", expected))
    if problems:
        raise InputError.gather(problems)
    recording = dict(values["recording"])
    recording |= {} if frames is None else {"frames": frames}
    recording |= {} if seed is None else {"seed": seed}
    made = _recording(path, {**values, "recording": recording}, rig)
    return Scenario(made, setup, text)


def _without_travel(values: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split [torch] into the simulation's keys (shape) and the set-up's keys (travel)."""
    keys = values.get("torch")
    if not isinstance(keys, dict) or "travel" not in keys:
        return values, {}
    rest = {key: value for key, value in keys.items() if key != "travel"}
    others = {table: keys for table, keys in values.items() if table != "torch"}
    return others | ({"torch": rest} if rest else {}), {"torch": {"travel": keys["travel"]}}


# --- validation ---------------------------------------------------------------------------------


def _check(path: Path, values: dict[str, Any]) -> list[InputError]:
    """Find unknown, missing and wrong keys of the tables that a set-up does not have."""
    known = {**SECTIONS, "pool": {}, **TABLES}
    problems = [unknown_key(path, table, known) for table in values if table not in known]
    problems += _check_pool(path, values.get("pool"))
    for table, rules in TABLES.items():
        keys = values.get(table, {} if table in OPTIONAL else None)
        if table not in OPTIONAL or table in values:
            problems += check_keys(path, table, keys, rules)
    return problems


def _check_pool(path: Path, keys: Any) -> list[InputError]:
    rules = pool_rules(keys) if isinstance(keys, dict) else pool_rules({})
    if isinstance(keys, dict) and str(keys.get("shape")) not in SHAPES:
        # Without the shape the other keys cannot be checked.
        return check_keys(path, "pool", {k: keys[k] for k in keys if k == "shape"}, rules)
    problems = check_keys(path, "pool", keys, rules)
    if not isinstance(keys, dict):
        return problems
    for name in TERMS.keys() & rules.keys():
        for n, term in enumerate(_several(keys.get(name))):
            full = f"pool.{name}[{n}]" if isinstance(keys[name], list) else f"pool.{name}"
            problems += check_keys(path, full, term, TERMS[name], f"[[pool.{name}]]")
    return problems


def _several(terms: Any) -> list[Any]:
    """Tables, given as a list or as a single table; other values were already reported."""
    if isinstance(terms, dict):
        return [terms]
    return terms if isinstance(terms, list) else []


# --- construction -------------------------------------------------------------------------------


def _recording(path: Path, values: dict[str, Any], rig: Rig) -> Recording:
    wanted = values["recording"]
    rate, exposure_s = wanted["frame_rate_hz"], wanted.get("exposure_ms", 0) / 1000
    if exposure_s * rate > 1:
        expected = f"at most {1000 / rate:.6g} (ms), the time between frames"
        raise InputError(path, "recording.exposure_ms", wanted["exposure_ms"], expected)
    # Plus 0, as NumPy draws no noise of a standard deviation of −0.
    look = Look(**{key: value + 0 for key, value in values.get("look", {}).items()})
    if look.dot_floor_mm > look.dot_ceiling_mm:
        expected = f"a number up to look.dot_ceiling_mm, {look.dot_ceiling_mm:g} (mm)"
        raise InputError(path, "look.dot_floor_mm", look.dot_floor_mm, expected)
    form = wanted.get("format", "avi")
    if form == "avi" and look.bits != 8:
        expected = '8 in a video; recording.format = "tif" or "png" holds more'
        raise InputError(path, "look.bits", look.bits, expected)
    if form == "avi" and not SLOWEST_VIDEO_HZ <= rate <= FASTEST_VIDEO_HZ:
        allowed = f"{SLOWEST_VIDEO_HZ:g} to {FASTEST_VIDEO_HZ:g} (Hz) in a video"
        expected = f'{allowed}; recording.format = "tif" or "png" for other rates'
        raise InputError(path, "recording.frame_rate_hz", rate, expected)
    frames = wanted["frames"]
    torches = (_torch(values["torch"]),) * frames if "torch" in values else ()
    times_s = np.arange(frames) / rate
    return Recording(
        file=RECORDINGS[form],
        rig=rig,
        view=_view(path, values["image_calibration"], values.get("camera", {})),
        look=look,
        pools=_pools(path, values["pool"], times_s, wanted["seed"], rig.head_sign),
        seed=wanted["seed"],
        frame_rate_hz=float(rate),
        exposure_s=exposure_s,
        torches=torches,
    )


def _torch(keys: dict[str, Any]) -> ConeTorch:
    return ConeTorch(**{**keys, "tip_mm": tuple(keys["tip_mm"])})


def _view(path: Path, calibration: dict[str, Any], camera: dict[str, Any]) -> CameraView:
    size: dict[str, Any] = {key: camera[key] for key in ("width_px", "height_px") if key in camera}
    bent = {key: camera[key] for key in camera if key not in size}
    if bent and "focal_px" not in bent:
        expected = "a number from 10 to 1e+06 (px), which the coefficients refer to"
        raise InputError(path, "camera.focal_px", "missing", expected)
    points: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in points_of(calibration).items()
    }
    try:
        return CameraView(**points, **size, lens=Lens(**bent) if bent else None)
    except ValueError as error:
        raise InputError(path, "camera", error, "smaller k1, k2, p1, p2, k3") from error


def _pools(
    path: Path, keys: dict[str, Any], times_s: FloatArray, seed: int, head_sign: int
) -> tuple[TruePool, ...]:
    if keys["shape"] == "surface":
        surface = read_pool(
            path.parent / keys["file"],
            keys.get("spacing_mm"),
            tuple(keys.get("center_mm", (0.0, 0.0))),
            np.array(keys["outline_mm"], float) if "outline_mm" in keys else None,
        )
        return (surface,) * len(times_s)
    try:
        terms = _terms(keys, head_sign)
        pool = Pool(_footprint(keys, head_sign), keys["height_mm"], terms, keys.get("fullness"))
        sizes = 1 + keys.get("wander_percent", 0) / 100 * _course(times_s, seed)
        return tuple(
            pool.scaled(*size).after(time)
            for size, time in zip(sizes.tolist(), times_s.tolist(), strict=True)
        )
    except ValueError as error:
        raise InputError(path, "pool", error, "a possible pool") from error


def _footprint(keys: dict[str, Any], head_sign: int) -> Footprint:
    """Area of a pool; `Footprint` has its ends at +Y and −Y, wherever the head is."""
    width = keys["diameter_mm"] if keys["shape"] == "cap" else keys["width_mm"]
    half = keys.get("length_mm", width) / 2
    head, tail = keys.get("head_mm", half), keys.get("tail_mm", half)
    ahead, behind = (head, tail)[::head_sign]
    return Footprint(width, ahead, behind, tuple(keys.get("center_mm", (0.0, 0.0))))


def _terms(keys: dict[str, Any], head_sign: int) -> tuple[Term, ...]:
    dents = [
        Dent(**{**dent, "offset_mm": tuple(dent.get("offset_mm", (0.0, 0.0)))})
        for dent in _several(keys.get("dent"))
    ]
    waves = []
    for wave in _several(keys.get("wave")):
        given = {key: wave[key] for key in wave if key not in ("kind", "mode")}
        travelling = wave.get("kind") == "travelling"
        waves.append(Wave(tuple(wave["mode"]), **given, travelling=travelling))
    rears = [LowRear(**rear, towards=-head_sign) for rear in _several(keys.get("low_rear"))]
    return (*dents, *rears, *waves)


def _course(times_s: FloatArray, seed: int) -> FloatArray:
    """Three smooth random courses at the times, shape (n, 3): mean 0, standard deviation 1.

    Each is a sum of slow oscillations and does not depend on the number of frames.
    """
    rng = np.random.default_rng([seed, 3])
    hertz = rng.uniform(*COURSE_HZ, (SWINGS, 3))
    phase = rng.uniform(0, 2 * np.pi, (SWINGS, 3))
    swings = np.sin(2 * np.pi * hertz * times_s[:, None, None] + phase)
    return np.asarray(np.sqrt(2 / SWINGS) * swings.sum(axis=1))
