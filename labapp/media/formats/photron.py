"""Photron recordings: a .mraw with grey levels, and a .cihx (XML) or .cih (text) header."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from labapp.errors import InputError, os_errors_as_input
from labapp.media.base import GreyImage, to_grey
from labapp.media.formats.stored import (
    StoredFrames,
    ends_early,
    file_size,
    plausible_rate,
    read_bytes,
    unpack_bits,
)

HEADER_SUFFIXES = (".cihx", ".cih")
PHOTRON_SUFFIXES = frozenset({".mraw", *HEADER_SUFFIXES})

MAX_HEADER_BYTES = 16 * 2**20
"""Largest header; usual are a few kilobytes."""

MAX_SIDE = 2**16
"""Most rows or columns, more than of any camera."""

FIELDS = {
    "rate": ("recordInfo/recordRate", "Record Rate(fps)"),
    "frames": ("frameInfo/totalFrame", "Total Frame"),
    "columns": ("imageDataInfo/resolution/width", "Image Width"),
    "rows": ("imageDataInfo/resolution/height", "Image Height"),
    "bits": ("imageDataInfo/colorInfo/bit", "Color Bit"),
    "colour": ("imageDataInfo/colorInfo/type", "Color Type"),
    "depth": ("imageDataInfo/effectiveBit/depth", "EffectiveBit Depth"),
    "side": ("imageDataInfo/effectiveBit/side", "EffectiveBit Side"),
    "format": ("imageFileInfo/fileFormat", "File Format"),
    "step": ("frameInfo/skipFrame", "Save Step"),
}
"""Location of a field: path in the XML, key in the text."""


@dataclass(frozen=True)
class _Header:
    """Fields of a header; errors have their names in the file."""

    path: Path
    texts: dict[str, str]

    def name(self, field: str) -> str:
        """Return the name of a field in the file."""
        xml, text = FIELDS[field]
        return xml if self.path.suffix.lower() == ".cihx" else text

    def wrong(self, field: str, expected: str) -> InputError:
        return InputError(self.path, self.name(field), self.texts.get(field) or "missing", expected)

    def integer(self, field: str, low: int, high: int) -> int:
        """Parse an integer in ``low`` … ``high``."""
        text = self.texts.get(field, "")
        # The length is checked, as int() is slow with thousands of digits.
        if text.isascii() and text.isdigit() and len(text) < 20 and low <= int(text) <= high:
            return int(text)
        raise self.wrong(field, f"a whole number, {low} to {high}")

    def rate(self) -> float | None:
        try:
            return plausible_rate(float(self.texts.get("rate", "")))
        except ValueError:
            return None


class PhotronSource(StoredFrames):
    """A Photron recording: 8 and 16 bit, packed 10 and 12 bit, grey or colour (R, G, B).

    Levels have the effective bits (EffectiveBit Depth); if these are the higher ones (EffectiveBit
    Side), levels are shifted down.

    Parameters
    ----------
    path
        The .mraw or its header; the other file has the same name in the same folder.

    Raises
    ------
    InputError
        If the other file is missing or ambiguous, the header is incomplete, or there is no complete
        frame.
    """

    def __init__(self, path: Path) -> None:
        self._raw, header_path = _pair(path)
        header = _read_header(header_path)
        form = header.texts.get("format", "mraw")
        if form.lower() != "mraw":
            raise header.wrong("format", "MRaw; open the file of that format itself")
        rows, columns = (header.integer(field, 1, MAX_SIDE) for field in ("rows", "columns"))
        colour = header.texts.get("colour", "").lower() == "color"
        self._channels = 3 if colour else 1
        bits = header.integer("bits", 1, 48)
        self._bits = bits // self._channels
        if bits not in {stored * self._channels for stored in (8, 10, 12, 16)}:
            raise header.wrong("bits", "24, 30, 36 or 48" if colour else "8, 10, 12 or 16")
        depth = header.integer("depth", 1, 16) if "depth" in header.texts else self._bits
        depth = min(depth, self._bits)
        side = header.texts.get("side", "lower").lower()
        if side not in ("lower", "higher"):
            raise header.wrong("side", "Lower or Higher")
        self._shift = self._bits - depth if side == "higher" else 0
        claimed = header.integer("frames", 1, 2**40)
        self._frame_bytes, rest = divmod(rows * columns * bits, 8)
        if rest:
            raise header.wrong("columns", f"rows of {bits} bit levels that fill whole bytes")
        whole = min(claimed, file_size(self._raw) // self._frame_bytes)
        if whole < 1:
            raise InputError(
                self._raw,
                "size",
                f"{file_size(self._raw)} bytes",
                f"{self._frame_bytes} bytes or more: one complete frame",
            )
        warnings = [*ends_early(self._raw.name, claimed, whole)]
        if header.rate() is None:
            warnings.append(f"{header_path.name} has no record rate: its frames have no time")
        if header.texts.get("step", "1") not in ("", "0", "1"):
            warnings.append(
                f"{header_path.name}: not every frame was saved "
                f"({header.name('step')} {header.texts['step']}): times follow from the record rate"
            )
        self.warnings = tuple(warnings)
        super().__init__(
            path,
            "Photron MRAW",
            whole,
            (rows, columns),
            depth,
            colour=colour,
            frame_rate_hz=header.rate(),
        )

    def _grey(self, index: int) -> GreyImage:
        content = read_bytes(self._raw, index * self._frame_bytes, self._frame_bytes)
        if self._bits in (8, 16):
            levels = np.frombuffer(content, "u1" if self._bits == 8 else "<u2")
            levels = levels.astype(levels.dtype.newbyteorder("="), copy=False)
        else:
            levels = unpack_bits(content, self._bits)
        rows, columns = self.shape
        levels = levels >> self._shift
        if self._channels == 1:
            return levels.reshape(rows, columns)
        return to_grey(levels.reshape(rows, columns, 3)[..., ::-1])


def _pair(path: Path) -> tuple[Path, Path]:
    """Return the .mraw and its header, one of which is ``path``."""
    suffix = path.suffix.lower()
    looked_for = HEADER_SUFFIXES if suffix == ".mraw" else (".mraw",)
    with os_errors_as_input(path.parent, "folder", "a folder to read"):
        found = [
            entry
            for entry in sorted(path.parent.iterdir())
            if entry.stem == path.stem and entry.suffix.lower() in looked_for
        ]
    names = " or ".join(path.stem + suffix for suffix in looked_for)
    if not found:
        raise InputError(path, "partner", "missing", f"{names} beside it")
    if len(found) > 1:
        raise InputError(
            path, "partner", " and ".join(entry.name for entry in found), f"one of {names}"
        )
    return (path, found[0]) if suffix == ".mraw" else (found[0], path)


def _read_header(path: Path) -> _Header:
    size = file_size(path)
    if not 0 < size <= MAX_HEADER_BYTES:
        raise InputError(path, "size", f"{size} bytes", "a Photron header")
    content = read_bytes(path, 0, size)
    xml = path.suffix.lower() == ".cihx"
    return _Header(path, _from_xml(path, content) if xml else _from_text(content))


def _from_xml(path: Path, content: bytes) -> dict[str, str]:
    start, end = content.find(b"<cih>"), content.rfind(b"</cih>")
    if start < 0 or end < start:
        raise InputError(path, "content", "no <cih> … </cih>", "a Photron .cihx header")
    # Other fields may be in another encoding.
    text = content[start : end + len(b"</cih>")].decode("utf-8", "replace").replace("\0", "")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise InputError(path, "content", error, "well-formed XML in <cih> … </cih>") from error
    found = {field: root.findtext(xml) for field, (xml, _) in FIELDS.items()}
    return {field: text.strip() for field, text in found.items() if text is not None}


def _from_text(content: bytes) -> dict[str, str]:
    texts: dict[str, str] = {}
    keys = {key: field for field, (_, key) in FIELDS.items()}
    for line in content.decode("utf-8", "replace").splitlines():
        key, colon, value = line.partition(":")
        if colon and (field := keys.get(key.strip())):
            texts.setdefault(field, value.strip())
    return texts
