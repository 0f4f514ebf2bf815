"""Rows of tables equal the formatting of each cell by Python, to the last digit."""

from __future__ import annotations

import csv
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.pipeline import Measurement
from labapp.core.surface.measures import Measures, sigma_names
from labapp.export.fixed_point import format_fixed
from labapp.export.frame_result import FrameResult
from labapp.export.tables import (
    TABLES,
    Columns,
    csv_header,
    csv_rows,
    frame_tables,
    nodes_csv,
    number,
    table_rows,
)

NUMBERS = st.one_of(
    st.floats(-1e7, 1e7),
    st.integers(-2000, 2000).map(lambda n: n / 16),  # ties, among others
    st.sampled_from([0.0, -0.0, -4e-7, 4e-7, 0.5, 999999.9999995, math.nan, math.inf, -math.inf]),
)


def rows_by_cell(name: str, table: Columns) -> str:
    columns = TABLES[name]
    cells = [
        [x if c.digits is None else number(x, c.digits) for x in table[c.name].tolist()]
        for c in columns
    ]
    return "".join(",".join(row) + "\n" for row in zip(*cells, strict=True))


@given(st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS), min_size=1, max_size=8))
def test_numbers_are_formatted_as_by_python(rows: list[tuple[float, ...]]) -> None:
    digits = np.array([0, 4, 6])
    text, length = format_fixed(np.array(rows), digits)
    if length >= 0:
        expected = [",".join(map(number, row, digits.tolist())) + "\n" for row in rows]
        assert text[:length].tobytes().decode() == "".join(expected)
    else:  # a number is too close to a tie to be rounded here
        assert any(
            math.isfinite(x) and abs(math.modf(abs(x) * 10.0**d)[0] - 0.5) < 1e-4
            for row in rows
            for x, d in zip(row, digits.tolist(), strict=True)
        )


@pytest.mark.parametrize("sources", [["auto"] * 3, ["auto", "manual", "auto"], []])
def test_tables_with_text_are_formatted_equally(sources: list[str]) -> None:
    rng = np.random.default_rng(2)
    table: Columns = {
        column.name: rng.integers(0, 20, len(sources)).astype(float)
        if column.digits == 0
        else rng.normal(0.0, 90.0, len(sources))
        for column in TABLES["dots"][:-1]
    }
    table["ray_row"][:1] = np.nan
    table["source"] = np.array(sources, object)
    assert csv_rows("dots", table) == rows_by_cell("dots", table)


def test_number_of_many_digits_is_formatted_by_python() -> None:
    assert format_fixed(np.array([[1e12]]), np.array([6]))[1] == -1
    values = np.array([2e-7, 3e12, 1.5])
    table: Columns = {column.name: values for column in TABLES["boundary"]}
    assert csv_rows("boundary", table) == rows_by_cell("boundary", table)


def test_parts_of_an_uncertainty_are_written_on_request() -> None:
    parts = {"": 0.13, "level": 0.04, "setup": 0.12}
    sigmas = {name: value for part, value in parts.items() for name in sigma_names(part)}
    measures = replace(Measures(*[1.0] * 20), **sigmas)
    measurement = Measurement("ok", "", "fit", measures=measures)
    result = FrameResult(0, 0.0, measurement)
    rows = [
        table_rows(result, ImageCalibration(np.eye(3)), parts)["measures"]
        for parts in (False, True)
    ]
    heads = [csv_header("measures", parts) for parts in (False, True)]
    plain, detailed = (
        next(csv.DictReader((head, row))) for head, row in zip(heads, rows, strict=True)
    )
    assert plain.items() <= detailed.items()
    additional = {name: float(detailed[name]) for name in detailed.keys() - plain.keys()}
    assert len(additional) == 27
    for name, value in additional.items():
        expected = 0.04 if "_level" in name else 0.12 if "_setup" in name else 0.03
        assert value == expected, name


@pytest.mark.parametrize("time_s", [None, 0.04])
@pytest.mark.parametrize("parts", [False, True])
def test_rows_of_a_frame_are_those_of_its_tables(time_s: float | None, parts: bool) -> None:
    measured = Measurement("ok", "", "fit", measures=Measures(*np.linspace(-3.0, 1e4, 20)))
    refused = Measurement("no-match", 'no "surface", none', "irs")
    for measurement in (measured, refused):
        result, calibration = FrameResult(7, time_s, measurement), ImageCalibration(np.eye(3))
        tables = frame_tables(result, calibration)
        expected = {name: csv_rows(name, table, parts) for name, table in tables.items()}
        assert table_rows(result, calibration, parts) == expected
        assert list(expected) == list(TABLES)


def test_nodes_have_no_negative_zero() -> None:
    text = nodes_csv(np.array([[-1e-9, -0.0, -4e-7], [-10.0, 0.1, -0.000001]])).decode()
    rows = [[float(cell) for cell in line.split(",")] for line in text.splitlines()[1:]]
    assert rows == [[0.0, 0.0, 0.0], [-10.0, 0.1, -1e-6]]
    assert not np.signbit(rows[0]).any()
