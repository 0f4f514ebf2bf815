from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from labapp.errors import InputError
from labapp.media import open_source
from labapp.media.base import to_grey
from labapp.media.formats.images import natural_key, read_image
from tests.media.cine_writer import write_cine
from tests.media.conftest import WriteVideo
from tests.scripts import peak_mb, run_python

GREY = (np.indices((20, 30)).sum(axis=0) * 5).astype(np.uint8)


def save(path: Path, image: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), image)
    return path


@pytest.mark.parametrize(("orientation", "quarter_turns"), [(1, 0), (3, 2), (6, 3), (8, 1)])
def test_picture_is_turned_by_its_exif_data(
    tmp_path: Path, orientation: int, quarter_turns: int
) -> None:
    """Like a video by its metadata: one of a calibration must match the other."""
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    exif = b"Exif\0\0" + tiff
    jpeg = cv2.imencode(".jpg", GREY, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    path = tmp_path / "picture.jpg"
    path.write_bytes(jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:])
    read = read_image(path).astype(int)
    assert np.abs(read - np.rot90(GREY, quarter_turns)).max() <= 2


@pytest.mark.parametrize(
    ("suffix", "levels"),
    [("png", 1), ("tiff", 1), ("bmp", 1), ("pgm", 1), ("png", 257), ("tiff", 257), ("pgm", 257)],
)
def test_grey_levels_are_preserved(tmp_path: Path, suffix: str, levels: int) -> None:
    image = GREY if levels == 1 else GREY.astype(np.uint16) * levels
    with open_source(save(tmp_path / f"frame.{suffix}", image)) as source:
        assert len(source) == 1
        assert source.shape == (20, 30)
        assert source.frame_rate_hz is None
        frame = source.frame(0)
    assert frame.image.dtype == image.dtype
    np.testing.assert_array_equal(frame.image, image)
    assert frame.time_s is None
    assert not frame.image.flags.writeable


def test_jpeg_is_read(tmp_path: Path) -> None:
    with open_source(save(tmp_path / "frame.jpg", GREY)) as source:
        np.testing.assert_allclose(source.frame(0).image, GREY, atol=6)


@pytest.mark.parametrize("scale", [1, 257], ids=["8 bit", "16 bit"])
def test_colour_becomes_luminance_and_alpha_is_dropped(tmp_path: Path, scale: int) -> None:
    kind = np.uint8 if scale == 1 else np.uint16
    image = np.zeros((4, 5, 4), kind)
    image[..., :3] = np.array([10, 200, 60]) * scale  # B, G, R
    image[..., 3] = 7
    with open_source(save(tmp_path / "frame.png", image)) as source:
        grey = source.frame(0).image
    assert grey.dtype == kind
    expected = 0.114 * 10 + 0.587 * 200 + 0.299 * 60
    np.testing.assert_allclose(grey, expected * scale, atol=0.6 * scale)


def test_floats_are_preserved(tmp_path: Path) -> None:
    image = GREY.astype(np.float32) / 7
    with open_source(save(tmp_path / "frame.tiff", image)) as source:
        np.testing.assert_array_equal(source.frame(0).image, image)


@pytest.mark.parametrize("kind", [np.int8, np.int16, np.int32, np.float64])
def test_other_types_become_float32(kind: type) -> None:
    image = np.array([[-3, 0, 100]], kind)
    assert to_grey(image).dtype == np.float32
    np.testing.assert_array_equal(to_grey(image), image)


def test_one_pixel_is_an_image(tmp_path: Path) -> None:
    with open_source(save(tmp_path / "frame.png", np.array([[9]], np.uint8))) as source:
        assert source.shape == (1, 1)
        assert source.frame(0).image[0, 0] == 9


def test_nan_is_rejected(tmp_path: Path) -> None:
    image = np.ones((3, 3), np.float32)
    image[1, 1] = np.nan
    with pytest.raises(InputError, match=r"frame\.tiff: grey levels: NaN or infinity"):
        open_source(save(tmp_path / "frame.tiff", image))


def test_each_page_of_a_stack_is_a_frame(tmp_path: Path) -> None:
    path = tmp_path / "stack.tiff"
    assert cv2.imwritemulti(str(path), [GREY, GREY // 2, GREY // 3])
    with open_source(path) as source:
        images = [frame.image for frame in source]
    for k, image in enumerate(images, 1):
        np.testing.assert_array_equal(image, GREY // k)
    assert len(images) == 3


def test_folder_is_read_in_natural_order(tmp_path: Path) -> None:
    for k in (10, 9, 1, 100):
        save(tmp_path / f"frame{k}.png", np.full((4, 4), k, np.uint8))
    (tmp_path / "notes.txt").write_text("not an image")
    (tmp_path / "._frame1.png").write_bytes(b"left by another system")
    with open_source(tmp_path) as source:
        assert [int(frame.image[0, 0]) for frame in source] == [1, 9, 10, 100]
        assert [frame.index for frame in source] == [0, 1, 2, 3]


def test_digits_sort_as_numbers_beside_letters() -> None:
    names = ["b1", "a10", "A2", "2", "a", "10"]
    assert sorted(names, key=natural_key) == ["2", "10", "a", "A2", "a10", "b1"]


def test_bad_image_in_a_folder_does_not_affect_the_others(tmp_path: Path) -> None:
    save(tmp_path / "1.png", GREY)
    (tmp_path / "0.png").write_bytes(b"")
    (tmp_path / "2.png").write_bytes((tmp_path / "1.png").read_bytes()[:60])
    save(tmp_path / "3.png", GREY[:5])
    with open_source(tmp_path) as source:
        assert source.shape == GREY.shape
        np.testing.assert_array_equal(source.frame(1).image, GREY)
        with pytest.raises(InputError, match="0 bytes"):
            source.frame(0)
        with pytest.raises(InputError, match="cannot be decoded"):
            source.frame(2)
        with pytest.raises(InputError, match="30×5 px; expected 30×20 px"):
            source.frame(3)


def test_there_is_no_frame_beyond_the_last(tmp_path: Path) -> None:
    with open_source(save(tmp_path / "frame.png", GREY)) as source:
        for index in (-1, 1):
            with pytest.raises(IndexError, match="frames 0 to 0"):
                source.frame(index)


def test_content_of_a_file_has_priority_over_its_name(tmp_path: Path) -> None:
    saved = tmp_path / "stack.npy"
    np.save(saved, GREY[np.newaxis])
    tiff = save(tmp_path / "frame.tif", GREY)
    cine = write_cine(tmp_path / "run.cine", [GREY])
    for path, kind in [(saved, "NumPy"), (tiff, "TIFF"), (cine, "Phantom")]:
        for name in ("renamed.avi", "renamed.png", "renamed"):
            with open_source(path.rename(tmp_path / name)) as source:
                assert source.description.startswith(kind)
                np.testing.assert_array_equal(source.frame(0).image, GREY)
            (tmp_path / name).rename(path)


def test_webp_is_not_taken_for_an_avi(tmp_path: Path) -> None:
    path = tmp_path / "frame.webp"
    assert cv2.imwrite(str(path), GREY, [cv2.IMWRITE_WEBP_QUALITY, 101])
    with open_source(path) as source:
        np.testing.assert_array_equal(source.frame(0).image, GREY)


def test_only_recording_in_a_folder_is_opened(
    tmp_path: Path, pictures: list[np.ndarray], write_video: WriteVideo
) -> None:
    (tmp_path / "notes.txt").write_text("not a recording")
    video = write_video(tmp_path / "run.avi", pictures, "FFV1")
    with open_source(tmp_path) as source:
        assert source.name == "run.avi"
        np.testing.assert_array_equal(source.frame(3).image, pictures[3])
    cine = write_cine(tmp_path / "run.cine", pictures[:2])
    with pytest.raises(InputError, match=r"run\.avi, run\.cine; expected one recording in it"):
        open_source(tmp_path)
    video.unlink()
    with open_source(tmp_path) as source:
        assert source.name == cine.name
    # A single image beside it may be the calibration picture.
    save(tmp_path / "1.png", GREY)
    with pytest.raises(InputError, match=r"1\.png, run\.cine; expected one recording in it"):
        open_source(tmp_path)
    # Images have priority: their folder often contains the video from which they come.
    save(tmp_path / "2.png", GREY)
    with open_source(tmp_path) as source:
        assert len(source) == 2
        assert source.description == "2 pictures, PNG, 30×20 px, 8 bit grey"


@pytest.mark.parametrize("suffix", ["cine", "cihx", "cih", "mraw", "npy", "npz", "tif", "avi"])
def test_error_of_unknown_content_depends_on_the_suffix(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"run.{suffix}"
    path.write_text("not a recording\n" * 20)
    with pytest.raises(InputError) as caught:
        open_source(path)
    assert os.fspath(path) in str(caught.value)
    promised = {"cine": "Phantom", "tif": "TIFF", "avi": "video", "npy": "NumPy", "npz": ".npz"}
    assert promised.get(suffix, "beside it") in caught.value.expected


@pytest.mark.parametrize("suffix", ["png", "tiff", "bmp", "jpg", "pgm"])
def test_truncated_image_is_rejected(
    tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = save(tmp_path / f"frame.{suffix}", GREY)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="expected a complete image"):
        open_source(path)
    assert capfd.readouterr() == ("", "")


def png(path: Path, side: int) -> Path:
    """Write a black image row by row."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            len(content).to_bytes(4, "big")
            + kind
            + content
            + zlib.crc32(kind + content).to_bytes(4, "big")
        )

    packer = zlib.compressobj()
    levels = [packer.compress(bytes(1 + 2 * side)) for _ in range(side)]
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">2I5B", side, side, 16, 0, 0, 0, 0))
        + chunk(b"IDAT", b"".join(levels) + packer.flush())
        + chunk(b"IEND", b"")
    )
    return path


def tiff(path: Path, side: int) -> Path:
    levels = np.broadcast_to(np.uint16(0), (side, side))
    tifffile.imwrite(path, levels, compression="zlib", rowsperstrip=500)
    return path


@pytest.mark.parametrize("kind", [b"tEXt", b"IDAT"])
def test_chunk_longer_than_its_file_is_rejected(tmp_path: Path, kind: bytes) -> None:
    """OpenCV would allocate memory for the claimed length."""
    path = tmp_path / "large.png"
    content = cv2.imencode(".png", GREY)[1].tobytes()
    end = content.index(b"IDAT") - 4
    path.write_bytes(content[:end] + b"\x7f\0\0\0" + kind + content[end:])
    script = """
        import sys
        from labapp.errors import InputError
        from labapp.media import open_source
        try:
            open_source(sys.argv[1])
            sys.exit("it was opened")
        except InputError:
            pass
    """
    assert peak_mb(script, path) < 400


@pytest.mark.parametrize("write", [png, tiff])
def test_image_that_would_fill_the_memory_is_rejected(
    tmp_path: Path, write: Callable[[Path, int], Path]
) -> None:
    path = write(tmp_path / "large", 20_000)
    assert path.stat().st_size < 2e6
    script = """
        import sys
        from labapp.errors import InputError
        from labapp.media import open_source
        try:
            open_source(sys.argv[1])
            sys.exit("it was opened")
        except InputError as error:
            assert "at most 67108864 px" in str(error)
    """
    path = path.rename(path.with_suffix(f".{write.__name__}"))
    assert peak_mb(script, path) < 400


@pytest.mark.parametrize("name", ["pipe", "pipe.png", "pipe.avi", "pipe.mraw", "a\0.png", "folder"])
def test_source_must_be_a_regular_file(tmp_path: Path, name: str) -> None:
    (tmp_path / "folder").mkdir()
    for pipe in ("pipe", "pipe.png", "pipe.avi", "pipe.mraw", "folder/1.png", "folder/2.png"):
        os.mkfifo(tmp_path / pipe)
    script = f"""
        from labapp.errors import InputError
        from labapp.media import open_source
        try:
            open_source({str(tmp_path / name)!r})
        except InputError as error:
            print(error.problems[0].expected)
    """
    assert run_python(script).strip()


@pytest.mark.parametrize("name", ["a.png", "a.bmp"])
def test_picture_of_gigabytes_is_not_read(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(b"BM")
    os.truncate(path, 2**40)
    with pytest.raises(InputError, match=f"size: {2**40} bytes"):
        read_image(path)


def test_invalid_source_is_rejected(tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    (tmp_path / "day" / "run").mkdir(parents=True)
    nothing = tmp_path / "frame.png"
    nothing.touch()
    text = tmp_path / "text.png"
    text.write_text("not an image\n" * 50)
    for path, message in [
        (empty, "no image or recording in it; expected a folder of images"),
        (tmp_path / "day", "folders, but no image or recording; .* as a study"),
        (nothing, "0 bytes; expected an image or a video"),
        (text, "cannot be decoded; expected a complete image"),
        (tmp_path / "missing.png", "No such file or directory; expected an image, a folder"),
        (text / "below.png", "Not a directory"),
    ]:
        with pytest.raises(InputError, match=message) as caught:
            open_source(path)
        assert os.fspath(path) in str(caught.value)
