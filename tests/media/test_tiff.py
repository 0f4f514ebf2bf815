from __future__ import annotations

import lzma
import struct
import subprocess
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import imageio_ffmpeg
import numpy as np
import pytest
import tifffile

from labapp.errors import InputError
from labapp.media import open_source
from tests.media.cine_writer import pack
from tests.media.mutate import survives_damage
from tests.scripts import peak_mb

RNG = np.random.default_rng(14)
GREY_8 = RNG.integers(0, 256, (5, 12, 17), np.uint8)
GREY_16 = RNG.integers(0, 65536, (5, 12, 17), np.uint16)
COLOUR = RNG.integers(0, 256, (3, 12, 17, 3), np.uint8)


def assert_same_frames(path: Path, stack: np.ndarray) -> None:
    """Compare every frame with the stack, in order and in reverse order."""
    with open_source(path) as source:
        assert len(source) == len(stack)
        assert source.shape == stack.shape[1:]
        assert source.warnings == ()
        order = [*range(len(stack)), *reversed(range(len(stack)))]
        for k in order:
            frame = source.frame(k)
            assert frame.image.dtype == stack.dtype
            np.testing.assert_array_equal(frame.image, stack[k])
        with pytest.raises(IndexError):
            source.frame(len(stack))
        reopened = source.reopen()
        source.close()
        with reopened:
            np.testing.assert_array_equal(reopened.frame(0).image, stack[0])


@pytest.mark.parametrize("stack", [GREY_8, GREY_16], ids=["8 bit", "16 bit"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"byteorder": ">"},
        {"bigtiff": True},
        {"bigtiff": True, "byteorder": ">"},
        {"imagej": True},
        {"ome": True},
        {"metadata": None},
        {"contiguous": False, "rowsperstrip": 5},
        {"tile": (16, 16)},
        {"compression": "zlib"},
        {"compression": "zlib", "predictor": True, "byteorder": ">"},
        {"compression": "lzma"},
    ],
    ids=str,
)
def test_stacks_of_tifffile_are_read(
    tmp_path: Path, stack: np.ndarray, options: dict[str, object]
) -> None:
    path = tmp_path / "run.tif"
    tifffile.imwrite(path, stack, photometric="minisblack", **options)
    assert_same_frames(path, stack)
    with open_source(path) as source:
        bits = 8 * stack.itemsize
        assert source.bit_depth == bits
        assert source.description == f"TIFF stack of 5 pages, 17×12 px, {bits} bit grey"
        assert source.frame_rate_hz is None
        assert source.frame(1).time_s is None


def test_separately_written_pages_are_read(tmp_path: Path) -> None:
    path = tmp_path / "run.tif"
    with tifffile.TiffWriter(path) as writer:
        for page in GREY_16:
            writer.write(page, photometric="minisblack", contiguous=False)
    assert_same_frames(path, GREY_16)


def test_stack_without_directories_of_pages_is_read(tmp_path: Path) -> None:
    path = tmp_path / "run.tif"
    tifffile.imwrite(path, GREY_16, imagej=True, truncate=True, metadata={"finterval": 0.002})
    assert_same_frames(path, GREY_16)
    with open_source(path) as source:
        assert source.frame_rate_hz == pytest.approx(500)
        assert source.frame(3).time_s == pytest.approx(0.006)
    path.write_bytes(path.read_bytes()[: -12 * 17 * 2 - 1])
    with open_source(path) as source:
        assert source.warnings == (
            "run.tif ends early: its header says 5 frames, 3 of them complete",
        )
        np.testing.assert_array_equal([frame.image for frame in source], GREY_16[:3])


@pytest.mark.parametrize("code", [1, 5, 8, 32773, 32946])
def test_stacks_of_opencv_are_read(tmp_path: Path, code: int) -> None:
    path = tmp_path / "run.tif"
    assert cv2.imwritemulti(str(path), list(GREY_16), [cv2.IMWRITE_TIFF_COMPRESSION, code])
    assert_same_frames(path, GREY_16)


def test_jpeg_compression_is_read(tmp_path: Path) -> None:
    path = tmp_path / "run.tif"
    smooth = np.indices((32, 32)).sum(axis=0).astype(np.uint8) * 4
    assert cv2.imwrite(str(path), smooth, [cv2.IMWRITE_TIFF_COMPRESSION, 7])
    with open_source(path) as source:
        np.testing.assert_allclose(source.frame(0).image, smooth, atol=8)


@pytest.mark.parametrize("algorithm", ["raw", "packbits", "lzw", "deflate"])
@pytest.mark.parametrize("pixels", ["gray", "gray16le"])
def test_images_of_ffmpeg_are_read(tmp_path: Path, algorithm: str, pixels: str) -> None:
    stack = GREY_8 if pixels == "gray" else GREY_16
    options = f"-v error -f rawvideo -pix_fmt {pixels} -s 17x12 -i - -compression_algo {algorithm}"
    command = [imageio_ffmpeg.get_ffmpeg_exe(), *options.split(), tmp_path / "run%d.tif"]
    subprocess.run(command, input=stack.tobytes(), check=True)
    assert_same_frames(tmp_path, stack)
    assert_same_frames(tmp_path / "run3.tif", stack[2:3])


def test_series_of_numbered_images_is_read(tmp_path: Path) -> None:
    # As exported by i-SPEED software: one 12 bit image in 16 bit per file.
    stack = GREY_16 >> 4
    for k, page in enumerate(stack):
        tifffile.imwrite(tmp_path / f"run_{k + 8}.tif", page, photometric="minisblack")
    assert_same_frames(tmp_path, stack)
    with open_source(tmp_path) as source:
        assert source.description == "5 pictures, TIF, 17×12 px, 16 bit grey"


def test_folder_may_contain_only_one_stack(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", GREY_8, photometric="minisblack")
    assert_same_frames(tmp_path, GREY_8)
    tifffile.imwrite(tmp_path / "b.tif", GREY_8, photometric="minisblack")
    with pytest.raises(InputError, match=r"a\.tif: pages: 5; expected one picture a file"):
        open_source(tmp_path)


@pytest.mark.parametrize("planes", ["contig", "separate"])
@pytest.mark.parametrize("scale", [1, 257], ids=["8 bit", "16 bit"])
def test_colour_becomes_luminance(tmp_path: Path, planes: str, scale: int) -> None:
    path = tmp_path / "run.tif"
    kind = np.uint8 if scale == 1 else np.uint16
    stack = COLOUR.astype(kind) * kind(scale)
    stored = np.moveaxis(stack, 3, 1) if planes == "separate" else stack
    tifffile.imwrite(path, stored, photometric="rgb", planarconfig=planes)
    with open_source(path) as source:
        assert "colour" in source.description
        for frame in source:
            expected = stack[frame.index] @ [0.299, 0.587, 0.114]
            np.testing.assert_allclose(frame.image, expected, atol=0.6 * scale)


def test_inverted_levels_are_read(tmp_path: Path) -> None:
    for stack, white in ((GREY_8, 255), (GREY_16, 65535)):
        path = tmp_path / "run.tif"
        tifffile.imwrite(path, stack, photometric="miniswhite")
        assert_same_frames(path, white - stack)


def test_alpha_is_dropped(tmp_path: Path) -> None:
    path = tmp_path / "run.tif"
    image = np.dstack([GREY_8[0], GREY_8[1]])
    tifffile.imwrite(path, image, photometric="minisblack", extrasamples=["unassalpha"])
    assert_same_frames(path, GREY_8[:1])


def test_floats_and_wide_integers_become_float32(tmp_path: Path) -> None:
    path = tmp_path / "run.tif"
    for kind in (np.float32, np.float64, np.int16, np.uint32):
        tifffile.imwrite(path, GREY_16.astype(kind), photometric="minisblack")
        assert_same_frames(path, GREY_16.astype(kind).astype(np.float32))


def one_page(rows: int, columns: int, bits: int, content: bytes, **other: int) -> bytes:
    """Contents of a TIFF with one page of one strip, before its directory."""
    tags = {256: columns, 257: rows, 258: bits, 259: 1, 262: 1, 273: 8, 277: 1, 278: rows}
    tags |= {279: len(content)} | {int(tag[1:]): value for tag, value in other.items()}
    content += b"\0" * (len(content) % 2)
    directory = struct.pack("<H", len(tags))
    for tag, value in sorted(tags.items()):
        directory += struct.pack("<2H2I", tag, 4, 1, value)
    return struct.pack("<2sHI", b"II", 42, 8 + len(content)) + content + directory + bytes(4)


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_packed_levels_are_read(tmp_path: Path, bits: int) -> None:
    path = tmp_path / "run.tif"
    levels = GREY_16[0] >> (16 - bits)
    rows = b"".join(pack(row, bits) for row in levels)
    path.write_bytes(one_page(12, 17, bits, rows))
    assert_same_frames(path, levels[np.newaxis])
    with open_source(path) as source:
        assert source.bit_depth == bits


def test_one_bit_becomes_black_or_white(tmp_path: Path) -> None:
    path = tmp_path / "run.tif"
    levels = GREY_8[:1] // 128
    rows = b"".join(pack(row, 1) for row in levels[0])
    path.write_bytes(one_page(12, 17, 1, rows))
    assert_same_frames(path, levels * 255)
    path.write_bytes(one_page(12, 17, 1, rows, t262=0))
    assert_same_frames(path, (1 - levels) * 255)


def test_palette_is_applied(tmp_path: Path) -> None:
    path = tmp_path / "run.tif"
    ramp = np.tile(np.arange(256, dtype=np.uint16)[::-1] * 257, (3, 1))
    tifffile.imwrite(path, GREY_8[0], photometric="palette", colormap=ramp)
    with open_source(path) as source:
        np.testing.assert_allclose(source.frame(0).image, 255 - GREY_8[0], atol=1)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"t259": 50000}, r"page 0 cannot be decoded \(compression ZSTD\)"),
        ({"t256": 60000}, "8 bits|bytes for"),
        ({"t273": 10**6}, "bytes; expected a complete image: TIFF"),
        ({"t277": 5}, "samples a pixel: 5|bytes for"),
        ({"t256": 0, "t257": 0}, "size: 0×0 px"),
    ],
)
def test_impossible_tag_is_named(tmp_path: Path, other: dict[str, int], message: str) -> None:
    path = tmp_path / "run.tif"
    path.write_bytes(one_page(12, 17, 8, GREY_8[0].tobytes(), **other))
    with pytest.raises(InputError, match=message):
        open_source(path)


@pytest.mark.parametrize(
    ("compression", "packer"), [(8, zlib.compressobj), (34925, lzma.LZMACompressor)]
)
def test_strip_that_would_fill_the_memory_is_rejected(
    tmp_path: Path, compression: int, packer: Callable[[], Any]
) -> None:
    """The page is small, but its only strip unpacks to 600 MB."""
    path, zeros, packing = tmp_path / "run.tif", bytes(10**7), packer()
    content = b"".join([packing.compress(zeros) for _ in range(60)]) + packing.flush()
    path.write_bytes(one_page(12, 17, 8, content, t259=compression))
    assert path.stat().st_size < 1e6
    script = """
        import sys
        from labapp.errors import InputError
        from labapp.media import open_source
        try:
            open_source(sys.argv[1])
            sys.exit("it was opened")
        except InputError as error:
            assert "more data than its pages need" in str(error)
    """
    assert peak_mb(script, path) < 300


def test_times_of_ome_are_read(tmp_path: Path) -> None:
    path = tmp_path / "run.ome.tif"
    about = {"axes": "TYX", "TimeIncrement": 4, "TimeIncrementUnit": "ms"}
    tifffile.imwrite(path, GREY_8, ome=True, photometric="minisblack", metadata=about)
    with open_source(path) as source:
        assert source.frame_rate_hz == pytest.approx(250)
        assert source.frame(2).time_s == pytest.approx(0.008)
    times = [7.0, 7.5, 8.0, 9.0, 9.5]
    about = {"axes": "TYX", "Plane": {"DeltaT": times, "DeltaTUnit": ["s"] * 5}}
    tifffile.imwrite(path, GREY_8, ome=True, photometric="minisblack", metadata=about)
    with open_source(path) as source:
        assert [frame.time_s for frame in source] == [0, 0.5, 1, 2, 2.5]
        assert source.frame_rate_hz == 2


def test_only_a_page_of_another_size_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "run.tif"
    with tifffile.TiffWriter(path) as writer:
        for page in (GREY_8[0], GREY_8[1][:5], GREY_8[2]):
            writer.write(page, photometric="minisblack", metadata=None)
    with open_source(path) as source:
        np.testing.assert_array_equal(source.frame(2).image, GREY_8[2])
        with pytest.raises(InputError, match="page 1, size: 17×5 px; expected 17×12 px"):
            source.frame(1)


def test_truncated_stack_has_its_complete_pages(tmp_path: Path) -> None:
    path = tmp_path / "run.tif"
    with tifffile.TiffWriter(path) as writer:
        for page in GREY_8:
            writer.write(page, photometric="minisblack", metadata=None)
    with tifffile.TiffFile(path) as tiff:
        places = [page.offset for page in tiff.pages]
    content = path.read_bytes()
    path.write_bytes(content[: places[3] + 20])
    with open_source(path) as source:
        np.testing.assert_array_equal([frame.image for frame in source], GREY_8[:3])
        assert source.warnings == ("run.tif ends early: 3 of its pages are complete",)


def test_damaged_files_are_read_or_rejected(tmp_path: Path) -> None:
    for seed, (name, options) in enumerate(
        [
            ("plain", {}),
            ("pages", {"metadata": None, "rowsperstrip": 4}),
            ("big", {"bigtiff": True, "byteorder": ">"}),
            ("packed", {"compression": "zlib"}),
            ("imagej", {"imagej": True, "truncate": True}),
        ]
    ):
        path = tmp_path / f"{name}.tif"
        tifffile.imwrite(path, GREY_8, photometric="minisblack", **options)
        survives_damage(path, 100, 600, seed)
    path = tmp_path / "lzw.tif"
    assert cv2.imwritemulti(str(path), list(GREY_8), [cv2.IMWRITE_TIFF_COMPRESSION, 5])
    survives_damage(path, 100, 600, 9)
