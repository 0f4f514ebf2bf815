"""Bit-exact serialisation of values: the blobs of the session file.

A blob is ``LAB1``, the CRC-32 of what follows, and the compressed value: a JSON tree of plain
values, which refers by offsets to the arrays after it. Nothing in a blob is ever executed, and
changed bytes are detected.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from labapp.core.surface.interpolation import CloughTocherSurface, ThinPlateSurface
from labapp.core.surface.reconstruction import BoundedSurface
from labapp.core.surface.surface import FlatSurface
from labapp.core.values import CannotMeasure, FloatArray
from labapp.errors import InputError
from labapp.session.file.kinds import check_fields, is_a
from labapp.session.file.stored import NAMES, STORED

MAGIC = b"LAB1"
HEAD = struct.Struct("<4sI")

SURFACES: dict[str, tuple[Any, str, Any, tuple[int, ...]]] = {
    "CloughTocherSurface": (CloughTocherSurface, "points_mm", FloatArray, (3,)),
    "ThinPlateSurface": (ThinPlateSurface, "points_mm", FloatArray, (3,)),
    "FlatSurface": (FlatSurface, "level_mm", float, ()),
}
"""Surfaces that are not dataclasses: class, its argument, the argument's type and shape."""

SURFACE_NAMES = {made: name for name, (made, *_) in SURFACES.items()}

LARGEST = 100_000_000
"""Limit of an unpacked value, and of all its arrays, bytes; a small blob could fill the memory.

Each reference to a stored array becomes a separate array.
"""

LARGEST_TREE = 8_000_000
"""Limit of the JSON part, bytes: two bytes may become a list of sixty bytes."""

MOST_SURFACE_POINTS = 4000
"""Most points of all surfaces of a value: a thin-plate system grows with their square."""

UNREADABLE = (
    *(zlib.error, ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError),
    *(RecursionError, MemoryError, CannotMeasure),
)

CONTAINERS: dict[str, Any] = {kind.__name__: kind for kind in (list, tuple, frozenset)}


class Damaged(ValueError):
    """Stored bytes are damaged."""


def pack(value: object) -> bytes:
    """Serialise a value: plain values, arrays, containers of them, and the classes of `STORED`.

    Raises
    ------
    TypeError
        If it contains a value of another class.
    InputError
        If it is larger than `LARGEST`, or its JSON part than `LARGEST_TREE`.
    """
    content = _canonical(value)
    tree = int.from_bytes(content[:4], "little")
    for size, most in ((len(content), LARGEST), (tree, LARGEST_TREE)):
        if size > most:
            raise InputError("session", "value", f"{size} bytes", f"{most} bytes or less")
    body = zlib.compress(content, 1)
    return HEAD.pack(MAGIC, zlib.crc32(body)) + body


def unpack(blob: object, kind: Any = Any) -> Any:
    """Deserialise the result of `pack`, of a class or type, with read-only arrays.

    Raises
    ------
    Damaged
        If the bytes were changed or truncated, or contain another type, an unknown class, or one
        with invalid fields.
    """
    if not isinstance(blob, bytes):
        raise Damaged("it is no blob")
    if len(blob) < HEAD.size or HEAD.unpack_from(blob) != (MAGIC, zlib.crc32(blob[HEAD.size :])):
        raise Damaged("its checksum does not fit")
    try:
        content = _decompressed(blob[HEAD.size :])
        length = int.from_bytes(content[:4], "little")
        if length > LARGEST_TREE:
            raise ValueError("it is too large")
        tree = json.loads(content[4 : 4 + length])
        value = _Reader(memoryview(content)[4 + length :]).read(tree)
    except UNREADABLE as error:
        is_plain = isinstance(error, ValueError | CannotMeasure)
        reason = error if is_plain else "it is not as labapp writes it"
        raise Damaged(f"it cannot be read: {reason}") from error
    if not is_a(value, kind):
        raise Damaged(f"it is a {type(value).__name__}")
    return value


def unpack_from(path: Path, named: str, blob: object, kind: Any) -> Any:
    """`unpack` a value of a session file; errors have its name.

    Raises
    ------
    InputError
        If it is damaged.
    """
    with damage_as_input(path, named):
        return unpack(blob, kind)


@contextmanager
def damage_as_input(path: Path, named: str) -> Iterator[None]:
    """Convert `Damaged` raised in the block to an `InputError` about a value of a session file."""
    try:
        yield
    except Damaged as error:
        raise InputError(path, named, error, "what was written there") from error


def _decompressed(content: bytes) -> bytes:
    unpacker = zlib.decompressobj()
    plain = unpacker.decompress(content, LARGEST)
    if not unpacker.eof or unpacker.unused_data:
        raise ValueError("it is cut off, or too large")
    return plain


def fingerprint(value: object) -> str:
    """Return the SHA-256 of a value; equal values have equal fingerprints."""
    return hashlib.sha256(_canonical(value)).hexdigest()


def fingerprint_of(blob: bytes) -> str:
    """Return the `fingerprint` at the time of packing, not changed by fields added since.

    Raises
    ------
    Damaged
        If the bytes were changed.
    """
    unpack(blob)
    return hashlib.sha256(_decompressed(blob[HEAD.size :])).hexdigest()


def _canonical(value: object) -> bytes:
    arrays: dict[bytes, int] = {}
    tree = json.dumps(_tree(value, arrays), separators=(",", ":")).encode()
    return b"".join([len(tree).to_bytes(4, "little"), tree, *arrays])


def _tree(value: object, arrays: dict[bytes, int]) -> object:
    """Return the JSON tree of a value; adds its arrays to ``arrays``, bytes → offset."""
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
    if isinstance(value, BoundedSurface):
        value = value.unbounded  # the reconstruction stores the boundary
    if type(value) in SURFACE_NAMES:
        name = SURFACE_NAMES[type(value)]
        return {name: _tree(getattr(value, SURFACES[name][1]), arrays)}
    if type(value) not in NAMES:
        raise TypeError(f"a {type(value).__qualname__} cannot be kept in a session")
    name = NAMES[type(value)]
    fields = STORED[name].names().items()
    return {name: {theirs: _tree(getattr(value, ours), arrays) for theirs, ours in fields}}


def _place(array: npt.NDArray[Any], arrays: dict[bytes, int]) -> int:
    if array.dtype.hasobject:
        raise TypeError("an array of objects cannot be kept in a session")
    content = array.tobytes()
    if content not in arrays:
        arrays[content] = sum(map(len, arrays))
    return arrays[content]


class _Reader:
    """Builds a value from its JSON tree and the bytes of its arrays, within limits."""

    def __init__(self, content: memoryview) -> None:
        self._content = content
        self._left = LARGEST
        self._points_left = MOST_SURFACE_POINTS

    def read(self, tree: Any) -> Any:
        if not isinstance(tree, dict):
            if isinstance(tree, list):
                raise TypeError("a bare list")
            return tree
        ((kind, held),) = tree.items()
        if kind == "array":
            return self._array(*held)
        if kind == "bytes":
            place, length = held
            found = self._content[place : place + length]
            self._take(len(found))
            return bytes(found)
        if kind in CONTAINERS:
            return CONTAINERS[kind](self.read(item) for item in held)
        if kind == "dict":
            return {key: self.read(item) for key, item in held}
        if kind in SURFACES:
            return self._surface(kind, self.read(held))
        if kind not in STORED:
            raise ValueError(f"it was written by a labapp with other settings or schemes: {kind!r}")
        stored = STORED[kind]
        fields = {
            stored.renamed.get(name, name): self.read(item)
            for name, item in held.items()
            if name not in stored.retired
        }
        value = stored.kind(**fields)
        check_fields(value, stored.shapes)
        if not stored.fits(value):
            raise TypeError(f"the fields of {kind} do not fit each other")
        return value

    def _take(self, size: int) -> None:
        self._left -= size
        if self._left < 0:
            raise ValueError(f"its arrays take more than {LARGEST} bytes")

    def _array(self, dtype: Any, shape: Any, place: Any) -> npt.NDArray[Any]:
        if not (isinstance(dtype, str) and all(isinstance(n, int) and n >= 0 for n in shape)):
            raise TypeError(f"an array of {dtype}, {shape}")
        count = math.prod(shape)
        self._take(count * np.dtype(dtype).itemsize)
        found = np.frombuffer(self._content, dtype, count, place) if count else np.empty(0, dtype)
        array = found.reshape(shape).copy()  # aligned, without a reference to the content
        array.flags.writeable = False
        return array

    def _surface(self, kind: str, argument: Any) -> Any:
        surface, _, hint, shape = SURFACES[kind]
        if not is_a(argument, hint) or (shape and np.shape(argument)[1:] != shape):
            raise TypeError(f"a {kind} of a {type(argument).__name__}")
        self._points_left -= len(argument) if shape else 0
        if self._points_left < 0:
            raise ValueError(f"its surfaces have more than {MOST_SURFACE_POINTS} points")
        return surface(argument)
