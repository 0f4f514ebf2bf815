from __future__ import annotations

import io
import json
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path
from unittest import mock

import h5py
import numpy as np
import pytest

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.pipeline import Measurement
from labapp.export.frame_result import FrameResult
from labapp.export.hdf5 import Hdf5Writer
from labapp.export.tables import TABLES, frame_tables

ABOUT = {
    "program": "labapp",
    "setup": "[laser]\n# α\n" + "x" * 70_000,
    "settings": {"scheme": "fit", "µ": [1, None]},
}


@pytest.fixture
def written(
    tmp_path: Path, measured: Measurement, unmeasured: Measurement, calibration: ImageCalibration
) -> Path:
    path = tmp_path / "results.h5"
    with Hdf5Writer(path, ABOUT, 0.5) as file:
        for frame, time_s, each in [(12, 1 / 3, measured), (13, None, unmeasured)]:
            tables = frame_tables(FrameResult(frame, time_s, each), calibration)
            file.write(frame, tables, each.reconstruction)
    return path


def test_measures_are_exact_columns_over_the_frames(written: Path, measured: Measurement) -> None:
    with h5py.File(written) as file:
        measures = file["measures"]
        assert set(measures) == {column.name for column in TABLES["measures"]}
        np.testing.assert_array_equal(measures["frame"], [12, 13])
        np.testing.assert_array_equal(measures["time_s"], [1 / 3, np.nan])
        np.testing.assert_array_equal(measures["dots"], [3, 1])
        np.testing.assert_array_equal(measures["rows"], [2, np.nan])
        np.testing.assert_array_equal(measures["width_mm"], [measured.measures.width_mm, np.nan])
        assert list(measures["status"].asstr()) == ["ok", "ambiguous-rows"]
        assert list(measures["reason"].asstr()) == ["", 'two references fit, "a" and "b"']


def test_a_frames_tables_are_exact(
    written: Path, measured: Measurement, calibration: ImageCalibration
) -> None:
    with h5py.File(written) as file:
        frame = file["frames/000012"]
        assert set(frame) == {"dots", "points", "boundary", "surface"}
        dots, points, boundary = (frame[name][()] for name in ("dots", "points", "boundary"))
    np.testing.assert_array_equal(dots["u_px"], measured.dots.u_px)
    np.testing.assert_array_equal(
        np.column_stack([dots["plane_x_mm"], dots["plane_z_mm"]]),
        calibration.to_plane(measured.dots.image_px),
    )
    np.testing.assert_array_equal(dots["reflected_row"], [1, np.nan, 2])
    np.testing.assert_array_equal(dots["ray_column"], [11, np.nan, 9])
    np.testing.assert_array_equal(dots["blocked"], [0, np.nan, 1])
    assert dots["source"].tolist() == [b"auto"] * 3
    found = measured.reconstruction
    np.testing.assert_array_equal(points["ray_row"], found.ray[:, 0])
    np.testing.assert_array_equal(points["sigma_mm"], found.sigma_mm)
    for table, places in ((points, found.points_mm), (boundary, found.boundary.points_mm)):
        np.testing.assert_array_equal(
            np.column_stack([table[f"{axis}_mm"] for axis in "xyz"]), places
        )
    np.testing.assert_array_equal(boundary["theta_deg"], found.boundary.theta_deg)


def test_the_surface_is_a_grid_with_nan_outside(written: Path, measured: Measurement) -> None:
    with h5py.File(written) as file:
        surface = file["frames/000012/surface"]
        x, y, z = (surface[f"{axis}_mm"][()] for axis in "xyz")
    for axis in (x, y):
        np.testing.assert_array_equal(axis, axis[0] + 0.5 * np.arange(len(axis)))
        assert axis[0] <= -2.5
        assert axis[-1] >= 2.5
    assert z.shape == (len(y), len(x))
    found = measured.reconstruction
    x, y = np.meshgrid(x, y)
    inside = found.boundary.contains(x, y)
    assert inside.sum() > 90
    np.testing.assert_array_equal(z, np.where(inside, found.surface.height(x, y), np.nan))


def test_what_a_frame_has_not_is_not_there(written: Path) -> None:
    with h5py.File(written) as file:
        assert set(file["frames"]) == {"000012", "000013"}
        assert set(file["frames/000013"]) == {"dots"}


def test_every_dataset_says_its_unit_and_what_it_is(written: Path) -> None:
    seen = []

    def check(name: str, item: object) -> None:
        if not isinstance(item, h5py.Dataset):
            return
        columns = item.dtype.names or (name.rpartition("/")[2],)
        units, about = (
            np.atleast_1d(item.attrs[key]).astype("S") for key in ("units", "description")
        )
        assert len(units) == len(about) == len(columns)
        for column, unit, text in zip(columns, units, about, strict=True):
            named = column.rpartition("_")[2].encode()
            assert unit == (named if named in b"mm mm2 mm3 px deg s".split() else b"1"), column
            assert len(text) > 2
        seen.append(name)

    with h5py.File(written) as file:
        file.visititems(check)
        x_prime = file["frames/000012/dots"].attrs["description"][2]
    assert x_prime == "place on the imaging plane, X′".encode()
    assert len(seen) == len(TABLES["measures"]) + 4 + 3


def test_the_root_tells_where_it_comes_from(written: Path) -> None:
    with h5py.File(written) as file:
        assert file.attrs["program"] == "labapp"
        assert file.attrs["setup"] == ABOUT["setup"]
        assert json.loads(file.attrs["settings"]) == ABOUT["settings"]


def test_the_same_results_give_the_same_bytes(
    written: Path, tmp_path: Path, measured: Measurement, calibration: ImageCalibration
) -> None:
    contents = []
    for name in ("a.h5", "b.h5"):
        with Hdf5Writer(tmp_path / name, ABOUT, 0.5) as file:
            tables = frame_tables(FrameResult(0, 0.0, measured), calibration)
            file.write(0, tables, measured.reconstruction)
        contents.append((tmp_path / name).read_bytes())
    assert contents[0] == contents[1]


def test_a_run_without_frames_has_columns_of_no_length(tmp_path: Path) -> None:
    with Hdf5Writer(tmp_path / "a.h5", {}, 0.5):
        pass
    with h5py.File(tmp_path / "a.h5") as file:
        assert {len(column) for column in file["measures"].values()} == {0}
        assert not len(file["frames"])


def test_text_that_is_no_text_does_not_stop_it(
    tmp_path: Path, unmeasured: Measurement, calibration: ImageCalibration
) -> None:
    odd = b"caf\xe9.avi and\0 more".decode("utf-8", "surrogateescape")
    with Hdf5Writer(tmp_path / "a.h5", {"source": {"path": odd}, "name": odd}, 0.5) as file:
        each = replace(unmeasured, reason=odd)
        file.write(0, frame_tables(FrameResult(0, None, each), calibration), None)
    with h5py.File(tmp_path / "a.h5") as file:
        for text in (file["measures/reason"].asstr()[0], file.attrs["name"]):
            assert text == r"caf\udce9.avi and\0 more"
        assert json.loads(file.attrs["source"]) == {"path": odd}


class Pulled(io.FileIO):
    """A disk that takes so many bytes, and then Ctrl-C or an error."""

    room = 20_000
    failure: BaseException = KeyboardInterrupt()

    def write(self, content: memoryview) -> int:
        Pulled.room -= len(content)
        if Pulled.room < 0:
            raise Pulled.failure
        return super().write(content)


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), OSError(28, "full")], ids=["^C", "full"])
@pytest.mark.parametrize("room", [0, 100, 5_000, 20_000])
def test_an_error_while_hdf5_writes_comes_out_once_it_has_closed(
    tmp_path: Path,
    measured: Measurement,
    calibration: ImageCalibration,
    room: int,
    failure: BaseException,
) -> None:
    Pulled.room, Pulled.failure = room, failure
    path = tmp_path / "a.h5"
    tables = frame_tables(FrameResult(0, 0.0, measured), calibration)

    def write_many() -> None:
        with Hdf5Writer(path, ABOUT, 0.2) as file:
            for frame in range(20):
                file.write(frame, tables, measured.reconstruction)

    opened = mock.patch.object(Path, "open", lambda self, *_, **__: Pulled(self, "w+"))
    with opened, pytest.raises(type(failure)) as raised:
        write_many()
    assert raised.value is failure


FULL_DISK = """
    import resource, sys
    import numpy as np
    from pathlib import Path
    from labapp.core.geometry.coordinates import ImageCalibration
    from labapp.core.images.dots import Dots
    from labapp.core.pipeline import Measurement
    from labapp.export.frame_result import FrameResult
    from labapp.export.hdf5 import Hdf5Writer
    from labapp.export.tables import frame_tables

    dots = Dots(*np.random.default_rng(0).random((7, 300)))
    found = FrameResult(0, 0.0, Measurement("ok", "", "fit", dots))
    tables = frame_tables(found, ImageCalibration(np.eye(3)))
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
    try:
        with Hdf5Writer(Path(sys.argv[1]), {}, 0.1) as file:
            for frame in range(100):
                file.write(frame, tables, None)
    except OSError as error:
        print(frame, error.strerror)
"""


def test_a_full_disk_is_an_error_and_not_the_end_of_the_process(tmp_path: Path) -> None:
    """HDF5 left to itself ends the process with a fault here."""
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(FULL_DISK), str(tmp_path / "a.h5")],
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": ":".join(sys.path)},
    )
    assert (done.returncode, done.stderr) == (0, "")
    frame, message = done.stdout.split(maxsplit=1)
    assert message == "File too large\n"
    assert 2 < int(frame) < 20
