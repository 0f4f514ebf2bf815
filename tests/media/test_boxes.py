"""MP4 files whose headers claim more frames than they contain."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from labapp.errors import InputError
from labapp.media import open_source
from tests.scripts import peak_mb

H264 = Path(__file__).parent / "data" / "h264.mp4"

MANY = 30_000_000


def box(kind: bytes, *content: bytes) -> bytes:
    body = b"".join(content)
    return struct.pack(">I", 8 + len(body)) + kind + body


def changed(content: bytes, kind: bytes, offset: int, *values: int) -> bytes:
    """Return the file with other numbers after the type of its first box of a kind."""
    start = content.index(kind) + 4 + offset
    new = struct.pack(f">{len(values)}I", *values)
    return content[:start] + new + content[start + len(new) :]


def many_samples() -> bytes:
    """One chunk of equally long frames of one byte each."""
    content = changed(H264.read_bytes(), b"stsz", 4, 1, MANY)
    content = changed(content, b"stts", 4, 1, MANY, 512)
    content = changed(content, b"stsc", 4, 1, 1, MANY, 1)
    return content.replace(b"ctts", b"free")


def many_in_a_fragment() -> bytes:
    head = struct.pack(">II", 0x20000, 1)
    run = box(b"traf", box(b"tfhd", head), box(b"trun", struct.pack(">II", 0, MANY)))
    return H264.read_bytes() + box(b"moof", box(b"mfhd", bytes(8)), run)


def many_edits() -> bytes:
    return H264.read_bytes() + box(b"free", box(b"elst", struct.pack(">II", 0, MANY)))


def packed() -> bytes:
    return H264.read_bytes() + box(b"moov", box(b"cmov", bytes(8)))


@pytest.mark.parametrize("forge", [many_samples, many_in_a_fragment, many_edits, packed])
def test_impossible_number_of_samples_is_rejected(tmp_path: Path, forge: object) -> None:
    path = tmp_path / "v.mp4"
    path.write_bytes(forge())
    with pytest.raises(InputError, match=r"samples and edits: .*no more frames"):
        open_source(path)


def test_file_that_would_fill_the_memory_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    path.write_bytes(many_samples())
    script = """
        import sys
        from labapp.errors import InputError
        from labapp.media import open_source
        try:
            open_source(sys.argv[1])
        except InputError:
            pass
    """
    assert peak_mb(script, path) < 300


def test_only_tables_of_samples_are_checked(tmp_path: Path) -> None:
    """Frames may contain any bytes, and a box may have a length of eight bytes."""
    inside = box(b"stsz", bytes(8), b"\xff" * 4)
    longer = struct.pack(">I4sQ", 1, b"free", 32) + bytes(16)
    path = tmp_path / "v.mp4"
    path.write_bytes(H264.read_bytes() + longer + box(b"mdat", inside))
    with open_source(path) as source, open_source(H264) as original:
        assert len(source) == len(original)
    path.write_bytes(
        H264.read_bytes() + box(b"free", struct.pack(">I4sQ3I", 1, b"stsz", 28, 0, 0, MANY))
    )
    with pytest.raises(InputError, match="samples and edits"):
        open_source(path)


def test_file_without_the_start_of_an_mp4_is_rejected(tmp_path: Path) -> None:
    """FFmpeg would accept it because of the following boxes and its name."""
    path = tmp_path / "v.mp4"
    path.write_bytes(box(b"test") + many_samples())
    with pytest.raises(InputError, match="not a video"):
        open_source(path)
