"""Tables 4-4 and 4-5, including stars, and the examples drawn in §4.2.2.3."""

from pathlib import Path

import numpy as np
import pytest

from labapp.studies import correspondence_table as made

DATA = Path(__file__).parents[1] / "data"


def test_tables_4_4_and_4_5_agree_with_the_dissertation() -> None:
    for table in made.correspondence_tables():
        expected = (DATA / f"{table.name}.csv").read_text("utf-8")
        assert sum(len(row) - 1 for row in table.rows) == 20
        assert table.csv() == expected


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("figure_4_17_concave", "I/I"),
        ("figure_4_18_sand_timer", "I/I*"),
        ("figure_4_20_convex", "S/S"),
    ],
)
def test_examples_have_the_stated_correspondence(name: str, expected: str) -> None:
    radius, depth = {one[0]: one[2:] for one in made.EXAMPLES}[name]
    reflections = made.cap_reflections(radius, depth)
    assert made.correspondence_letters(reflections) == expected
    # The sand timer is wide at top and bottom, and narrow in between.
    extent = [
        np.ptp(x[lit]) if lit.sum() > 1 else np.nan
        for x, lit in zip(reflections.plane_mm[..., 0], reflections.lit, strict=True)
    ]
    known = np.array(extent)[np.isfinite(extent)]
    waist = known.argmin()
    assert (0 < waist < len(known) - 1) == (expected == "I/I*")
