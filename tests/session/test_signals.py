from __future__ import annotations

import contextlib
import os
from pathlib import Path

import numpy as np
import pytest

from labapp.errors import InputError
from labapp.session.session import Session
from labapp.session.signals import MOST_ROWS, Signals, read_signals
from labapp.system import IS_WINDOWS


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
def test_tables_of_various_loggers_are_read(table, text: str) -> None:
    signals = read_signals(table(text))
    assert signals.file == "logger.csv"
    np.testing.assert_allclose(signals.time_s, [0, 0.5])
    np.testing.assert_allclose(signals.current_a, [75, 76.5])
    np.testing.assert_allclose(signals.voltage_v, [11.5, np.nan])


def test_table_may_have_only_a_current(table) -> None:
    signals = read_signals(table("time,current\n0,1\n1,2\n"))
    assert signals.current_a.tolist() == [1, 2]
    assert np.isnan(signals.voltage_v).all()


@pytest.mark.parametrize(
    ("text", "field", "value"),
    [
        ("time,current\n0,1\n1,two\n", "line 3, current", "two"),
        ("time,current\n0,1\nx,2\n", "line 3, time", "x"),
        ("time,current\n0,1\n,2\n", "line 3, time", "nothing"),
        ("time,current\n0,1\ninf,2\n", "line 3, time", "inf"),
        ("about\n\ntime,current\n1,1\n1,2\n", "line 5, time", "1"),
        ("time,current\n0,1\n0.5,1,5\n", "line 3, cells", "3"),
        ('time,current,gas\n0,1,Ar\n1,2,"Ar\n2,3,Ar\n', "syntax", "unexpected end of data"),
        ("time;current\n0.5;1\n1;1,234\n", "line 3, current", "1,234"),
        ("time;current\n0,5;1\n1.000;2\n", "line 3, time", "1.000"),
        ("time,current\n0,\n1,\n", "current, voltage, wire", "no numbers"),
        ("time,current\n0,1e300\n1,\n", "line 2, current", "1e300"),
        ("time,current\n0,1\n1e300,1\n", "line 3, time", "1e300"),
        ("time_s,current_ka\n0,1e11\n1,\n", "current", "1e+14"),
        ("time,current,current_a\n0,1,1\n", "line 1, names", "current twice"),
        ("time,gas\n0,1\n", "columns", "time,gas"),
        ("current,voltage\n0,1\n", "columns", "current,voltage"),
        ("time (h),current\n0,1\n", "columns", "time (h),current"),
        ("time,current\n", "rows", "none"),
        ("", "columns", "nothing"),
        (b"time,current\n0,\xff\n", "encoding", "not UTF-8"),
        (b"t\0i\0m\0e\0", "content", "binary or UTF-16"),
        ("time,current\n" + "1" * 20000, "line 2", "more than 16384 characters"),
    ],
)
def test_wrong_cells_are_reported_with_line_and_column(table, text, field: str, value: str) -> None:
    path = table(text)
    with pytest.raises(InputError) as caught:
        read_signals(path)
    assert (caught.value.source, caught.value.field) == (str(path), field)
    assert str(caught.value.value) == value


def test_at_most_ten_problems_are_reported(table) -> None:
    with pytest.raises(InputError) as caught:
        read_signals(table("time,current\n" + "".join(f"{k},x\n" for k in range(99))))
    assert len(caught.value.problems) == 10


def test_missing_file_and_too_long_table_are_rejected(table, tmp_path: Path, monkeypatch) -> None:
    with pytest.raises(InputError, match="file"):
        read_signals(tmp_path / "none.csv")
    monkeypatch.setattr("labapp.session.signals.MOST_ROWS", 3)
    with pytest.raises(InputError, match="at most 3"):
        read_signals(table("time,current\n" + "".join(f"{k},1\n" for k in range(9))))
    assert MOST_ROWS * 8 * 3 < 100_000_000  # the limit of a session


def test_signals_are_stored_in_a_session_until_undo(tmp_path: Path) -> None:
    signals = Signals("a.csv", np.arange(3.0), np.arange(3.0), np.full(3, np.nan), 0.25)
    path = tmp_path / "a.labsession"
    with Session.create(path) as session:
        assert session.signals is None
        session.set_signals(signals)
    with Session.open(path) as session:
        stored = session.signals
        assert stored is not None
        assert (stored.file, stored.start_s) == ("a.csv", 0.25)
        np.testing.assert_array_equal(stored.voltage_v, signals.voltage_v)
        assert session.problems() == []
        session.undo()
        assert session.signals is None


def write_tdms(path: Path, channels) -> Path:
    from nptdms import ChannelObject, TdmsWriter

    with TdmsWriter(path) as writer:
        writer.write_segment([ChannelObject("weld", *channel) for channel in channels])
    return path


def test_tdms_with_an_increment_and_units(tmp_path: Path) -> None:
    wave = {"wf_increment": 0.001, "wf_start_offset": 0.5, "unit_string": "mV"}
    channels = [
        ("Arc Voltage", np.array([11e3, 12e3, 13e3]), wave),
        ("Current", np.array([70, 80, 90], np.int16), {}),
        ("WFS", np.array([10.0, 20.0, 30.0]), {"unit_string": "mm/s"}),
        ("gas", np.array([1.0]), {}),
    ]
    signals = read_signals(write_tdms(tmp_path / "a.tdms", channels))
    np.testing.assert_allclose(signals.time_s, [0.5, 0.501, 0.502])
    np.testing.assert_allclose(signals.voltage_v, [11, 12, 13])
    np.testing.assert_allclose(signals.current_a, [70, 80, 90])
    np.testing.assert_allclose(signals.wire_m_min, [0.6, 1.2, 1.8])
    assert list(signals.channels) == ["current", "voltage", "wire"]


@pytest.mark.parametrize("name", ["Current", "Current (A)"])
def test_tdms_with_a_wrong_unit_is_rejected(tmp_path: Path, name: str) -> None:
    """The volts of a shunt are not amperes; a unit in the name has priority."""
    properties = {"wf_increment": 0.001, "unit_string": "V"}
    path = write_tdms(tmp_path / "a.tdms", [(name, np.array([1.0, np.inf]), properties)])
    if name == "Current":
        with pytest.raises(InputError, match="unit of Current"):
            read_signals(path)
    else:
        np.testing.assert_array_equal(read_signals(path).current_a, [1, np.nan])


def test_wav_is_scaled_and_averaged_to_the_limit_of_rows(tmp_path: Path, monkeypatch) -> None:
    from scipy.io import wavfile

    path, samples = tmp_path / "a.wav", np.array([[0, 16384], [16384, 0]] * 8, np.int16)
    wavfile.write(path, 1000, samples)
    signals = read_signals(path, (200.0, 50.0, 1.0))
    np.testing.assert_allclose(signals.time_s, np.arange(16) / 1000)
    np.testing.assert_allclose(signals.current_a[:2], [0, 100])
    np.testing.assert_allclose(signals.voltage_v[:2], [25, 0])
    assert np.isnan(signals.wire_m_min).all()
    monkeypatch.setattr("labapp.session.signals.MOST_ROWS", 4)
    signals = read_signals(path, (200.0, 50.0, 1.0))
    np.testing.assert_allclose(signals.current_a, 50)
    np.testing.assert_allclose(signals.time_s, [0.0015, 0.0055, 0.0095, 0.0135])


def test_tdms_with_two_channels_of_a_quantity_is_rejected(tmp_path: Path) -> None:
    wave = {"wf_increment": 0.001}
    channels = [("current", np.ones(3), wave), ("Current (A)", np.zeros(3), wave)]
    with pytest.raises(InputError, match=r"channels: Current \(A\), another one"):
        read_signals(write_tdms(tmp_path / "a.tdms", channels))


@pytest.mark.parametrize("scale", [0.0, np.nan])
def test_full_scale_must_be_a_number(tmp_path: Path, scale: float) -> None:
    from scipy.io import wavfile

    wavfile.write(tmp_path / "a.wav", 1000, np.ones((9, 2), np.int16))
    with pytest.raises(InputError, match="full scale"):
        read_signals(tmp_path / "a.wav", (1.0, scale, 1.0))


@pytest.mark.skipif(IS_WINDOWS, reason="no pipes in folders")
@pytest.mark.parametrize("name", ["a.csv", "a.tdms", "a.wav"])
def test_pipe_is_rejected_instead_of_waiting_for_it(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match="pipe"):
        read_signals(tmp_path / name)


@pytest.mark.parametrize("name", ["a.tdms", "a.wav"])
def test_mutated_binary_files_are_read_or_rejected(tmp_path: Path, monkeypatch, name: str) -> None:
    from scipy.io import wavfile

    path = tmp_path / name
    with pytest.raises(InputError, match="file"):
        read_signals(path)
    if name == "a.wav":
        wavfile.write(path, 1000, np.zeros((64, 2), np.int16))
    else:
        wave = {"wf_increment": 0.001}
        write_tdms(path, [("current", np.arange(64.0), wave)])
    good = path.read_bytes()
    rng = np.random.default_rng(4)
    for _ in range(60):
        bad = bytearray(good)
        for index in rng.integers(0, min(len(bad), 200), 4):
            bad[index] = int(rng.integers(256))
        path.write_bytes(bytes(bad[: rng.integers(1, len(bad) + 1)]))
        with contextlib.suppress(InputError):
            assert len(read_signals(path).time_s) < 1000
    path.write_bytes(good)
    monkeypatch.setattr("labapp.session.signals.LARGEST_FILE", 100)
    with pytest.raises(InputError, match="at most 100"):
        read_signals(path)


def test_wire_feed_is_read_from_a_table(table) -> None:
    signals = read_signals(table("time,WFS [in/min]\n0,100\n1,200\n"))
    np.testing.assert_allclose(signals.wire_m_min, [2.54, 5.08])
    assert list(signals.channels) == ["wire"]
