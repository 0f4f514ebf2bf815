"""Frames from TIFF files: pages, or the pictures of a stack in one page."""

from __future__ import annotations

import contextlib
import logging
import lzma
import math
import xml.etree.ElementTree as ET
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from labapp.core.values import FloatArray
from labapp.errors import InputError, os_errors_as_input
from labapp.media.base import GreyImage, to_grey
from labapp.media.formats.stored import (
    READABLE,
    StoredFrames,
    check_shape,
    ends_early,
    file_size,
    finite,
    first_readable,
    increasing,
    plausible_rate,
    rate_of,
    read_bytes,
    too_large,
    unpack_bits,
)
from labapp.pixels import MOST_PIXELS

if TYPE_CHECKING:
    import tifffile

TIFF_MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
TIFF_SUFFIXES = frozenset({".tif", ".tiff"})

A_TIFF = "a complete image: TIFF, uncompressed or with Deflate, LZW, PackBits or JPEG"

MOST_BITS = 64 * MOST_PIXELS
"""Largest decompressed page: four samples of 16 bit per pixel."""

MAX_RATIO = 2000
"""Largest compression ratio of the supported compressions."""

UNPACKERS: dict[int, Callable[[], Any]] = {
    8: zlib.decompressobj,
    32946: zlib.decompressobj,
    34925: lzma.LZMADecompressor,
}
"""Decompressors of Deflate and LZMA, which tifffile decompresses without a limit."""

BY_TIFFFILE = {1, *UNPACKERS}
"""Compressions decoded by tifffile; others, which it may not limit, by OpenCV."""

MIN_IS_WHITE, MIN_IS_BLACK, RGB, COLOUR_FILTER = 0, 1, 2, 32803
"""Photometric interpretations whose levels are read directly; others are decoded by OpenCV."""

SECONDS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "msec": 1e-3, "µs": 1e-6, "us": 1e-6, "min": 60.0}

# Problems are reported by errors and warnings of this module instead of tifffile's log.
logging.getLogger("tifffile").addHandler(logging.NullHandler())

Result = TypeVar("Result")


class TiffStack(StoredFrames):
    """The pages of a TIFF file, or the pictures that one page describes (ImageJ, large stacks).

    Page k is found through the chain of directories, without decoding the previous pages. Pages
    that tifffile cannot decode are decoded by OpenCV. The frame interval is ImageJ's ``finterval``
    or ``fps``, or OME's ``TimeIncrement`` or ``DeltaT``.

    Raises
    ------
    InputError
        If no page can be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._size = file_size(path)
        import tifffile  # imported on use, as most recordings do not need it

        self._tiff = _guarded(path, lambda: tifffile.TiffFile(path, is_ome=False))
        try:
            _guarded(path, self._start)
        except BaseException:
            self.close()
            raise

    def _start(self) -> None:
        path = self._path
        pages = len(self._tiff.pages)
        first = _page_of(self._tiff, 0)
        described = _described_frames(self._tiff)
        self._stride = 0
        if described > pages and pages == 1 and first.is_memmappable:
            self._stride = int(first.nbytes)
            room = self._size - int(first.dataoffsets[0])
            count = max(1, min(described, room // max(self._stride, 1)))
            self.warnings = ends_early(path.name, described, count)
        else:
            count = self._whole_pages(pages)
            if described > count:
                self.warnings = ends_early(path.name, described, count)
            elif count < pages or self._names_another(count):
                self.warnings = (f"{path.name} ends early: {count} of its pages are complete",)
        page, image = first_readable(lambda k: (self._page(k), self._decode(k)), count)
        rate, time_s = _time_base(self._tiff, count)
        super().__init__(
            path,
            "TIFF" if count == 1 else f"TIFF stack of {count} pages",
            count,
            (image.shape[0], image.shape[1]),
            _bit_depth(page, image),
            colour=page.photometric not in (MIN_IS_WHITE, MIN_IS_BLACK, COLOUR_FILTER),
            frame_rate_hz=rate,
            time_s=time_s,
        )

    def reopen(self) -> Self:
        """Open the same file again."""
        return type(self)(self._path)

    def close(self) -> None:
        """Close the file. May be called twice."""
        self._tiff.close()

    def _page(self, index: int) -> tifffile.TiffPage:
        number = 0 if self._stride else index
        return _guarded(self._path, lambda: _page_of(self._tiff, number))

    def _grey(self, index: int) -> GreyImage:
        image = self._decode(index)
        return check_shape(self._path, f"page {index}, size", image, self.shape, "pages")

    def _decode(self, index: int) -> GreyImage:
        page = self._page(index)
        return finite(self._path, _guarded(self._path, lambda: self._levels(page, index)))

    def _levels(self, page: tifffile.TiffPage, index: int) -> GreyImage:
        offset = int(page.dataoffsets[0]) + index * self._stride if self._stride else None
        grey = _read_page(self._path, page, self._size, offset)
        return self._by_opencv(index, page) if grey is None else grey

    def _by_opencv(self, index: int, page: tifffile.TiffPage) -> GreyImage:
        images: Any = ()
        with contextlib.suppress(cv2.error):
            _, images = cv2.imreadmulti(str(self._path), index, 1, flags=cv2.IMREAD_UNCHANGED)
        if not len(images) or images[0].shape[:2] != (page.imagelength, page.imagewidth):
            name = getattr(page.compression, "name", page.compression)
            raise InputError(
                self._path,
                "content",
                f"page {index} cannot be decoded (compression {name})",
                A_TIFF,
            )
        grey = to_grey(np.asarray(images[0]))
        if 8 < page.bitspersample < 16 and grey.dtype == np.uint16:
            grey = grey >> (16 - page.bitspersample)  # OpenCV uses the higher bits.
        return grey

    def _whole_pages(self, pages: int) -> int:
        """Return the number of pages without truncated ones at the end."""
        for count in range(pages, 1, -1):
            with contextlib.suppress(InputError):
                page = self._page(count - 1)
                if _end(page) <= self._size:
                    return count
        return 1

    def _names_another(self, pages: int) -> bool:
        """Whether the last directory refers to another one, which is missing."""
        last = self._page(pages - 1)
        tiff = self._tiff.tiff
        end = last.offset + tiff.tagnosize + len(last.tags) * tiff.tagsize
        if end + tiff.offsetsize > self._size:
            return True
        return any(read_bytes(self._path, end, tiff.offsetsize))


def _guarded(path: Path, read: Callable[[], Result]) -> Result:
    """Call ``read``, and convert any error of tifffile to an `InputError`."""
    try:
        with os_errors_as_input(path, "file", READABLE):
            return read()
    except InputError:
        raise
    except Exception as error:
        # tifffile raises nearly every kind of error for damaged tags.
        raise InputError(path, "content", "cannot be decoded", A_TIFF) from error


def _page_of(tiff: tifffile.TiffFile, number: int) -> tifffile.TiffPage:
    return tiff.pages[number].aspage()


def _end(page: tifffile.TiffPage) -> int:
    """Return the offset after the data of a page; 0 if it has none."""
    parts = zip(page.dataoffsets, page.databytecounts, strict=False)
    return max((at + count for at, count in parts), default=0)


def _described_frames(tiff: tifffile.TiffFile) -> int:
    """Return the number of pictures in the first page's metadata; 0 if unknown."""
    page = _page_of(tiff, 0)
    if tiff.is_imagej:
        return int((tiff.imagej_metadata or {}).get("images", 0))
    if page.is_shaped:
        shape = (tiff.shaped_metadata or ({},))[0].get("shape", ())
        return math.prod(int(side) for side in shape) // max(math.prod(page.shape), 1)
    return 0


def _read_page(
    path: Path, page: tifffile.TiffPage, size: int, offset: int | None
) -> GreyImage | None:
    """Read a page, or the picture at ``offset``, as grey levels; None if tifffile cannot."""
    _check_room(path, page, size)
    if page.photometric not in (MIN_IS_WHITE, MIN_IS_BLACK, RGB, COLOUR_FILTER):
        return None
    if page.samplesperpixel > 2 and page.photometric != RGB:
        raise InputError(
            path, "samples a pixel", page.samplesperpixel, "1, or 3 and 4 with a colour space"
        )
    _check_unpacked(path, page)
    image = _samples(path, page, offset)
    if image is None:
        return None
    planes, depth, *_ = image.shape
    if depth != 1:
        raise InputError(path, "ImageDepth", depth, "1: pictures, not volumes")
    if image.dtype.kind not in "buif":
        raise InputError(path, "type", image.dtype, "levels that are integers or floats")
    image = np.moveaxis(image[:, 0, :, :, 0], 0, -1) if planes > 1 else image[0, 0]
    return _to_levels(image, page)


def _check_room(path: Path, page: tifffile.TiffPage, size: int) -> None:
    """Raise if the data of a page are not in the file of ``size`` bytes, before allocation."""
    stored = sum(page.databytecounts)
    bits = math.prod(page.shape) * page.bitspersample
    if page.is_tiled:
        bits = max(bits, page.tilewidth * page.tilelength * page.bitspersample)
    if bits > MOST_BITS or math.prod(page.shape) > 4 * MOST_PIXELS:
        raise too_large(path, page.imagelength, page.imagewidth)
    if bits == 0:
        shown = f"{page.imagewidth}×{page.imagelength} px"
        raise InputError(path, "size", shown, "a picture with pixels")
    if min(page.dataoffsets, default=0) <= 0 or _end(page) > size:
        raise InputError(path, "size", f"{size} bytes", A_TIFF)
    if bits > 8 * stored * (1 if page.compression == 1 else MAX_RATIO):
        raise InputError(path, "content", f"{stored} bytes for {bits} bits", A_TIFF)


def _check_unpacked(path: Path, page: tifffile.TiffPage) -> None:
    """Raise if strips or tiles decompress to more than their size."""
    if (unpacker := UNPACKERS.get(page.compression)) is None:
        return
    most = math.prod(page.chunks) * -(-page.bitspersample // 8)
    for at, count in zip(page.dataoffsets, page.databytecounts, strict=False):
        if len(unpacker().decompress(read_bytes(path, at, count), most + 1)) > most:
            raise InputError(path, "content", "more data than its pages need", A_TIFF)


def _samples(path: Path, page: tifffile.TiffPage, offset: int | None) -> npt.NDArray[Any] | None:
    """Read samples in tifffile's order: (planes, depth, rows, columns, samples)."""
    if page.dtype is None or page.compression not in BY_TIFFFILE:
        return None
    if offset is not None:
        kind = page.dtype.newbyteorder(page.parent.byteorder)
        return np.frombuffer(read_bytes(path, offset, page.nbytes), kind).reshape(page.shaped)
    if page.bitspersample in (1, 8, 16, 32, 64):
        try:
            return page.asarray(squeeze=False, maxworkers=1).reshape(page.shaped)
        except Exception as error:
            if isinstance(error, ImportError) or "imagecodecs" in str(error):
                return None  # no decoder for this compression
            raise
    plain = page.compression == 1 and page.fillorder == 1 and not page.is_tiled
    return _unpack_rows(path, page) if plain and page.samplesperpixel == 1 else None


def _unpack_rows(path: Path, page: tifffile.TiffPage) -> npt.NDArray[np.uint16]:
    """Unpack an uncompressed page with 9 … 15 bits per level and byte-aligned rows."""
    row = -(-page.imagewidth * page.bitspersample // 8)
    content = b"".join(
        read_bytes(path, at, count)
        for at, count in zip(page.dataoffsets, page.databytecounts, strict=True)
    )
    rows = np.frombuffer(content, np.uint8)[: row * page.imagelength].reshape(-1, row)
    levels = [unpack_bits(line.tobytes(), page.bitspersample)[: page.imagewidth] for line in rows]
    return np.array(levels, np.uint16).reshape(page.shaped)


def _to_levels(image: npt.NDArray[Any], page: tifffile.TiffPage) -> GreyImage:
    """Convert samples, shape (rows, columns, samples), to grey levels."""
    if image.dtype == bool:
        image = image.astype(np.uint8) * np.uint8(255)
    image = image.astype(image.dtype.newbyteorder("="), copy=False)
    if page.photometric == MIN_IS_WHITE and image.dtype.kind == "u":
        image = np.array((1 << max(page.bitspersample, 8)) - 1, image.dtype) - image
    return to_grey(image[..., 2::-1] if image.shape[-1] > 2 else image)


def _bit_depth(page: tifffile.TiffPage, image: GreyImage) -> int:
    if image.dtype == np.float32:
        return 32
    stored = 8 * image.dtype.itemsize
    return page.bitspersample if 8 <= page.bitspersample <= stored else stored


def _time_base(tiff: tifffile.TiffFile, count: int) -> tuple[float | None, FloatArray | None]:
    """Return frame rate, Hz, and times of the frames, s, from the metadata; None if unknown."""
    metadata = tiff.imagej_metadata or {} if tiff.is_imagej else {}
    interval = _seconds(metadata.get("finterval"), str(metadata.get("tunit", "s")))
    if interval is not None:
        return plausible_rate(1 / interval), None
    if "fps" in metadata:
        return plausible_rate(float(metadata["fps"])), None
    description = _page_of(tiff, 0).description
    if not description.lstrip().startswith("<") or "<Pixels" not in description[:100_000]:
        return None, None
    return _ome_time_base(description, count)


def _ome_time_base(description: str, count: int) -> tuple[float | None, FloatArray | None]:
    if "<!DOCTYPE" in description:
        return None, None
    try:
        pixels = ET.fromstring(description.encode()).find(".//{*}Pixels")
    except ET.ParseError:
        return None, None
    if pixels is None:
        return None, None
    step = _seconds(pixels.get("TimeIncrement"), pixels.get("TimeIncrementUnit", "s"))
    if step is not None:
        return plausible_rate(1 / step), None
    planes = pixels.findall("{*}Plane")
    stamps = [_number(plane.get("DeltaT")) for plane in planes]
    time_s = np.array([np.nan if stamp is None else stamp for stamp in stamps])
    if len(time_s) < count or count < 2:
        return None, None
    time_s *= SECONDS.get(planes[0].get("DeltaTUnit", "s"), np.nan)
    time_s = time_s[:count] - time_s[0]
    if not increasing(time_s):
        return None, None
    return rate_of(time_s), time_s


def _seconds(value: object, unit: str) -> float | None:
    """Return a positive time in s; None if invalid."""
    number = _number(value)
    scale = SECONDS.get(unit.replace("\\u00B5", "µ"))
    return None if number is None or scale is None or number <= 0 else number * scale


def _number(value: object) -> float | None:
    try:
        number = float(str(value))
    except ValueError:
        return None
    return number if np.isfinite(number) else None
