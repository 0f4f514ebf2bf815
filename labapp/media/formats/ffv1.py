"""The checksums in FFV1 packets, which FFmpeg's decoder notices but does not act upon."""

from __future__ import annotations

import zlib

MIRRORED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
"""Each byte with its bits in reverse, for `zlib.crc32` counts them from the other end."""

FOOTER = 8
"""Size (3 byte), state (1) and checksum (4) behind each slice."""


def slices_whole(packet: bytes) -> bool:
    """Whether every slice of a packet of FFV1 version 3 or later has the checksum it says.

    False too where there is none, as before version 3 (RFC 9043, §4.9: CRC-32 with the polynomial
    04C11DB7 from the highest bit on, over slice and footer; 0 where they are intact).
    """
    end = len(packet)
    while end >= FOOTER:
        start = end - FOOTER - int.from_bytes(packet[end - FOOTER : end - FOOTER + 3], "big")
        if start < 0:
            return False
        mirrored = packet[start:end].translate(MIRRORED)
        # zlib inverts what goes in and what comes out; the format does neither.
        if zlib.crc32(mirrored, 0xFFFFFFFF) != 0xFFFFFFFF:
            return False
        end = start
    return end == 0
