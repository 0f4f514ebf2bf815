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
        for frame, time_s, measurement in [(12, 1 / 3, measured), (13, None, unmeasured)]:
            tables = frame_tables(FrameResult(frame, time_s, measurement), calibration)
            file.write(frame, tables, measurement.reconstruction)
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


def test_tables_of_a_frame_are_exact(
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
    reconstruction = measured.reconstruction
    np.testing.assert_array_equal(points["ray_row"], reconstruction.ray[:, 0])
    np.testing.assert_array_equal(points["sigma_mm"], reconstruction.sigma_mm)
    for table, places in (
        (points, reconstruction.points_mm),
        (boundary, reconstruction.boundary.points_mm),
    ):
        np.testing.assert_array_equal(
            np.column_stack([table[f"{axis}_mm"] for axis in "xyz"]), places
        )
    np.testing.assert_array_equal(boundary["theta_deg"], reconstruction.boundary.theta_deg)


def test_surface_is_a_grid_with_nan_outside(written: Path, measured: Measurement) -> None:
    with h5py.File(written) as file:
        surface = file["frames/000012/surface"]
        x, y, z = (surface[f"{axis}_mm"][()] for axis in "xyz")
    for axis in (x, y):
        np.testing.assert_array_equal(axis, axis[0] + 0.5 * np.arange(len(axis)))
        assert axis[0] <= -2.5
        assert axis[-1] >= 2.5
    assert z.shape == (len(y), len(x))
    reconstruction = measured.reconstruction
    x, y = np.meshgrid(x, y)
    inside = reconstruction.boundary.contains(x, y)
    assert inside.sum() > 90
    np.testing.assert_array_equal(z, np.where(inside, reconstruction.surface.height(x, y), np.nan))


def test_missing_tables_of_a_frame_are_omitted(written: Path) -> None:
    with h5py.File(written) as file:
        assert set(file["frames"]) == {"000012", "000013"}
        assert set(file["frames/000013"]) == {"dots"}


def test_every_dataset_has_units_and_descriptions(written: Path) -> None:
    names = []

    def check(name: str, item: object) -> None:
        if not isinstance(item, h5py.Dataset):
            return
        columns = item.dtype.names or (name.rpartition("/")[2],)
        units, about = (
            np.atleast_1d(item.attrs[key]).astype("S") for key in ("units", "description")
        )
        assert len(units) == len(about) == len(columns)
        for column, unit, text in zip(columns, units, about, strict=True):
            suffix = column.rpartition("_")[2].encode()
            assert unit == (suffix if suffix in b"mm mm2 mm3 px deg s".split() else b"1"), column
            assert len(text) > 2
        names.append(name)

    with h5py.File(written) as file:
        file.visititems(check)
        x_prime = file["frames/000012/dots"].attrs["description"][2]
    assert x_prime == "place on the imaging plane, X′".encode()
    assert len(names) == len(TABLES["measures"]) + 4 + 3


def test_root_contains_the_provenance(written: Path) -> None:
    with h5py.File(written) as file:
        assert file.attrs["program"] == "labapp"
        assert file.attrs["setup"] == ABOUT["setup"]
        assert json.loads(file.attrs["settings"]) == ABOUT["settings"]


def test_equal_results_give_equal_files(
    written: Path, tmp_path: Path, measured: Measurement, calibration: ImageCalibration
) -> None:
    contents = []
    for name in ("a.h5", "b.h5"):
        with Hdf5Writer(tmp_path / name, ABOUT, 0.5) as file:
            tables = frame_tables(FrameResult(0, 0.0, measured), calibration)
            file.write(0, tables, measured.reconstruction)
        contents.append((tmp_path / name).read_bytes())
    assert contents[0] == contents[1]


def test_run_without_frames_has_empty_columns(tmp_path: Path) -> None:
    with Hdf5Writer(tmp_path / "a.h5", {}, 0.5):
        pass
    with h5py.File(tmp_path / "a.h5") as file:
        assert {len(column) for column in file["measures"].values()} == {0}
        assert not len(file["frames"])


def test_invalid_unicode_is_escaped(
    tmp_path: Path, unmeasured: Measurement, calibration: ImageCalibration
) -> None:
    odd = b"caf\xe9.avi and\0 more".decode("utf-8", "surrogateescape")
    with Hdf5Writer(tmp_path / "a.h5", {"source": {"path": odd}, "name": odd}, 0.5) as file:
        measurement = replace(unmeasured, reason=odd)
        file.write(0, frame_tables(FrameResult(0, None, measurement), calibration), None)
    with h5py.File(tmp_path / "a.h5") as file:
        for text in (file["measures/reason"].asstr()[0], file.attrs["name"]):
            assert text == r"caf\udce9.avi and\0 more"
        assert json.loads(file.attrs["source"]) == {"path": odd}


class FailingFile(io.FileIO):
    """A file that accepts a number of bytes, and then raises Ctrl-C or an error."""

    room = 20_000
    failure: BaseException = KeyboardInterrupt()

    def write(self, content: memoryview) -> int:
        FailingFile.room -= len(content)
        if FailingFile.room < 0:
            raise FailingFile.failure
        return super().write(content)


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), OSError(28, "full")], ids=["^C", "full"])
@pytest.mark.parametrize("room", [0, 100, 5_000, 20_000])
def test_error_while_writing_is_raised_after_closing(
    tmp_path: Path,
    measured: Measurement,
    calibration: ImageCalibration,
    room: int,
    failure: BaseException,
) -> None:
    FailingFile.room, FailingFile.failure = room, failure
    path = tmp_path / "a.h5"
    tables = frame_tables(FrameResult(0, 0.0, measured), calibration)

    def write_many() -> None:
        with Hdf5Writer(path, ABOUT, 0.2) as file:
            for frame in range(20):
                file.write(frame, tables, measured.reconstruction)

    patched_open = mock.patch.object(Path, "open", lambda self, *_, **__: FailingFile(self, "w+"))
    with patched_open, pytest.raises(type(failure)) as raised:
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


def test_full_disk_raises_an_error(tmp_path: Path) -> None:
    """HDF5 by itself would crash the process."""
    process = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(FULL_DISK), str(tmp_path / "a.h5")],
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": ":".join(sys.path)},
    )
    assert (process.returncode, process.stderr) == (0, "")
    frame, message = process.stdout.split(maxsplit=1)
    assert message == "File too large\n"
    assert 2 < int(frame) < 20
