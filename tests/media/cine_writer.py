"""Write Phantom .cine files from the published layout, independently of the reader."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

SETUP = (
    "FrameRate16:H Shutter16:H PostTrigger16:H FrameDelay16:H AspectRatio:H Res7:H Res8:H Res9:B "
    "Res10:B Res11:B TrigFrame:B Res12:B DescriptionOld:121s Mark:2s Length:H Res13:H SigOption:H "
    "BinChannels:h SamplesPerImage:B BinName:88s AnaOption:H AnaChannels:h Res6:B AnaBoard:B "
    "ChOption:16s AnaGain:32s AnaUnit:48s AnaName:88s lFirstImage:i dwImageCount:I nQFactor:h "
    "wCineFileType:H szCinePath:260s Res14:H Res15:B Res16:B Res17:H Res18:d Res19:d Res20:H "
    "Res1:i Res2:i Res3:i ImWidth:H ImHeight:H EDRShutter16:H Serial:I Saturation:i Res5:B "
    "AutoExposure:I bFlipH:I bFlipV:I Grid:I FrameRate:I Shutter:I EDRShutter:I PostTrigger:I "
    "FrameDelay:I bEnableColor:I CameraVersion:I FirmwareVersion:I SoftwareVersion:I "
    "RecordingTimeZone:i CFA:I Bright:i Contrast:i Gamma:i Res21:I AutoExpLevel:I AutoExpSpeed:I "
    "AutoExpRect:16s WBGain:32s Rotate:i WBView:8s RealBPP:I"
)
"""The first fields of the structure in order, with their types; the rest is zero."""

SETUP_LENGTH = 5740


def setup(length: int = SETUP_LENGTH, **values: float) -> bytes:
    """The structure SETUP, truncated to ``length`` as written by older software."""
    content = b""
    for field in SETUP.split():
        name, code = field.split(":")
        value = {"Mark": b"ST", "Length": length}.get(name, values.get(name))
        zero: object = b"" if code.endswith("s") else 0
        content += struct.pack("<" + code, zero if value is None else value)
    return content.ljust(max(length, len(content)), b"\0")[:length]


def pack(levels: np.ndarray, bits: int) -> bytes:
    """Pack levels one after the other, most significant bit first."""
    text = "".join(f"{level:0{bits}b}" for level in levels.ravel())
    text += "0" * (-len(text) % 8)
    return int(text, 2).to_bytes(len(text) // 8, "big")


def image_bytes(picture: np.ndarray, compression: int, row_step: int) -> bytes:
    """One picture as stored: packed from the top, or from the bottom with blue first."""
    if compression:
        return pack(picture, {256: 10, 1024: 12}[compression])
    rows = []
    for row in picture[::-1]:
        content = (row[..., ::-1] if row.ndim == 2 else row).tobytes()
        rows.append(content.ljust(-(-len(content) // row_step) * row_step, b"\0"))
    return b"".join(rows)


def write_cine(
    path: Path,
    pictures: list[np.ndarray],
    *,
    compression: int = 0,
    file_compression: int = 0,
    times: list[float] | None = None,
    annotation: bytes = b"",
    row_step: int = 1,
    setup_length: int = SETUP_LENGTH,
    **values: float,
) -> Path:
    """Write ``pictures`` (rows, columns) or (rows, columns, R G B); ``values`` go into SETUP."""
    rows, columns = pictures[0].shape[:2]
    channels = 3 if pictures[0].ndim == 3 else 1
    bit_count = 8 * pictures[0].dtype.itemsize * channels
    stored = [image_bytes(picture, compression, row_step) for picture in pictures]
    values = {"FrameRate": 1000, "RealBPP": bit_count // channels, **values}
    head = struct.pack(
        "<I2i2H2I2i2I", 40, columns, rows, 1, bit_count, compression, len(stored[0]), 0, 0, 0, 0
    )
    head += setup(setup_length, **values)
    if times is not None:
        stamps = b"".join(
            struct.pack("<2I", int(time % 1 * 2**32) & ~3 | 2, int(time)) for time in times
        )
        exposures = struct.pack(f"<{len(pictures)}I", *[77] * len(pictures))
        for kind, block in ((1003, exposures), (1002, stamps)):
            head += struct.pack("<I2H", 8 + len(block), kind, 0) + block
    table_at = 44 + len(head)
    offset = table_at + 8 * len(pictures)
    places, body = [], b""
    for content in stored:
        places.append(offset + len(body))
        body += struct.pack("<I", 8 + len(annotation)) + annotation
        body += struct.pack("<I", len(content)) + content
    file_header = struct.pack(
        "<2s3HiIiI3I2I",
        b"CI",
        44,
        file_compression,
        1,
        -5,
        len(pictures),
        -5,
        len(pictures),
        44,
        84,
        table_at,
        0,
        1_600_000_000,
    )
    path.write_bytes(file_header + head + struct.pack(f"<{len(places)}q", *places) + body)
    return path
