from __future__ import annotations

import struct
import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from labapp.errors import InputError
from labapp.media import open_source
from tests.media.cine_writer import write_cine
from tests.media.mutate import survives_damage

RNG = np.random.default_rng(11)
GREY_8 = [RNG.integers(0, 256, (14, 24), np.uint8) for _ in range(5)]
GREY_12 = [RNG.integers(0, 4096, (14, 24), np.uint16) for _ in range(5)]
COLOUR_8 = [RNG.integers(0, 256, (14, 24, 3), np.uint8) for _ in range(3)]


def images(path: Path) -> list[np.ndarray]:
    with open_source(path) as source:
        return [frame.image for frame in source]


@pytest.mark.parametrize(
    ("pictures", "compression", "bits"),
    [(GREY_8, 0, 8), (GREY_12, 0, 12), (GREY_12, 1024, 12)],
    ids=["8 bit", "12 of 16 bit", "packed 12 bit"],
)
def test_every_frame_equals_the_written_one(
    tmp_path: Path, pictures: list[np.ndarray], compression: int, bits: int
) -> None:
    path = write_cine(tmp_path / "run.cine", pictures, compression=compression, RealBPP=bits)
    with open_source(path) as source:
        assert len(source) == 5
        assert source.shape == (14, 24)
        assert source.bit_depth == bits
        assert source.description == f"Phantom cine, 24×14 px, {bits} bit grey, 1000 frames/s"
        assert source.warnings == ()
        for k in (3, 0, 4, 1, 1, 2):
            frame = source.frame(k)
            assert frame.image.dtype == pictures[0].dtype
            np.testing.assert_array_equal(frame.image, pictures[k])
            assert frame.time_s == k / 1000
        assert source.frame_rate_hz == 1000
        for k in (-1, 5):
            with pytest.raises(IndexError):
                source.frame(k)


def test_packed_10_bit_levels_become_linear(tmp_path: Path) -> None:
    levels = np.arange(1024, dtype=np.uint16).reshape(32, 32)
    path = write_cine(tmp_path / "run.cine", [levels], compression=256, RealBPP=10)
    with open_source(path) as source:
        assert source.bit_depth == 12
        linear = source.frame(0).image.ravel().astype(float)
    # Rec. 709: black at 64, white at 1014, which becomes 4064.
    shade = (np.arange(1024) - 64) / 950
    bent = ((np.maximum(shade, 0.05) + 0.099) / 1.099) ** (1 / 0.45)
    expected = 64 + 4000 * np.where(shade < 0.081, shade / 4.5, bent)
    np.testing.assert_allclose(linear[:1015], expected[:1015], atol=2.5)
    assert linear[1014] == 4064
    assert (linear[1015:] == 4095).all()
    assert (np.diff(linear) >= 0).all()


@pytest.mark.parametrize("scale", [1, 257], ids=["24 bit", "48 bit"])
def test_colour_becomes_luminance(tmp_path: Path, scale: int) -> None:
    kind = np.uint8 if scale == 1 else np.uint16
    pictures = [picture.astype(kind) * kind(scale) for picture in COLOUR_8]
    path = write_cine(tmp_path / "run.cine", pictures)
    for image, picture in zip(images(path), pictures, strict=True):
        np.testing.assert_allclose(image, picture @ [0.299, 0.587, 0.114], atol=0.6 * scale)


@pytest.mark.parametrize("pixels", ["gray", "gray16le", "bgr24"])
def test_ffmpeg_reads_the_same_frames(tmp_path: Path, pixels: str) -> None:
    pictures = {"gray": GREY_8, "gray16le": GREY_12, "bgr24": COLOUR_8}[pixels]
    path = write_cine(tmp_path / "run.cine", pictures, annotation=b"12345678")
    options = f"-f rawvideo -pix_fmt {pixels} -fps_mode passthrough -"
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", path, *options.split()]
    read = subprocess.run(command, capture_output=True, check=True).stdout
    expected = np.frombuffer(read, pictures[0].dtype).reshape(len(pictures), *pictures[0].shape)
    if pixels == "bgr24":
        expected = np.rint(expected @ [0.114, 0.587, 0.299])
        np.testing.assert_allclose(images(path), expected, atol=1)
    else:
        np.testing.assert_array_equal(images(path), expected)


def test_rows_may_be_padded_and_stored_from_the_top(tmp_path: Path) -> None:
    pictures = [picture[:, :21] for picture in GREY_8]
    path = write_cine(tmp_path / "run.cine", pictures, row_step=4)
    np.testing.assert_array_equal(images(path), pictures)
    content = bytearray(path.read_bytes())
    struct.pack_into("<i", content, 52, -14)
    path.write_bytes(content)
    np.testing.assert_array_equal(images(path), [picture[::-1] for picture in pictures])


def test_recorded_times_are_read(tmp_path: Path) -> None:
    times = [1_600_000_000.9995, 1_600_000_001.0005, 1_600_000_001.0016, 1_600_000_001.0025]
    path = write_cine(tmp_path / "run.cine", GREY_8[:4], times=times, FrameRate=997)
    with open_source(path) as source:
        assert source.frame_rate_hz == 997
        recorded = [frame.time_s for frame in source]
    np.testing.assert_allclose(recorded, np.array(times) - times[0], atol=1e-6)
    assert recorded[0] == 0


def test_decreasing_times_are_replaced_by_the_frame_rate(tmp_path: Path) -> None:
    path = write_cine(tmp_path / "run.cine", GREY_8[:3], times=[5.0, 5.2, 5.1], FrameRate=100)
    with open_source(path) as source:
        assert [frame.time_s for frame in source] == [0, 0.01, 0.02]
        assert "time stamps do not increase" in source.warnings[0]


def test_missing_frame_rate_is_computed_from_the_times(tmp_path: Path) -> None:
    path = write_cine(tmp_path / "run.cine", GREY_8[:3], times=[5.0, 5.25, 5.5], FrameRate=0)
    with open_source(path) as source:
        assert source.frame_rate_hz == pytest.approx(4)
    path = write_cine(tmp_path / "none.cine", GREY_8[:3], FrameRate=0)
    with open_source(path) as source:
        assert source.frame_rate_hz is None
        assert source.frame(1).time_s is None


def test_short_setup_of_old_files_is_read(tmp_path: Path) -> None:
    path = write_cine(tmp_path / "run.cine", GREY_8, setup_length=740, FrameRate16=500)
    with open_source(path) as source:
        assert source.frame_rate_hz == 500
        assert source.bit_depth == 8
        np.testing.assert_array_equal(source.frame(4).image, GREY_8[4])


def test_raw_colour_and_rotated_pictures_are_reported(tmp_path: Path) -> None:
    path = write_cine(
        tmp_path / "run.cine", GREY_12, file_compression=2, CFA=3, bFlipV=1, RealBPP=12
    )
    with open_source(path) as source:
        bayer, turned = source.warnings
        np.testing.assert_array_equal(source.frame(0).image, GREY_12[0])
    assert "raw colour (Bayer)" in bayer
    assert "flipped or rotated" in turned


def test_truncated_recording_has_its_complete_frames(tmp_path: Path) -> None:
    path = write_cine(tmp_path / "run.cine", GREY_8, times=[1, 2, 3, 4, 5])
    content = path.read_bytes()
    path.write_bytes(content[: -(14 * 24 + 8) - 1])
    with open_source(path) as source:
        assert source.warnings == (
            "run.cine ends early: its header says 5 frames, 3 of them complete",
        )
        np.testing.assert_array_equal([frame.image for frame in source], GREY_8[:3])
        assert source.frame(2).time_s == 2
    path.write_bytes(content[: -5 * (14 * 24 + 8)])
    with pytest.raises(InputError, match="frames: no complete one"):
        open_source(path)


@pytest.mark.parametrize(
    ("offset", "value", "message"),
    [
        (4, struct.pack("<H", 1), "Compression: JPEG"),
        (4, struct.pack("<H", 9), "Compression: 9"),
        (20, bytes(4), "ImageCount: 0"),
        (24, b"\xff\xff\xff\x7f", "OffImageHeader"),
        (28, b"\xff\xff\xff\x7f", "OffSetup"),
        (48, bytes(4), "0 × 14"),
        (48, b"\xff\xff\xff\x7f", "2147483647 × 14; expected frames that fit"),
        (58, struct.pack("<H", 7), "biBitCount: 7; expected 8, 16, 24 or 48"),
        (60, struct.pack("<I", 3), "biCompression: 3"),
        (84 + 140, b"XX", "SETUP: no mark"),
    ],
)
def test_impossible_field_is_named(tmp_path: Path, offset: int, value: bytes, message: str) -> None:
    path = write_cine(tmp_path / "run.cine", GREY_8)
    content = bytearray(path.read_bytes())
    content[offset : offset + len(value)] = value
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        open_source(path)


def test_bad_offset_does_not_affect_the_other_frames(tmp_path: Path) -> None:
    path = write_cine(tmp_path / "run.cine", GREY_8)
    content = bytearray(path.read_bytes())
    table_at = struct.unpack_from("<I", content, 32)[0]
    struct.pack_into("<Q", content, table_at + 8, 2**63)
    struct.pack_into("<Q", content, table_at + 16, 90)
    path.write_bytes(content)
    with open_source(path) as source:
        np.testing.assert_array_equal(source.frame(4).image, GREY_8[4])
        with pytest.raises(InputError, match="frame 1: offset 9223372036854775808"):
            source.frame(1)
        with pytest.raises(InputError, match="frame 2"):
            source.frame(2)


def test_other_content_with_the_suffix_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "run.cine"
    for content in (b"CI", b"x" * 100):
        path.write_bytes(content)
        with pytest.raises(InputError, match="expected a Phantom"):
            open_source(path)


def test_damaged_files_are_read_or_rejected(tmp_path: Path) -> None:
    plain = write_cine(tmp_path / "run.cine", GREY_8, times=[1, 2, 3, 4, 5])
    survives_damage(plain, 300, 1000, 1)
    packed = write_cine(tmp_path / "packed.cine", GREY_12, compression=1024, RealBPP=12)
    survives_damage(packed, 100, 100, 2)
