"""The measurement error of a known object of the user (§8.2)."""

from __future__ import annotations

import pytest

from labapp.core.geometry.bench import Bench
from labapp.core.pipeline import Settings, measure
from labapp.core.schemes import SCHEMES
from labapp.errors import InputError
from labapp.simulation.forward import exact_match, trace
from labapp.studies.image_error import TACK, TACK_RIG, VIEW, axes_of, rendered
from labapp.studies.known_object import known_cap, known_object_table


def named_rows(table) -> dict[str, dict[str, object]]:
    return {str(row[0]): dict(zip(table.columns, row, strict=True)) for row in table.rows}


def test_errors_are_relative_to_the_entered_size() -> None:
    match = exact_match(trace(TACK, TACK_RIG))
    right = named_rows(known_object_table(match, TACK_RIG, known_cap(9.75, 0.91)))
    assert set(right) == set(SCHEMES) >= {"fit", "ers", "irs", "zonal", "modal"}
    assert right["fit"]["height_error_pct"] < 1
    assert right["fit"]["diameter_error_pct"] < 1
    assert right["ers"]["diameter_error_pct"] < 3
    wrong = named_rows(known_object_table(match, TACK_RIG, known_cap(9.75, 0.7)))
    assert wrong["fit"]["height_mm"] == pytest.approx(right["fit"]["height_mm"])
    assert wrong["fit"]["height_error_pct"] == pytest.approx(30, abs=1)


@pytest.mark.slow
def test_rendered_tack_is_measured_as_in_section_8_2() -> None:
    frame = rendered(TACK, TACK_RIG, 0)
    result = measure(frame.image, Bench(TACK_RIG, axes_of(VIEW).calibration), Settings())[0]
    assert result.match is not None
    rows = named_rows(known_object_table(result.match, TACK_RIG, TACK))
    assert rows["fit"]["height_error_pct"] < 2
    assert rows["ers"]["height_error_pct"] < 15


@pytest.mark.parametrize(("diameter", "height"), [(0.0, 0.1), (40, 1), (9, 0), (9, 3), (9, -3)])
def test_impossible_object_is_rejected(diameter: float, height: float) -> None:
    with pytest.raises(InputError):
        known_cap(diameter, height)
