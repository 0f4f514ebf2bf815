from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labapp.errors import InputError
from labapp.media import open_source
from tests.media.mutate import survives_damage
from tests.media.photron_writer import write_photron

RNG = np.random.default_rng(12)
GREY_8 = [RNG.integers(0, 256, (12, 16), np.uint8) for _ in range(5)]
GREY_10 = [RNG.integers(0, 1024, (12, 16), np.uint16) for _ in range(5)]
GREY_12 = [RNG.integers(0, 4096, (12, 16), np.uint16) for _ in range(5)]
COLOUR_8 = [RNG.integers(0, 256, (12, 16, 3), np.uint8) for _ in range(3)]


@pytest.mark.parametrize("suffix", [".cihx", ".cih"])
@pytest.mark.parametrize(
    ("pictures", "bits", "depth"),
    [(GREY_8, 8, 8), (GREY_10, 10, 10), (GREY_12, 12, 12), (GREY_12, 16, 12)],
    ids=["8 bit", "packed 10 bit", "packed 12 bit", "12 of 16 bit"],
)
def test_every_frame_equals_the_written_one(
    tmp_path: Path, pictures: list[np.ndarray], bits: int, depth: int, suffix: str
) -> None:
    header = write_photron(tmp_path, pictures, bits, depth=depth, suffix=suffix)
    for path in (header, tmp_path / "run.mraw", tmp_path):
        with open_source(path) as source:
            assert (len(source), source.shape, source.bit_depth) == (5, (12, 16), depth)
            assert source.frame_rate_hz == 2000
            assert source.warnings == ()
            for k in (4, 1, 2, 2, 0, 3):
                frame = source.frame(k)
                assert frame.image.dtype == pictures[0].dtype
                np.testing.assert_array_equal(frame.image, pictures[k])
                assert frame.time_s == k / 2000
    assert source.description == f"Photron MRAW, 16×12 px, {depth} bit grey, 2000 frames/s"


def test_effective_bits_on_the_higher_side_are_shifted_down(tmp_path: Path) -> None:
    shifted = [picture << 4 for picture in GREY_12]
    header = write_photron(tmp_path, shifted, 16, depth=12, side="Higher")
    with open_source(header) as source:
        assert source.bit_depth == 12
        np.testing.assert_array_equal([frame.image for frame in source], GREY_12)


@pytest.mark.parametrize(("bits", "scale"), [(8, 1), (12, 16), (16, 257)])
def test_colour_becomes_luminance(tmp_path: Path, bits: int, scale: int) -> None:
    kind = np.uint8 if bits == 8 else np.uint16
    pictures = [picture.astype(kind) * kind(scale) for picture in COLOUR_8]
    header = write_photron(tmp_path, pictures, bits)
    with open_source(header) as source:
        assert "colour" in source.description
        for frame, picture in zip(source, pictures, strict=True):
            expected = picture @ [0.299, 0.587, 0.114]
            np.testing.assert_allclose(frame.image, expected, atol=0.6 * scale)


def test_missing_or_ambiguous_partner_is_named(tmp_path: Path) -> None:
    header = write_photron(tmp_path, GREY_8, 8)
    raw = tmp_path / "run.mraw"
    other = write_photron(tmp_path, GREY_8, 8, suffix=".cih")
    with pytest.raises(InputError, match=r"run\.cih and run\.cihx; expected one of"):
        open_source(raw)
    with open_source(other) as source:
        assert len(source) == 5
    other.unlink()
    header.unlink()
    with pytest.raises(InputError, match=r"run\.mraw: partner: missing; expected run\.cihx or run"):
        open_source(raw)
    header = write_photron(tmp_path, GREY_8, 8)
    raw.rename(tmp_path / "run.MRAW")
    with open_source(header) as source:
        assert len(source) == 5
    (tmp_path / "run.MRAW").unlink()
    with pytest.raises(InputError, match=r"run\.cihx: partner: missing; expected run\.mraw"):
        open_source(header)


def test_truncated_recording_has_its_complete_frames(tmp_path: Path) -> None:
    header = write_photron(tmp_path, GREY_12, 12, rate="x")
    raw = tmp_path / "run.mraw"
    content = raw.read_bytes()
    raw.write_bytes(content[: 3 * 288 + 200])
    with open_source(header) as source:
        np.testing.assert_array_equal([frame.image for frame in source], GREY_12[:3])
        early, timeless = source.warnings
        assert source.frame(1).time_s is None
    assert early == "run.mraw ends early: its header says 5 frames, 3 of them complete"
    assert "has no record rate" in timeless
    raw.write_bytes(content[:200])
    with pytest.raises(InputError, match="200 bytes; expected 288 bytes or more"):
        open_source(header)


def test_frames_skipped_when_saving_are_reported(tmp_path: Path) -> None:
    with open_source(write_photron(tmp_path, GREY_8, 8, step=4)) as source:
        assert "not every frame was saved" in source.warnings[0]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"columns": ""}, "Image Width: missing"),
        ({"columns": 0}, "Image Width: 0; expected a whole number, 1 to"),
        ({"rows": "9" * 30}, "Image Height: 9999"),
        ({"frames": -1}, "Total Frame: -1"),
        ({"bits": 14}, "Color Bit: 14; expected 8, 10, 12 or 16"),
        ({"bits": 16, "colour": "Color"}, "Color Bit: 16; expected 24"),
        ({"side": "Left"}, "EffectiveBit Side: Left"),
        ({"form": "TIFF"}, "File Format: TIFF; expected MRaw"),
        ({"bits": 10, "columns": 15, "rows": 1}, "Image Width: 15; expected rows of 10 bit levels"),
    ],
)
def test_wrong_field_of_the_header_is_named(
    tmp_path: Path, fields: dict[str, object], message: str
) -> None:
    header = write_photron(tmp_path, GREY_8, 8, suffix=".cih", header_fields=fields)
    with pytest.raises(InputError, match=message):
        open_source(header)


def test_header_without_valid_xml_is_rejected(tmp_path: Path) -> None:
    header = write_photron(tmp_path, GREY_8, 8)
    content = header.read_bytes()
    for damaged, message in [
        (content.replace(b"</cih>", b""), "no <cih> … </cih>"),
        (content.replace(b"<width>", b"<wide>"), "expected well-formed XML"),
        (content.replace(b"width", b"wide"), "imageDataInfo/resolution/width: missing"),
    ]:
        header.write_bytes(damaged)
        with pytest.raises(InputError, match=message):
            open_source(header)


def test_damaged_headers_are_read_or_rejected(tmp_path: Path) -> None:
    survives_damage(write_photron(tmp_path, GREY_12, 12), 200, 2000, 3)
    (tmp_path / "run.cihx").unlink()
    survives_damage(write_photron(tmp_path, GREY_12, 12, suffix=".cih"), 200, 2000, 4)
