"""Checksums of FFV1 packets, whose errors FFmpeg's decoder does not report."""

from __future__ import annotations

import zlib

MIRRORED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
"""Each byte with its bits reversed, as `zlib.crc32` uses the reversed bit order."""

FOOTER = 8
"""Size (3 bytes), state (1) and checksum (4) after each slice."""


def slices_whole(packet: bytes) -> bool:
    """Whether the checksum of every slice of a packet is right (FFV1 version 3 or later).

    Also False without checksums, as before version 3 (RFC 9043, §4.9: CRC-32 with the polynomial
    04C11DB7, highest bit first, over slice and footer; 0 if they are intact).
    """
    end = len(packet)
    while end >= FOOTER:
        start = end - FOOTER - int.from_bytes(packet[end - FOOTER : end - FOOTER + 3], "big")
        if start < 0:
            return False
        mirrored = packet[start:end].translate(MIRRORED)
        # zlib inverts the initial and the final value; the format does neither.
        if zlib.crc32(mirrored, 0xFFFFFFFF) != 0xFFFFFFFF:
            return False
        end = start
    return end == 0
