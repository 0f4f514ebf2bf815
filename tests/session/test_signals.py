from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labapp.errors import InputError
from labapp.session.session import Session
from labapp.session.signals import MOST_ROWS, Signals, read_signals


@pytest.fixture
def table(tmp_path: Path):
    def write(text: str | bytes) -> Path:
        path = tmp_path / "logger.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


@pytest.mark.parametrize(
    "text",
    [
        "time_s,current_a,voltage_v\n0,75,11.5\n0.5,76.5,\n",
        "Time (ms);Current (A);Voltage (V)\n0;75;11,5\n500;76,5;\n",
        "Voltage [mV]\tZeit [s]\tStrom [kA]\n11500\t0\t0,075\n\t0,5\t0,0765\n",
        "Logger 7\nserial,12\n\nt,I,U,gas\n0,75,11.5,x\n0.5,76.5,,y\n\n",
        "\ufefftime,weld current,arc_voltage\r\n0,75,11.5\r\n0.5,76.5,\r\n",
        "time_µs,current_ma,voltage_v\n0,75000,11.5\n500000,76500,\n",
    ],
)
def test_tables_of_many_loggers_say_the_same(table, text: str) -> None:
    found = read_signals(table(text))
    assert found.file == "logger.csv"
    np.testing.assert_allclose(found.time_s, [0, 0.5])
    np.testing.assert_allclose(found.current_a, [75, 76.5])
    np.testing.assert_allclose(found.voltage_v, [11.5, np.nan])


def test_one_of_the_two_is_enough(table) -> None:
    found = read_signals(table("time,current\n0,1\n1,2\n"))
    assert found.current_a.tolist() == [1, 2]
    assert np.isnan(found.voltage_v).all()


@pytest.mark.parametrize(
    ("text", "field", "value"),
    [
        ("time,current\n0,1\n1,two\n", "line 3, current", "two"),
        ("time,current\n0,1\nx,2\n", "line 3, time", "x"),
        ("time,current\n0,1\n,2\n", "line 3, time", "nothing"),
        ("time,current\n0,1\ninf,2\n", "line 3, time", "inf"),
        ("about\n\ntime,current\n1,1\n1,2\n", "line 5, time", "1"),
        ("time,current\n0,1\n0.5,1,5\n", "line 3, cells", "3"),
        ("time,current,current_a\n0,1,1\n", "line 1, names", "current twice"),
        ("time,gas\n0,1\n", "columns", "time,gas"),
        ("current,voltage\n0,1\n", "columns", "current,voltage"),
        ("time (h),current\n0,1\n", "columns", "time (h),current"),
        ("time,current\n", "rows", "none"),
        ("", "columns", "nothing"),
        (b"time,current\n0,\xff\n", "encoding", "not UTF-8"),
        (b"t\0i\0m\0e\0", "content", "binary, or UTF-16"),
        ("time,current\n" + "1" * 20000, "line 2", "more than 16384 characters"),
    ],
)
def test_what_is_wrong_is_named_with_line_and_column(table, text, field: str, value: str) -> None:
    path = table(text)
    with pytest.raises(InputError) as caught:
        read_signals(path)
    assert (caught.value.source, caught.value.field) == (str(path), field)
    assert str(caught.value.value) == value


def test_many_problems_are_told_together_and_not_all(table) -> None:
    with pytest.raises(InputError) as caught:
        read_signals(table("time,current\n" + "".join(f"{k},x\n" for k in range(99))))
    assert len(caught.value.problems) == 10


def test_no_file_and_too_long_a_file(table, tmp_path: Path, monkeypatch) -> None:
    with pytest.raises(InputError, match="file"):
        read_signals(tmp_path / "none.csv")
    monkeypatch.setattr("labapp.session.signals.MOST_ROWS", 3)
    with pytest.raises(InputError, match="at most 3"):
        read_signals(table("time,current\n" + "".join(f"{k},1\n" for k in range(9))))
    assert MOST_ROWS * 8 * 3 < 100_000_000  # as a session can hold them


def test_a_session_keeps_them_and_can_undo_that(tmp_path: Path) -> None:
    signals = Signals("a.csv", np.arange(3.0), np.arange(3.0), np.full(3, np.nan), 0.25)
    path = tmp_path / "a.labsession"
    with Session.create(path) as session:
        assert session.signals is None
        session.set_signals(signals)
    with Session.open(path) as session:
        found = session.signals
        assert found is not None
        assert (found.file, found.start_s) == ("a.csv", 0.25)
        np.testing.assert_array_equal(found.voltage_v, signals.voltage_v)
        assert session.problems() == []
        session.undo()
        assert session.signals is None
