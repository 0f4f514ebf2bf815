from __future__ import annotations

import dataclasses
import functools
import hashlib
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from labapp.core.geometry.rig import DotPattern, Electrode, ImagingPlane, Laser, Rig
from labapp.core.images.dots import Dots
from labapp.core.lines.surface import LineSurface
from labapp.core.pipeline import Measurement, Settings
from labapp.core.surface.boundary import Boundary
from labapp.core.surface.interpolation import CloughTocherSurface, ThinPlateSurface
from labapp.core.surface.spline import SplineBasis, SplineSurface
from labapp.errors import InputError
from labapp.session.file.blobs import (
    HEAD,
    MAGIC,
    Damaged,
    fingerprint,
    fingerprint_of,
    pack,
    unpack,
)
from tests.scripts import peak_mb

plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.lists(inner).map(tuple) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


def same(one: object, other: object) -> bool:
    """Whether two values are equal to the bit, NaN included."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        assert isinstance(other, np.ndarray)
        return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    if isinstance(one, float):
        return repr(one) == repr(other)
    if isinstance(one, dict):
        assert isinstance(other, dict)
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        assert isinstance(other, list | tuple)
        return len(one) == len(other) and all(map(same, one, other))
    if dataclasses.is_dataclass(one):
        names = [field.name for field in dataclasses.fields(one)]
        return all(same(getattr(one, name), getattr(other, name)) for name in names)
    return one == other


@given(plain)
def test_plain_values_are_restored(value: object):
    assert same(unpack(pack(value)), value)


@given(hnp.arrays(hnp.scalar_dtypes(), hnp.array_shapes(min_dims=0, min_side=0)))
def test_arrays_are_restored_exactly_and_read_only(array: np.ndarray):
    restored = unpack(pack(array))
    assert same(restored, array)
    assert not restored.flags.writeable


@given(st.binary())
def test_bytes_are_restored(content: bytes):
    assert unpack(pack([content, content])) == [content, content]


def test_rig_is_restored():
    rig = Rig(
        Laser(31.14, 31.48),
        DotPattern(absent=frozenset({(10, 10), (3, 4)})),
        Electrode(5.0),
        ImagingPlane.vertical(50.0, 45.0, 3.0),
    )
    assert same(unpack(pack(rig)), rig)
    assert unpack(pack(Settings(scheme="ers"))) == Settings(scheme="ers")


@pytest.mark.parametrize("kind", [CloughTocherSurface, ThinPlateSurface])
def test_surfaces_are_restored(kind: type):
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-3, 3, (60, 2)), rng.uniform(0, 0.3, 60)])
    large_surface = kind(points)
    x, y = rng.uniform(-4, 4, (2, 50))
    restored = unpack(pack(large_surface))
    np.testing.assert_array_equal(restored.height(x, y), large_surface.height(x, y))


def test_spline_surface_is_restored():
    rng = np.random.default_rng(6)
    basis = SplineBasis.over(np.array([-3.0, -4.0]), np.array([3.0, 4.0]), 0.7)
    large_surface = SplineSurface(basis, rng.normal(size=np.prod(basis.shape)))
    assert same(unpack(pack(large_surface)), large_surface)


@pytest.mark.parametrize(
    ("size", "others"), [(0, (0, 0)), (0, (2, 0)), (-1, (0, 0)), (0, (1, -1)), (0, (1, 1))]
)
def test_surface_of_lines_has_a_covariance_of_its_coefficients(size: int, others: tuple[int, int]):
    basis = SplineBasis.over(np.zeros(2), np.full(2, 3.0), 0.9)
    surface = LineSurface(
        SplineSurface(basis, np.zeros(basis.count)),
        np.eye(basis.count + size),
        np.arange(3),
        np.zeros((4, 3)),
        0.1,
        10.0,
        "ok",
        renumbered=np.zeros((others[0], others[0] and basis.count + others[1])),
    )
    if size or others[1]:
        with pytest.raises(Damaged):
            unpack(pack(surface))
    else:
        assert same(unpack(pack(surface)), surface)


def test_measurement_without_a_surface_is_restored(unmeasured: Measurement):
    assert same(unpack(pack(unmeasured)), unmeasured)


def test_fingerprints_are_equal_only_for_equal_values():
    dots = Dots(*np.arange(7.0).reshape(7, 1))
    assert fingerprint(dots) == fingerprint(unpack(pack(dots)))
    assert fingerprint(dots) != fingerprint(dataclasses.replace(dots, peak=dots.peak + 1e-9))


def test_missing_field_of_an_earlier_version_has_its_default():
    """The blob lacks fields, as if an earlier labapp had written it."""
    tree = b'{"Settings":{"scheme":"ers"}}'
    body = zlib.compress(len(tree).to_bytes(4, "little") + tree)
    blob = HEAD.pack(MAGIC, zlib.crc32(body)) + body
    assert unpack(blob) == Settings(scheme="ers")
    written = hashlib.sha256(len(tree).to_bytes(4, "little") + tree).hexdigest()
    assert fingerprint_of(blob) == written != fingerprint(unpack(blob))
    assert fingerprint_of(pack(unpack(blob))) == fingerprint(unpack(blob))


def test_unknown_names_of_a_later_version_are_rejected():
    for tree in (b'{"Settings":{"colour":"red"}}', b'{"NewThing":{}}', b'{"list":1}', b"[1]"):
        body = zlib.compress(len(tree).to_bytes(4, "little") + tree)
        with pytest.raises(Damaged):
            unpack(HEAD.pack(MAGIC, zlib.crc32(body)) + body)


def blob_of(tree: bytes, arrays: bytes = b"") -> bytes:
    """Return a forged blob with a valid checksum."""
    body = zlib.compress(len(tree).to_bytes(4, "little") + tree + arrays, 9)
    return HEAD.pack(MAGIC, zlib.crc32(body)) + body


def repeated_arrays() -> bytes:
    array = b'{"array":["|u1",[60000000],0]}'
    return blob_of(b'{"list":[' + b",".join([array] * 50) + b"]}", bytes(60_000_000))


def repeated_bytes() -> bytes:
    return blob_of(
        b'{"list":[' + b",".join([b'{"bytes":[0,60000000]}'] * 50) + b"]}", bytes(60_000_000)
    )


def empty_lists() -> bytes:
    return blob_of(b'{"list":[' + b",".join([b'{"list":[]}'] * 8_000_000) + b"]}")


def array_of_a_long_type() -> bytes:
    return blob_of(
        b'{"list":[' + b",".join([b'{"array":["|V60000000",[1],0]}'] * 50) + b"]}",
        bytes(60_000_000),
    )


def large_surface(kind: str) -> bytes:
    points = np.random.default_rng(7).uniform(-3, 3, (12_000, 3))
    tree = b'{"%s":{"array":["<f8",[12000,3],0]}}' % kind.encode()
    return blob_of(tree, points.tobytes())


def test_surfaces_of_a_blob_share_the_limit_of_points():
    """Each surface takes seconds and hundreds of megabytes, and many may refer to one array."""
    points = np.random.default_rng(7).uniform(-3, 3, (1500, 3))
    thin_plate = b'{"ThinPlateSurface":{"array":["<f8",[1500,3],0]}}'
    assert (
        len(unpack(blob_of(b'{"list":[%s]}' % b",".join([thin_plate] * 2), points.tobytes()))) == 2
    )
    with pytest.raises(Damaged, match="4000 points"):
        unpack(blob_of(b'{"list":[%s]}' % b",".join([thin_plate] * 3), points.tobytes()))


@pytest.mark.parametrize(
    "forge",
    [repeated_arrays, repeated_bytes, empty_lists, array_of_a_long_type]
    + [
        functools.partial(large_surface, kind)
        for kind in ("ThinPlateSurface", "CloughTocherSurface")
    ],
    ids=["arrays", "bytes", "lists", "type", "thin plate", "triangles"],
)
def test_blob_that_would_fill_the_memory_is_rejected(tmp_path: Path, forge: Callable[[], bytes]):
    (tmp_path / "blob").write_bytes(forge())
    script = """
        import sys
        from pathlib import Path
        from labapp.session.file.blobs import Damaged, unpack
        try:
            unpack(Path(sys.argv[1]).read_bytes())
            sys.exit("it was unpacked")
        except Damaged:
            pass
    """
    assert peak_mb(script, tmp_path / "blob") < 700


def test_value_too_large_to_be_read_is_not_packed():
    with pytest.raises(InputError, match="8000000 bytes or less"):
        pack("x" * 9_000_000)
    with pytest.raises(InputError, match="100000000 bytes or less"):
        pack([np.arange(20_000_000.0)])


def test_every_changed_byte_is_detected():
    blob = pack(Boundary(np.zeros(2), np.zeros(4), np.zeros((4, 3))))
    for index in range(len(blob)):
        changed = bytearray(blob)
        changed[index] ^= 0x10
        with pytest.raises(Damaged):
            unpack(bytes(changed))
    for length in range(len(blob)):
        with pytest.raises(Damaged):
            unpack(blob[:length])


def test_other_classes_are_rejected():
    with pytest.raises(TypeError, match="Path"):
        pack(Path("a"))
    with pytest.raises(TypeError, match="objects"):
        pack(np.array([{}]))
