from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from labapp.errors import InputError
from labapp.media import open_source
from tests.media.mutate import survives_damage
from tests.scripts import peak_mb

RNG = np.random.default_rng(13)
GREY = RNG.integers(0, 256, (6, 9, 13), np.uint8)
COLOUR = RNG.integers(0, 256, (3, 9, 13, 3), np.uint8)


def save(path: Path, array: np.ndarray) -> Path:
    np.save(path, array)
    return path


@pytest.mark.parametrize("kind", ["u1", "<u2", ">u2"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_every_frame_equals_the_saved_one(tmp_path: Path, kind: str, order: str) -> None:
    stack = np.array(GREY.astype(kind) * (1 if kind == "u1" else 251), order=order)
    with open_source(save(tmp_path / "run.npy", stack)) as source:
        assert (len(source), source.shape) == (6, (9, 13))
        assert source.bit_depth == (8 if kind == "u1" else 16)
        assert source.frame_rate_hz is None
        assert source.warnings == ()
        for k in (5, 0, 3, 3):
            frame = source.frame(k)
            assert frame.image.dtype == stack.dtype.newbyteorder("=")
            np.testing.assert_array_equal(frame.image, stack[k])
            assert frame.time_s is None
        with pytest.raises(IndexError):
            source.frame(6)
    assert source.description.startswith("NumPy stack, 13×9 px")


def test_colour_is_red_green_blue(tmp_path: Path) -> None:
    expected = COLOUR @ [0.299, 0.587, 0.114]
    alpha = np.full((3, 9, 13, 1), 9, np.uint8)
    for stack in (COLOUR, np.concatenate([COLOUR, alpha], axis=3)):
        with open_source(save(tmp_path / "run.npy", stack)) as source:
            for frame in source:
                np.testing.assert_allclose(frame.image, expected[frame.index], atol=0.6)


@pytest.mark.parametrize("kind", [np.int16, np.uint32, np.float16, np.float64])
def test_other_types_become_float32(tmp_path: Path, kind: type) -> None:
    with open_source(save(tmp_path / "run.npy", GREY.astype(kind))) as source:
        assert source.bit_depth == 32
        assert source.frame(2).image.dtype == np.float32
        np.testing.assert_array_equal(source.frame(2).image, GREY[2])


def test_booleans_become_black_and_white(tmp_path: Path) -> None:
    with open_source(save(tmp_path / "run.npy", GREY > 99)) as source:
        assert source.bit_depth == 8
        np.testing.assert_array_equal(source.frame(1).image, np.where(GREY[1] > 99, 255, 0))


@pytest.mark.parametrize("write", [np.savez, np.savez_compressed])
def test_archive_may_contain_times(tmp_path: Path, write: object) -> None:
    path = tmp_path / "run.npz"
    times = np.array([3.0, 3.5, 4.0, 4.5, 5.0, 5.75])
    write(path, frames=GREY, other=COLOUR, time_s=times)
    with open_source(path) as source:
        np.testing.assert_array_equal([frame.image for frame in source], GREY)
        np.testing.assert_array_equal([frame.time_s for frame in source], times - 3)
        assert source.frame_rate_hz == 2
    write(path, anything=GREY, frame_rate_hz=250.0)
    with open_source(path) as source:
        np.testing.assert_array_equal(source.frame(5).image, GREY[5])
        assert source.frame(5).time_s == 5 / 250
        assert source.description == "NumPy archive, 13×9 px, 8 bit grey, 250 frames/s"


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"a": GREY, "b": GREY}, "arrays: a, b; expected a .npz with an array"),
        ({}, "arrays: none"),
        ({"frames": GREY[0]}, r"shape: \(9, 13\)"),
        ({"frames": GREY, "time_s": np.arange(5)}, "time_s: shape .*; expected 6 increasing times"),
        ({"frames": GREY, "time_s": np.zeros(6)}, "expected 6 increasing times"),
        ({"frames": GREY, "time_s": np.zeros((6, 1))}, "one for every frame"),
        ({"frames": GREY, "frame_rate_hz": -2.0}, "frame_rate_hz: -2.0"),
        ({"frames": GREY, "frame_rate_hz": np.arange(2.0)}, "expected one number"),
        ({"frames": GREY, "frame_rate_hz": np.array("x")}, "type: .*an array of numbers"),
    ],
)
def test_wrong_arrays_of_an_archive_are_rejected(
    tmp_path: Path, arrays: dict[str, np.ndarray], message: str
) -> None:
    path = tmp_path / "run.npz"
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=message):
        open_source(path)


def test_archive_with_two_arrays_of_a_name_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    np.savez(path, frames=GREY)
    with zipfile.ZipFile(path) as archive:
        content = archive.read("frames.npy")
    with (
        zipfile.ZipFile(path, "a") as archive,
        pytest.warns(UserWarning, match="Duplicate name"),
    ):
        archive.writestr("frames.npy", content)
    with pytest.raises(InputError, match="arrays: frames twice"):
        open_source(path)


@pytest.mark.parametrize("write", [np.savez, np.savez_compressed])
def test_wrong_checksum_is_rejected(tmp_path: Path, write: object) -> None:
    """Only the checksum in the directory of the archive is changed."""
    path = tmp_path / "run.npz"
    write(path, frames=GREY)
    content = bytearray(path.read_bytes())
    entry = content.rindex(b"PK\x01\x02")
    content[entry + 16] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="Bad CRC-32"):
        open_source(path)


@pytest.mark.parametrize("grow", [1, 2_000_000])
def test_array_with_excess_bytes_is_rejected(tmp_path: Path, grow: int) -> None:
    path = tmp_path / "run.npz"
    array = io.BytesIO()
    np.save(array, GREY)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("frames.npy", array.getvalue() + bytes(grow))
    with pytest.raises(InputError, match=f"expected {GREY.nbytes} bytes"):
        open_source(path)


def test_compressed_array_that_would_fill_the_memory_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    header = {"descr": "|u1", "fortran_order": False, "shape": (2000, 1000, 1000)}
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("frames.npy", "w", force_zip64=True) as file,
    ):
        np.lib.format.write_array_header_1_0(file, header)
        for _ in range(2000):
            file.write(bytes(10**6))
    assert path.stat().st_size < 4e6
    script = """
        import sys
        from labapp.errors import InputError
        from labapp.media import open_source
        try:
            open_source(sys.argv[1])
        except InputError as error:
            assert "frames.npy: 2000000000 bytes, compressed" in str(error)
    """
    assert peak_mb(script, path) < 1000


@pytest.mark.parametrize("packed", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_unbounded_compression_methods_are_rejected(tmp_path: Path, packed: int) -> None:
    """zipfile would unpack a few kilobytes to gigabytes, whatever the stated size of the array."""
    path = tmp_path / "run.npz"
    array = io.BytesIO()
    np.save(array, GREY)
    with zipfile.ZipFile(path, "w", packed) as archive:
        archive.writestr("frames.npy", array.getvalue())
    with pytest.raises(InputError, match="packed by another program"):
        open_source(path)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.array([[[{}]]]), "no Python objects"),
        (GREY.astype(complex), "type: '<c16'"),
        (np.zeros((2, 3, 4), "S3"), "type: "),
        (np.zeros((2, 3, 4), [("a", "u1")]), "type: "),
        (GREY[0], r"shape: \(9, 13\); expected an array of shape"),
        (GREY[..., np.newaxis], "shape: "),
        (GREY[:0], "shape: "),
        (GREY[:, :0], "shape: "),
    ],
)
def test_invalid_stack_is_rejected(tmp_path: Path, array: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        open_source(save(tmp_path / "run.npy", array))


def test_nan_is_rejected_only_in_its_frame(tmp_path: Path) -> None:
    stack = GREY.astype(np.float32)
    stack[3, 2, 2] = np.nan
    with open_source(save(tmp_path / "run.npy", stack)) as source:
        np.testing.assert_array_equal(source.frame(2).image, GREY[2])
        with pytest.raises(InputError, match="NaN or infinity"):
            source.frame(3)


def test_truncated_stack_has_its_complete_frames(tmp_path: Path) -> None:
    path = save(tmp_path / "run.npy", GREY)
    content = path.read_bytes()
    path.write_bytes(content[: 128 + 117 * 4 + 50])
    with open_source(path) as source:
        assert source.warnings == (
            "run.npy ends early: its header says 6 frames, 4 of them complete",
        )
        np.testing.assert_array_equal([frame.image for frame in source], GREY[:4])
    path.write_bytes(content[:200])
    with pytest.raises(InputError, match="72 bytes of levels; expected 117 bytes or more"):
        open_source(path)
    path = save(tmp_path / "columns.npy", np.asfortranarray(GREY))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match="701 bytes of levels; expected 702"):
        open_source(path)


def test_impossible_shape_is_rejected(tmp_path: Path) -> None:
    path = save(tmp_path / "run.npy", GREY)
    content = path.read_bytes()
    path.write_bytes(content.replace(b"(6, 9, 13), }    ", b"(6, 99999, 13), }"))
    with pytest.raises(InputError, match="702 bytes of levels; expected 1299987"):
        open_source(path)


def test_damaged_files_are_read_or_rejected(tmp_path: Path) -> None:
    survives_damage(save(tmp_path / "run.npy", GREY), 200, 128, 5)
    for write in (np.savez, np.savez_compressed):
        path = tmp_path / f"{write.__name__}.npz"
        write(path, frames=GREY, time_s=np.arange(6.0))
        survives_damage(path, 200, 200, 6)
