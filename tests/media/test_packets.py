"""The stored index of a video is not trusted."""

from __future__ import annotations

import dataclasses
import io
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from labapp.media.formats.packets import MAGIC, PacketTable
from labapp.media.formats.video import VideoSource
from tests.scripts import peak_mb

COUNT = 12


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "v.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 60, (64, 48))
    for k in range(COUNT):
        writer.write(np.full((48, 64, 3), 10 * k, np.uint8))
    writer.release()
    return path


def indexed(path: Path) -> tuple[PacketTable, tuple[int, int]]:
    with VideoSource(path) as source:
        return source._table, source._fingerprint


FORGED: dict[str, dict[str, object]] = {
    "frames": {"number": np.arange(COUNT) + 10**6},
    "before": {"number": np.arange(COUNT) - 5},
    "type": {"time_s": np.full(COUNT, "x")},
    "shape": {"place": np.zeros((COUNT, 2), int)},
    "no packet": {
        "place": np.zeros(0, int),
        "key": np.zeros(0, bool),
        "seek": np.zeros((0, 2), int),
        "number": np.zeros(0, int),
    },
    "keys": {"seek": np.zeros((0, 2), int)},
    "no frame": {"time_s": np.zeros(0)},
    "word": {"bit_depth": "eight"},
    "rate": {"frame_rate_hz": float("nan")},
    "place": {"placed_by": "__class__"},
    "size": {"shape": None},
    "warning": {"warnings": (5,)},
}


@pytest.mark.parametrize("forged", FORGED.values(), ids=FORGED)
def test_forged_index_is_ignored(path: Path, forged: dict[str, object]) -> None:
    """Its checksum and that of the video are correct."""
    table, fingerprint = indexed(path)
    index = dataclasses.replace(table, **forged).to_bytes(fingerprint)
    with VideoSource(path, index) as source:
        assert source.index == table.to_bytes(fingerprint)
        assert [frame.image[0, 0] // 10 for frame in source] == list(range(COUNT))


@pytest.mark.parametrize("outside", [True, False])
def test_index_that_would_fill_the_memory_is_ignored(path: Path, outside: bool) -> None:
    """Either the index or its arrays are highly compressed."""
    table, fingerprint = indexed(path)
    content = zlib.decompress(table.to_bytes(fingerprint)[len(MAGIC) + 4 :])
    others = content[: 4 + int.from_bytes(content[:4], "big")]
    arrays = io.BytesIO()
    with (
        zipfile.ZipFile(arrays, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("time_s.npy", "w") as file,
    ):
        header = {"descr": "<f8", "fortran_order": False, "shape": (10**8,)}
        np.lib.format.write_array_header_1_0(file, header)
        for _ in range(0 if outside else 80):
            file.write(bytes(10**7))
    packer = zlib.compressobj()
    parts = [packer.compress(others + arrays.getvalue())]
    parts += [packer.compress(bytes(10**7)) for _ in range(80 if outside else 0)]
    body = b"".join([*parts, packer.flush()])
    (path.parent / "index").write_bytes(MAGIC + zlib.crc32(body).to_bytes(4, "big") + body)
    script = """
        import sys
        from pathlib import Path
        from labapp.media.formats.video import VideoSource
        VideoSource(Path(sys.argv[1]), Path(sys.argv[2]).read_bytes()).frame(0)
    """
    assert peak_mb(script, path, path.parent / "index") < 600
