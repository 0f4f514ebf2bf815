from __future__ import annotations

import pytest

from labapp.media.base import format_frame_rate


@pytest.mark.parametrize(
    ("rate_hz", "text"),
    [
        (1.0, "1 frame/s"),
        (60.0, "60 frames/s"),
        (0.5, "0.5 frames/s"),
        (30000 / 1001, "29.97 frames/s"),
        (60000 / 1001, "59.94 frames/s"),
        (0.999999, "1 frame/s"),
        (22_000.4, "22000 frames/s"),
        (1_234_567.0, "1234567 frames/s"),
    ],
)
def test_frame_rate_is_formatted_with_sensible_digits(rate_hz: float, text: str) -> None:
    assert format_frame_rate(rate_hz) == text
