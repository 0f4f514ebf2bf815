"""Values of the measurement as bytes, exactly, and back: what the session file holds.

A blob is ``LAB1``, the crc32 of what follows, and the compressed value: a JSON tree of plain
values in which arrays are named by their place behind it. Nothing in a blob is ever run, and bytes
that were changed are noticed.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import struct
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

from labapp.core import detection, dots, ers, irs, lattice, pool_fit, row_search, threshold_dots
from labapp.core.boundary import Boundary
from labapp.core.coordinates import ImageCalibration
from labapp.core.correction import Correction
from labapp.core.correspondence import Match, MatchSettings, Trial
from labapp.core.interpolation import CloughTocherSurface, ThinPlateSurface
from labapp.core.laser_calibration import LaserCalibration
from labapp.core.measures import Measures
from labapp.core.pipeline import Measurement, Settings
from labapp.core.plane_calibration import PlaneCalibration
from labapp.core.reconstruction import Reconstruction
from labapp.core.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.spline import SplineBasis, SplineSurface
from labapp.core.surface import FlatSurface
from labapp.session.record import LaserReadings, PlanePicture, Record, Recording

MAGIC = b"LAB1"
HEAD = struct.Struct("<4sI")

DATACLASSES: dict[str, Any] = {
    kind.__name__: kind
    for kind in (
        *(Boundary, Correction, dots.Dots, ImageCalibration, lattice.Lattice, LaserCalibration),
        *(LaserReadings, Match, Measurement, Measures, PlaneCalibration, PlanePicture, Record),
        *(Reconstruction, Recording, SplineBasis, SplineSurface, Trial),
        *(DotPattern, Electrode, ImagingPlane, Laser, Rig),
        *(Settings, MatchSettings, detection.DotSettings, detection.LatticeSettings),
        *(dots.BandPassSettings, threshold_dots.BlockThresholdSettings),
        *(threshold_dots.WaveletSettings, lattice.GrowSettings, row_search.RowSearchSettings),
        *(row_search.MaskRowsSettings, pool_fit.FitSettings, ers.ErsSettings, irs.IrsSettings),
    )
}

SURFACES: dict[str, tuple[Any, str]] = {
    "CloughTocherSurface": (CloughTocherSurface, "points_mm"),
    "ThinPlateSurface": (ThinPlateSurface, "points_mm"),
    "FlatSurface": (FlatSurface, "level_mm"),
}
"""Surfaces that are not dataclasses, and the one thing each is made from."""


CONTAINERS: dict[str, Any] = {kind.__name__: kind for kind in (list, tuple, frozenset)}


class Damaged(ValueError):
    """These bytes are not what was once written."""


def pack(value: object) -> bytes:
    """Bytes of a value: plain values, arrays, containers of them, and the classes above.

    Raises
    ------
    TypeError
        If a value of another class is in it.
    """
    body = zlib.compress(_canonical(value), 1)
    return HEAD.pack(MAGIC, zlib.crc32(body)) + body


def unpack(blob: bytes) -> Any:
    """The value that was packed; numbers and arrays bit for bit, arrays read-only.

    Raises
    ------
    Damaged
        If the bytes were changed, cut off, or hold a class that this version does not know.
    """
    if len(blob) < HEAD.size or HEAD.unpack_from(blob) != (MAGIC, zlib.crc32(blob[HEAD.size :])):
        raise Damaged("its checksum does not fit")
    try:
        content = zlib.decompress(blob[HEAD.size :])
        length = int.from_bytes(content[:4], "little")
        return _read(json.loads(content[4 : 4 + length]), memoryview(content)[4 + length :])
    except (zlib.error, ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
        raise Damaged(f"it cannot be read: {error}") from error


def fingerprint(value: object) -> str:
    """SHA-256 of a value: equal for equal values, whatever bytes they were read from."""
    return hashlib.sha256(_canonical(value)).hexdigest()


def _canonical(value: object) -> bytes:
    arrays: dict[bytes, int] = {}
    tree = json.dumps(_tree(value, arrays), separators=(",", ":")).encode()
    return b"".join([len(tree).to_bytes(4, "little"), tree, *arrays])


def _tree(value: object, arrays: dict[bytes, int]) -> object:
    """JSON of a value; its arrays go into ``arrays``, bytes → place, equal ones once."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return {"array": [value.dtype.str, list(value.shape), _place(value, arrays)]}
    if isinstance(value, bytes):
        return {"bytes": [_place(np.frombuffer(value, np.uint8), arrays), len(value)]}
    if isinstance(value, list | tuple | frozenset):
        items = sorted(value) if isinstance(value, frozenset) else value
        return {type(value).__name__: [_tree(item, arrays) for item in items]}
    if isinstance(value, dict):
        return {"dict": [[key, _tree(item, arrays)] for key, item in value.items()]}
    name = type(value).__name__
    if name in SURFACES:
        return {name: _tree(getattr(value, SURFACES[name][1]), arrays)}
    if DATACLASSES.get(name) is not type(value):
        raise TypeError(f"a {type(value).__qualname__} cannot be kept in a session")
    assert dataclasses.is_dataclass(value)
    return {
        name: {
            field.name: _tree(getattr(value, field.name), arrays)
            for field in dataclasses.fields(value)
        }
    }


def _place(array: npt.NDArray[Any], arrays: dict[bytes, int]) -> int:
    if array.dtype.hasobject:
        raise TypeError("an array of objects cannot be kept in a session")
    content = array.tobytes()
    if content not in arrays:
        arrays[content] = sum(map(len, arrays))
    return arrays[content]


def _read(tree: Any, content: memoryview) -> Any:
    if not isinstance(tree, dict):
        if isinstance(tree, list):
            raise TypeError("a bare list")
        return tree
    ((kind, held),) = tree.items()
    if kind == "array":
        dtype, shape, place = held
        count = int(np.prod(shape, dtype=int))
        array = np.frombuffer(content, dtype, count, place) if count else np.empty(0, dtype)
        array = array.reshape(shape).copy()  # aligned, and free of the rest
        array.flags.writeable = False
        return array
    if kind == "bytes":
        place, length = held
        return bytes(content[place : place + length])
    if kind in CONTAINERS:
        return CONTAINERS[kind](_read(item, content) for item in held)
    if kind == "dict":
        return {key: _read(item, content) for key, item in held}
    if kind in SURFACES:
        return SURFACES[kind][0](_read(held, content))
    return DATACLASSES[kind](**{name: _read(item, content) for name, item in held.items()})
