from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labapp.core.images.dots import Dots
from labapp.core.rows.correction import Correction
from labapp.core.rows.lattice import Lattice
from labapp.errors import InputError
from labapp.session.corrections.csv_file import MOST_DOTS, read_correction

SHAPE = (100, 200)
HEAD = "u_px,v_px,reflected_row,reflected_column"


@pytest.fixture
def before() -> Correction:
    """Three dots in a row, each with another uncertainty; the last was moved by hand."""
    u = np.array([10.12345678, 30.0, 50.0])
    dots = Dots(u, np.full(3, 20.0), *np.array([[0.1, 0.2, 0.3]] * 2), *np.full((3, 3), 2.0))
    lattice = Lattice(np.array([1, 1, 1]), np.array([1, 2, 3]), reference=(1, 9))
    return Correction(dots, lattice, np.array([False, False, True]))


def read(tmp_path: Path, text: str | bytes, before: Correction, frame: int = 0) -> Correction:
    path = tmp_path / "dots.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_correction(path, frame, SHAPE, before)


def test_unchanged_table_changes_only_the_reference(tmp_path: Path, before: Correction) -> None:
    """Tables are rounded to 0.0001 px; dots keep their exact positions."""
    correction = read(tmp_path, f"{HEAD}\n10.1235,20,1,1\n30,20,1,2\n50,20,1,3\n", before)
    np.testing.assert_array_equal(correction.dots.u_px, before.dots.u_px)
    np.testing.assert_array_equal(correction.dots.u_sigma_px, before.dots.u_sigma_px)
    assert correction.lattice.column.tolist() == [1, 2, 3]
    assert correction.manual.tolist() == [False, False, True]
    assert correction.lattice.reference is None


def test_changed_dots_are_marked_as_manual(tmp_path: Path, before: Correction) -> None:
    text = f"{HEAD}\n30.5,20,1,2\n10.1235,20,2,1\n80,20.5,,\n"
    correction = read(tmp_path, text, before)
    assert correction.dots.image_px.tolist() == [[30.5, 20], [10.12345678, 20], [80, 20.5]]
    assert correction.dots.u_sigma_px.tolist() == [0.2, 0.1, 2.0]  # by hand: the size of a dot
    assert correction.lattice.row.tolist() == [1, 2, 0]
    assert correction.manual.tolist() == [True, True, True]


def test_uncertainty_is_copied_to_the_nearest_dot_only(tmp_path: Path, before: Correction) -> None:
    correction = read(tmp_path, f"{HEAD}\n30.6,20,1,2\n30,20,1,3\n", before)
    assert correction.dots.u_sigma_px.tolist() == [2.0, 0.2]


def test_table_for_a_frame_without_dots(tmp_path: Path) -> None:
    correction = read(tmp_path, f"{HEAD}\n30,20,1,2\n", Correction.of(None, None))
    assert (len(correction.dots), correction.manual.tolist()) == (1, [True])
    assert correction.dots.u_sigma_px[0] >= 0.5


@pytest.mark.parametrize(
    "text",
    [
        f"\ufeff{HEAD}\n10.5,20,1,1\n30,20,1,2\n",
        f"{HEAD}\r\n10.5,20,1,1\r\n\r\n30,20,1,2\r\n",
        HEAD.replace(",", ";") + "\n10,5;20;1;1\n30,0;20;1;2\n",
        HEAD.replace(",", "\t") + "\n10.5\t20\t1\t1\n30\t20\t1\t2\n",
        f"{HEAD}\n10.5,20,1.0,1\n 30 ,20,1,2.0\n",
        '"u_px","v_px","reflected_row","reflected_column"\n"10.5","20",1,1\n30,20,1,2\n',
        "snr,reflected_column,reflected_row,v_px,u_px\nx,1,1,20,10.5\n,2,1,20,30\n",
        f"frame,{HEAD}\n7,1,2,5,5\n0,10.5,20,1,1\n0,30,20,1,2\n7,,,,\n",
    ],
)
def test_tables_of_various_programs_are_read(tmp_path: Path, before: Correction, text: str) -> None:
    correction = read(tmp_path, text, before)
    assert correction.dots.image_px.tolist() == [[10.5, 20], [30, 20]]
    assert correction.lattice.row.tolist() == [1, 1]
    assert correction.lattice.column.tolist() == [1, 2]


def test_blocked_rows_are_marked(tmp_path: Path, before: Correction) -> None:
    text = f"{HEAD},blocked\n10,20,1,1,0\n30,20,2,1,1\n50,20,2,2,\n70,20,,,\n"
    assert read(tmp_path, text, before).lattice.blocked_rows == frozenset({2})


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("nan,20,1,1", "line 2, u_px: nan; expected a number from -0.5 to 199.5 (px, within"),
        ("inf,20,1,1", "line 2, u_px: inf; expected a number"),
        ("x,20,1,1", "line 2, u_px: x; expected a number"),
        (",20,1,1", "line 2, u_px: nothing; expected a number"),
        ("1_0,20,1,1", "line 2, u_px: 1_0; expected a number"),
        ("200,20,1,1", "line 2, u_px: 200; expected a number from -0.5 to 199.5"),
        ("10,-1,1,1", "line 2, v_px: -1; expected a number from -0.5 to 99.5"),
        ("10,20,0,1", "line 2, reflected_row: 0; expected a whole number from 1 to 1000"),
        ("10,20,-1,1", "line 2, reflected_row: -1; expected a whole number from 1"),
        ("10,20,1,1.5", "line 2, reflected_column: 1.5; expected a whole number"),
        ("10,20,1,1e9", "line 2, reflected_column: 1e9; expected a whole number"),
        ("10,20,1", "line 2, cells: 3; expected 4, as in the first line; decimal commas need ;"),
        ("10,5,20,1,1", "line 2, cells: 5; expected 4"),
        ('"10,5",20,1,1', "line 2, u_px: 10,5; expected a number"),
        ("10,20,1,1\n50,20,1,1", "line 3, reflected_row, reflected_column: row 1, column 1; exp"),
        (
            "10,20,1,1\n10,20,1,2",
            "line 3, u_px, v_px: 10, 20; expected another position than that of line 2",
        ),
    ],
)
def test_wrong_cells_are_reported_with_line_and_column(
    tmp_path: Path, before: Correction, line: str, message: str
) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, f"{HEAD}\n{line}\n", before)
    assert str(caught.value).startswith(f"{tmp_path / 'dots.csv'}: {message}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "columns: no u_px, no v_px, no reflected_row, no reflected_column; expected a table"),
        ("u_px,v_px\n1,2\n", "columns: no reflected_row, no reflected_column"),
        (f"{HEAD},u_px\n1,2,3,4,5\n", "columns: u_px twice"),
        (f'{HEAD},note\n1,2,5,5,\n9,2,5,6,"x\n9,9,6,6,\n', "syntax: unexpected end of data"),
        (f"{HEAD}\n", "rows: no dot; expected a row for each dot of the frame"),
        (f"frame,{HEAD}\n3,1,2,5,5\n", "rows: no dot of frame 0; expected"),
        (f"frame,{HEAD}\n{'9' * 5000},1,2,5,5\n", "line 2, frame: 9999"),
        (f"frame,{HEAD}\n" + "x,1,2,5,5\n" * 99, "line 2, frame: x; expected a number of a fr"),
        (f"frame,{HEAD}\n-1,1,2,5,5\n", "line 2, frame: -1; expected a number of a frame"),
        (f"{HEAD},blocked\n1,2,5,5,2\n", "line 2, blocked: 2; expected 1, 0 or nothing"),
        (f"{HEAD},blocked\n1,2,,,1\n", "line 2, blocked: 1; expected a dot with a row"),
        (f"{HEAD},blocked\n1,2,5,5,1\n2,2,5,6,0\n", "line 3, blocked: 0; expected 1 as in line 2"),
        (HEAD.encode("utf-16"), "content: binary or UTF-16; expected a table of dots (CSV"),
        (f"{HEAD}\n1,2,3,é\n".encode("latin-1"), "encoding: not UTF-8"),
        (b"\x89PNG\r\n\x1a\n\0\0", "content: binary"),
        (b"x" * 1_000_000, "line 1: more than 16384 characters"),
        (f'{HEAD}\n"' + "1\n" * 100_000, "syntax: field larger than field limit"),
    ],
)
def test_invalid_table_is_rejected(
    tmp_path: Path, before: Correction, text: str | bytes, message: str
) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, text, before)
    assert str(caught.value).startswith(f"{tmp_path / 'dots.csv'}: {message}")


def test_at_most_ten_problems_are_reported(tmp_path: Path, before: Correction) -> None:
    lines = "\n".join(f"{k},nan,{k + 1},0" for k in range(50))
    with pytest.raises(InputError) as caught:
        read(tmp_path, f"{HEAD}\n{lines}\n", before)
    assert len(caught.value.problems) == 10


def test_huge_files_are_rejected(tmp_path: Path, before: Correction) -> None:
    path = tmp_path / "dots.csv"
    with path.open("wb") as file:
        file.truncate(1 << 32)
    with pytest.raises(InputError, match="size: 4294967296 bytes; expected at most"):
        read_correction(path, 0, SHAPE, before)
    rows = "".join(f"{k % 199},{k % 99},,\n" for k in range(3 * MOST_DOTS))
    with pytest.raises(InputError, match=f"expected at most {MOST_DOTS} dots"):
        read(tmp_path, f"{HEAD}\n{rows}", before)


def test_folder_is_rejected(tmp_path: Path, before: Correction) -> None:
    with pytest.raises(InputError, match="file: is a folder"):
        read_correction(tmp_path, 0, SHAPE, before)


@given(st.data())
def test_mutated_tables_are_read_or_rejected(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    content = bytearray(f"frame,{HEAD},blocked\n0,10.5,20,1,1,0\n0,30,20,1,2,0\n".encode())
    for _ in range(data.draw(st.integers(1, 4))):
        index = data.draw(st.integers(0, len(content) - 1))
        content[index : index + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
        content = content or bytearray(b"\n")
    path = tmp_path_factory.getbasetemp() / "mutated.csv"
    path.write_bytes(content)
    try:
        correction = read_correction(path, 0, SHAPE, Correction.of(None, None))
    except InputError:
        return
    assert len(correction.dots) >= 1
    assert np.isfinite(correction.dots.image_px).all()
