"""Tables 4-1 and 4-2, Fig. 4-11, L1, L2 and D1, compared with the dissertation."""

from pathlib import Path

import numpy as np
import pytest

from labapp.studies import positioning_tables as made
from labapp.studies.tables import Table

DATA = Path(__file__).parents[1] / "data"


def test_tables_4_1_and_4_2_agree_with_the_dissertation() -> None:
    for table in made.blocking_tables():
        expected = (DATA / f"{table.name}.csv").read_text("utf-8")
        cells = [cell for row in table.rows for cell in row[1:]]
        assert len(cells) == 36
        assert table.csv() == expected


def test_all_dots_are_on_the_plane_at_30_and_50_mm_only() -> None:
    placements = made.coverage()
    assert [one.distance_mm for one in placements] == [30, 50, 70, 90]
    off_plane = [int((~one.on_plane).sum()) for one in placements]
    assert off_plane[:2] == [0, 0]
    assert 0 < off_plane[2] < off_plane[3] < len(placements[3].on_plane) / 2
    assert {len(one.on_plane) for one in placements} == {len(placements[0].on_plane)}
    rows = made.coverage_table(placements).rows
    assert [row[3] for row in rows] == off_plane
    assert all(row[2] + row[3] == row[1] for row in rows)


def test_l1_l2_and_d1_agree_with_the_equations() -> None:
    table = made.clearance_table()
    rows = {tuple(row[:2]): dict(zip(table.columns, row, strict=True)) for row in table.rows}
    height, horizontal = 30 * np.sin(np.radians(30)), 30 * np.cos(np.radians(30))
    flat = rows[30, "flat"]
    assert flat["l1_mm"] == pytest.approx(5 * horizontal / (height - 5))  # Eq. 4-14
    assert flat["l2_mm"] == pytest.approx(5 * horizontal / (height + 5))  # Eq. 4-15
    l2 = flat["l2_mm"]
    assert flat["d1_most_mm"] == pytest.approx((101.6 * l2 - 5 * l2) / 5)  # Eq. 4-16
    for depth in ("r/10", "r/5"):
        convex, concave = (rows[30, f"{kind}, d = {depth}"] for kind in ("convex", "concave"))
        assert convex["l1_mm"] == concave["l1_mm"] == flat["l1_mm"]
        assert convex["l2_mm"] < l2 < concave["l2_mm"]
        # Eq. 4-17: the slope at the edge of an arc of sagitta d over the half chord r.
        beta = 2 * np.arctan(0.1 if depth == "r/10" else 0.2)
        c = np.arctan2(height, horizontal - convex["l2_mm"])
        assert 5 / np.tan(2 * beta + c) == pytest.approx(convex["l2_mm"], rel=1e-9)
        assert np.degrees(beta) == pytest.approx(convex["head_slope_deg"])


def test_table_leaves_unknown_cells_empty() -> None:
    table = Table("t", "A caption", ("a", "b_mm"), (("x, y", 0.123456789), (1, None)))
    assert table.csv() == 'a,b_mm\n"x, y",0.123457\n1,\n'
    assert table.markdown().splitlines() == [
        "**A caption**",
        "",
        "| a    | b_mm  |",
        "| ---- | ----- |",
        "| x, y | 0.123 |",
        "| 1    |       |",
    ]
    assert Table("t", "", ("a", "b"), ((float("nan"), 2),)).csv() == "a,b\n,2\n"
