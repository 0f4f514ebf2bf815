"""Write Photron .mraw files and their headers, independently of the reader."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tests.media.cine_writer import pack

XML = """<?xml version="1.0" encoding="utf-8"?>
<cih>
<fileInfo><version>1.00</version><date>2026/1/2</date></fileInfo>
<basicInfo><comment>Sch\u00f6nes Bad \u6eb6\u63a5</comment></basicInfo>
<deviceInfo><deviceName>FASTCAM Mini</deviceName></deviceInfo>
<recordInfo><recordRate>{rate}</recordRate><shutterSpeed>20000</shutterSpeed></recordInfo>
<frameInfo><totalFrame>{frames}</totalFrame><recordedFrame>900</recordedFrame>
<startFrame>-3</startFrame><skipFrame>{step}</skipFrame></frameInfo>
<imageFileInfo><fileFormat>{form}</fileFormat></imageFileInfo>
<imageDataInfo><resolution><width>{columns}</width><height>{rows}</height></resolution>
<colorInfo><type>{colour}</type><bit>{bits}</bit></colorInfo>
<effectiveBit><depth>{depth}</depth><side>{side}</side></effectiveBit></imageDataInfo>
</cih>
"""

TEXT = """#Camera Information Header
Date : 2026/1/2
Camera Type : FASTCAM Mini
Record Rate(fps) : {rate}
Shutter Speed(s) : 1/20000
Comment Text : Ratio 3 : 4
Original Total Frame : 900
Total Frame : {frames}
Start Frame : -3
Image Width : {columns}
Image Height : {rows}
Color Type : {colour}
Color Bit : {bits}
File Format : {form}
EffectiveBit Depth : {depth}
EffectiveBit Side : {side}
Save Step : {step}
END
"""


def write_photron(
    folder: Path,
    pictures: list[np.ndarray],
    bits: int,
    *,
    suffix: str = ".cihx",
    depth: int | None = None,
    side: str = "Lower",
    rate: object = 2000,
    step: int = 1,
    header_fields: Mapping[str, object] | None = None,
) -> Path:
    """Write run.mraw with ``bits`` a level, and its header, which is returned.

    ``header_fields`` replaces the true values of the header.
    """
    rows, columns = pictures[0].shape[:2]
    channels = 3 if pictures[0].ndim == 3 else 1
    content = b""
    for picture in pictures:
        if bits in (10, 12):
            content += pack(picture, bits)
        else:
            content += picture.astype("u1" if bits == 8 else "<u2").tobytes()
    (folder / "run.mraw").write_bytes(content)
    fields = {
        "rate": rate,
        "frames": len(pictures),
        "columns": columns,
        "rows": rows,
        "colour": "Color" if channels == 3 else "Mono",
        "bits": bits * channels,
        "form": "MRaw",
        "depth": depth or bits,
        "side": side,
        "step": step,
        **(header_fields or {}),
    }
    header = folder / f"run{suffix}"
    if suffix == ".cih":
        header.write_text(TEXT.format(**fields), encoding="utf-8")
    else:
        xml = XML.format(**fields).encode()
        header.write_bytes(b"\x05CIHX\0\xff\xfe" + xml + b"\0\xff" * 20)
    return header
