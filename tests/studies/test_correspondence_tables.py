"""Tables 4-4 and 4-5, stars included, and the examples that §4.2.2.3 draws."""

from pathlib import Path

import numpy as np
import pytest

from labapp.studies import correspondence_table as made

DATA = Path(__file__).parents[1] / "data"


def test_tables_4_4_and_4_5_are_those_of_the_text() -> None:
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
def test_the_examples_show_what_the_text_says_of_them(name: str, expected: str) -> None:
    radius, depth = {one[0]: one[2:] for one in made.EXAMPLES}[name]
    seen = made.cap_reflections(radius, depth)
    assert made.correspondence_letters(seen) == expected
    # The sand timer is wide above and below, and narrow between.
    extent = [
        np.ptp(x[lit]) if lit.sum() > 1 else np.nan
        for x, lit in zip(seen.plane_mm[..., 0], seen.lit, strict=True)
    ]
    known = np.array(extent)[np.isfinite(extent)]
    waist = known.argmin()
    assert (0 < waist < len(known) - 1) == (expected == "I/I*")
