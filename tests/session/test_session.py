from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

import labapp
from labapp.config.setup import read_setup
from labapp.core.calibration.plane_calibration import calibrate_plane
from labapp.core.pipeline import Settings, start_correction
from labapp.core.rows.correction import Correction
from labapp.core.values import CannotMeasure
from labapp.errors import InputError
from labapp.export.folder import ExportChoice, verify_export
from labapp.export.frame_result import FrameResult
from labapp.export.results import ResultsWriter
from labapp.media import open_source, read_picture
from labapp.run.measurers import measuring_pool
from labapp.session.file.blobs import pack
from labapp.session.record import (
    BenchEntries,
    LaserEntries,
    MirrorEntry,
    PlanePicture,
    Record,
)
from labapp.session.results.measured import CORRECTION_CHANGED, SETTINGS_CHANGED, SETUP_CHANGED
from labapp.session.session import Session
from tests.scripts import run_python
from tests.session.test_blobs import same

SAMPLE = Path(labapp.__file__).parents[1] / "sample_sessions" / "gtaw"


@pytest.fixture(scope="module")
def measured_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording and a session of four of its frames, two of them measured."""
    folder = tmp_path_factory.mktemp("session")
    shutil.copy(SAMPLE / "recording.avi", folder)
    with Session.create(folder / "run.labsession", Record(operator="A. Weld")) as session:
        session.set_setup((SAMPLE / "setup.toml").read_text("utf-8"))
        session.import_recording(folder / "recording.avi", "0:8:2")
        statuses = [measurement.status for _, measurement in session.measure_each([0, 2])]
    assert statuses == ["ok", "ok"]
    return folder


@pytest.fixture
def folder(measured_once: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(measured_once, tmp_path / "run"))


@pytest.fixture
def session(folder: Path) -> Iterator[Session]:
    with Session.open(folder / "run.labsession") as session:
        yield session


def store_changed(session: Session, frame: int, **changes: object) -> None:
    """Store a changed measurement of a frame, without measuring."""
    result = session.result(frame)
    assert result is not None
    session._results.put(
        frame,
        replace(result.measurement, **changes),  # type: ignore[arg-type]
        session._basis(),  # type: ignore[arg-type]
        session._documents.fingerprint("correction", frame),
    )


@pytest.mark.parametrize("kind", ["device", "pipe", "nul", "folder with a pipe"])
def test_recording_must_be_a_regular_file(folder: Path, kind: str):
    path = {"device": "/dev/zero", "pipe": "pipe.avi", "nul": "a\0.avi"}.get(kind, "films")
    (folder / "films").mkdir()
    for pipe in ("pipe.avi", "films/a.mraw", "films/a.png"):
        os.mkfifo(folder / pipe)
    with Session.open(folder / "run.labsession") as session:
        assert session.recording is not None
        forged = pack(replace(session.recording, path=path, size=0))
        with session._database.transaction() as connection:
            connection.execute("UPDATE recording SET content = ?", (forged,))
    script = """
        import sys
        from labapp.errors import InputError
        from labapp.session.session import Session
        with Session.open(sys.argv[1], read_only=True) as session:
            print(len(session.problems()) > 0)
            try:
                session.frame(0)
            except InputError as error:
                print("refused")
    """
    assert run_python(script, folder / "run.labsession").splitlines() == ["True", "refused"]


def test_package_exports_the_session():
    assert labapp.Session is Session


def test_session_contains_record_setup_frames_and_recording(session: Session):
    assert session.record == Record(operator="A. Weld")
    assert same(session.setup.rig, read_setup(SAMPLE / "setup.toml").rig)
    assert session.frames.tolist() == [0, 2, 4, 6]
    assert session.stale_frames().tolist() == [4, 6]
    recording = session.recording
    assert recording is not None
    assert recording.path == "recording.avi"
    assert (recording.frames, recording.rows, recording.columns) == (30, 640, 480)
    assert recording.frame_exact
    assert "FFV1" in recording.description
    assert session.problems() == []


def test_results_have_their_provenance(session: Session):
    result = session.result(2)
    assert result is not None
    assert (result.frame, result.scheme, result.version) == (2, "fit", labapp.__version__)
    assert result.setup == session.setup_text
    assert result.settings == Settings()
    assert result.stale == ()
    assert result.measurement.measures is not None
    overview = session.overview()
    assert overview.status == ("ok", "ok", "", "")
    assert overview.measures["height_mm"][1] == result.measurement.measures.height_mm
    np.testing.assert_allclose(overview.time_s, [0, 2 / 60, 4 / 60, 6 / 60])
    assert session.result(4) is None


def test_stored_measurement_equals_the_measured_one(session: Session):
    ((_, measured),) = session.measure_each([4])
    stored = session.result(4)
    assert stored is not None
    assert measured.reconstruction is not None
    assert same(stored.measurement, measured)


def test_frames_are_read_from_the_recording(session: Session):
    video = cv2.VideoCapture(str(SAMPLE / "recording.avi"))
    frames = [video.read()[1][..., 0] for _ in range(7)]
    for number in (6, 0, 4):
        np.testing.assert_array_equal(session.frame(number).image, frames[number])
    with pytest.raises(InputError, match=r"frame: 1; expected one of the session's 4 frames"):
        session.frame(1)


# --- stale results ----------------------------------------------------------------------------


def test_changed_calibration_makes_results_stale_until_undo(session: Session):
    session.update_setup({"laser": {"distance_mm": 30.0}}, "laser moved")
    assert session.stale_frames().tolist() == [0, 2, 4, 6]
    result = session.result(0)
    assert result is not None
    assert result.stale == (SETUP_CHANGED,)
    undone = session.undo()
    assert undone is not None
    assert undone.label == "laser moved"
    assert session.stale_frames().tolist() == [4, 6]
    session.redo()
    assert session.stale_frames().tolist() == [0, 2, 4, 6]


def test_comment_in_the_setup_makes_nothing_stale(session: Session):
    session.set_setup(session.setup_text + "\n# checked on Monday\n")
    assert session.stale_frames().tolist() == [4, 6]


def test_incomplete_setup_makes_everything_stale(session: Session):
    session.update_setup({"laser": {"distance_mm": None}})
    assert session.overview().stale.tolist() == [True, True, False, False]
    with pytest.raises(InputError, match=r"laser.distance_mm"):
        next(session.measure_each())


def test_correction_makes_its_frame_stale(session: Session):
    result = session.result(2)
    assert result is not None
    correction = Correction.of(result.measurement.dots, result.measurement.lattice)
    session.correct({2: correction})
    assert same(session.correction(2), correction)
    overview = session.overview()
    assert overview.corrected.tolist() == [False, True, False, False]
    assert overview.stale.tolist() == [False, True, False, False]
    result = session.result(2)
    assert result is not None
    assert result.stale == (CORRECTION_CHANGED,)
    ((number, measurement),) = session.measure_each([2])
    assert (number, measurement.status) == (2, "ok")
    assert session.overview().stale.tolist() == [False, False, False, False]


def test_undo_and_redo_restore_measurements(session: Session):
    automatic = session.result(2)
    assert automatic is not None
    correction = Correction.of(automatic.measurement.dots, automatic.measurement.lattice)
    session.correct({2: correction})
    assert len(list(session.measure_each([2]))) == 1
    corrected = session.result(2)
    for step, expected in (
        (session.undo, automatic),
        (session.redo, corrected),
        (session.undo, automatic),
    ):
        step()
        result = session.result(2)
        assert result is not None
        assert expected is not None
        assert result.stale == ()
        assert (result.version, result.measured) == (expected.version, expected.measured)
        assert same(result.measurement, expected.measurement)
        assert session.overview().stale.tolist() == [False] * 4
        assert session.problems() == []
    session.correct({2: correction})  # the same dots and rows by a new change
    result = session.result(2)
    assert result is not None
    assert result.stale == ()


def test_fit_of_an_undone_edit_does_not_replace_the_result(session: Session):
    automatic = session.result(2)
    assert automatic is not None
    correction = Correction.of(automatic.measurement.dots, automatic.measurement.lattice)
    session.correct({2: correction})
    put = session._results.put
    basis, fingerprint = session._basis(), session._documents.fingerprint("correction", 2)
    assert basis is not None
    session.undo()
    put(2, replace(automatic.measurement, correction=correction), basis, fingerprint)
    result = session.result(2)
    assert result is not None
    assert result.measurement.correction is None
    assert result.stale == ()
    session.redo()
    result = session.result(2)
    assert result is not None
    assert result.measurement.correction is not None
    assert result.stale == ()
    assert session.problems() == []


def test_result_of_another_setup_is_not_restored(session: Session):
    result = session.result(2)
    assert result is not None
    session.correct({2: Correction.of(result.measurement.dots, result.measurement.lattice)})
    store_changed(session, 2)
    session.update_setup({"electrode": {"height_mm": 5.1}})
    store_changed(session, 2)
    session.undo()
    session.undo()
    result = session.result(2)
    assert result is not None
    assert result.stale == (SETUP_CHANGED, CORRECTION_CHANGED)


def test_correction_of_a_missing_frame_is_rejected(session: Session):
    with pytest.raises(InputError, match="frame"):
        session.correct({3: None})


def test_each_scheme_has_separate_results(session: Session):
    session.set_settings(Settings(scheme="ers"))
    assert session.stale_frames().tolist() == [0, 2, 4, 6]
    result = session.result(0, "fit")
    assert result is not None
    basis = session._basis()
    assert basis is not None
    session._results.put(0, replace(result.measurement, scheme="ers"), basis, None)
    assert session.overview().status == ("ok", "", "", "")
    assert session.overview("fit").stale.tolist() == [False] * 4
    assert session.measured_by == {
        ("ers", labapp.__version__): 1,
        ("fit", labapp.__version__): 2,
    }
    result = session.result(0, "fit")
    assert result is not None
    assert result.stale == ()


def test_changed_settings_make_results_stale(session: Session):
    settings = Settings()
    session.set_settings(replace(settings, fit=replace(settings.fit, knot_mm=0.8)))
    result = session.result(0)
    assert result is not None
    assert result.stale == (SETTINGS_CHANGED,)


def test_result_without_a_surface_is_stored(session: Session):
    store_changed(
        session,
        0,
        status="no-dots",
        reason="dark",
        match=None,
        lattice=None,
        dots=None,
        reconstruction=None,
        measures=None,
    )
    assert session.overview().status[0] == "no-dots"
    assert np.isnan(session.overview().measures["height_mm"][0])
    assert session.problems() == []


# --- path of the recording --------------------------------------------------------------------


def test_folder_can_be_moved(folder: Path):
    moved = folder.rename(folder.with_name("elsewhere"))
    with Session.open(moved / "run.labsession") as session:
        assert session.missing_recording is None
        assert session.frame(6).image.shape == (640, 480)
        assert session.problems() == []


def test_recording_beside_the_session_is_found(folder: Path):
    (folder / "videos").mkdir()
    with Session.create(folder / "other.labsession") as session:
        video = shutil.copy(folder / "recording.avi", folder / "videos")
        session.import_recording(video, ":2")
    shutil.rmtree(folder / "videos")
    with Session.open(folder / "other.labsession") as session:
        assert session.frame(1).index == 1


def test_results_remain_without_the_recording(folder: Path):
    (folder / "recording.avi").rename(folder / "moved.avi")
    with Session.open(folder / "run.labsession") as session:
        assert session.missing_recording == folder / "recording.avi"
        result = session.result(0)
        assert result is not None
        assert result.measurement.measures is not None
        for call in (lambda: session.frame(0), lambda: next(session.measure_each())):
            with pytest.raises(InputError, match="does not exist"):
                call()
        assert session.overview().status == ("ok", "ok", "", "")
        session.relink(folder / "moved.avi")
        assert session.missing_recording is None
        assert session.frame(0).image.any()
    with Session.open(folder / "run.labsession") as session:
        assert session.frame(0).image.any()


def test_replaced_recording_is_detected(folder: Path):
    content = bytearray((folder / "recording.avi").read_bytes())
    (folder / "recording.avi").write_bytes(content[:-200_000])
    with Session.open(folder / "run.labsession") as session:
        assert any("not what was imported" in problem for problem in session.problems())
        with pytest.raises(InputError, match="another recording"):
            session.relink(folder / "recording.avi")


def write_images(folder: Path, count: int = 5, highest: int = 255) -> Path:
    rng = np.random.default_rng(4)
    for k, image in enumerate(rng.integers(0, highest, (count, 20, 30), np.uint8)):
        cv2.imwrite(str(folder / f"{k}.png"), image)
    return folder


def test_folder_with_more_files_beside_its_images_is_the_recording(tmp_path: Path):
    images = write_images(tmp_path)
    with Session.create(images / "a.labsession") as session:
        session.import_recording(images)
        session.set_record(Record(notes="x" * 100_000))
        assert session.replaced_recording is None
    (images / "notes.txt").write_text("wire 1.2 mm")
    with Session.open(images / "a.labsession") as session:
        assert session.replaced_recording is None
        session.frame(0)


@pytest.mark.parametrize(("count", "highest"), [(5, 15), (4, 255), (6, 255), (5, 256)])
def test_folder_with_other_images_is_detected_and_may_be_put_back(
    tmp_path: Path, count: int, highest: int
):
    images, before = tmp_path / "images", tmp_path / "before"
    images.mkdir()
    with Session.create(tmp_path / "a.labsession") as session:
        session.import_recording(write_images(images, highest=100))
    images.rename(before)
    images.mkdir()
    write_images(images, count, highest)
    with Session.open(tmp_path / "a.labsession") as session:
        assert session.missing_recording is None
        assert session.replaced_recording == images
        shutil.rmtree(images)
        before.rename(images)
        assert session.replaced_recording is None


def test_changed_frames_are_detected(folder: Path):
    rng = np.random.default_rng(4)
    frames = rng.integers(0, 255, (3, 20, 30), np.uint8)
    np.save(folder / "stack.npy", frames)
    with Session.create(folder / "other.labsession") as session:
        session.import_recording(folder / "stack.npy")
        frames[1, 5, 5] ^= 1
        np.save(folder / "stack.npy", frames)
        session.frame(0)
        with pytest.raises(InputError, match="frame 1: is not the one that was imported"):
            session.frame(1)
        assert len(session.problems()) == 1


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_embedded_frames_need_no_recording(tmp_path: Path, dtype: type):
    frames = (np.random.default_rng(3).integers(0, 250, (4, 20, 30)) * 1.0).astype(dtype)
    np.save(tmp_path / "stack.npy", frames)
    with Session.create(tmp_path / "a.labsession") as session:
        session.import_recording(tmp_path / "stack.npy", "1:", embed=True, frame_rate_hz=500)
    (tmp_path / "stack.npy").unlink()
    with Session.open(tmp_path / "a.labsession", read_only=True) as session:
        assert session.missing_recording is None
        for number in (3, 1, 2):
            frame = session.frame(number)
            assert frame.image.dtype == dtype
            np.testing.assert_array_equal(frame.image, frames[number])
            assert frame.time_s == pytest.approx(number / 500)
        assert session.problems() == []


def test_other_recording_is_rejected_after_measuring(session: Session, folder: Path):
    np.save(folder / "stack.npy", np.zeros((3, 20, 30), np.uint8))
    with pytest.raises(InputError, match="new session"):
        session.import_recording(folder / "stack.npy")
    with pytest.raises(InputError, match="frame 0 is measured"):
        session.import_recording(folder / "recording.avi", "2:4")
    session.import_recording(folder / "recording.avi", ":5")
    assert session.frames.tolist() == [0, 1, 2, 3, 4]
    assert session.overview().status == ("ok", "", "ok", "", "")


def test_stopped_import_leaves_the_session_unchanged(session: Session, folder: Path):
    def stop(done: int, _: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        session.import_recording(folder / "recording.avi", progress=stop)
    assert session.frames.tolist() == [0, 2, 4, 6]


# --- calibrations -----------------------------------------------------------------------------


def test_laser_calibration_changes_the_rig_until_undo(session: Session):
    calibration = session.calibrate_laser([13.676], [18.561], [7.874])
    assert session.setup.rig.laser == calibration.laser
    readings = session.laser_calibration
    assert readings is not None
    assert (readings.l2_mm, readings.found) == ((18.561,), calibration)
    session.undo()
    assert session.laser_calibration is None
    assert session.setup.rig.laser.distance_mm == pytest.approx(31.48)


def test_laser_entries_are_kept_until_some_are_applied(session: Session):
    entries = LaserEntries((("13,7", "", "7.9"), ("x", "18.5", "")), 10.0, 0.1, 0.02)
    assert session.laser_entries is None
    session.set_entries("laser", entries)
    session.close()
    with Session.open(session.path) as reopened:
        assert reopened.laser_entries == entries
        assert reopened.laser_calibration is None
        reopened.calibrate_laser([13.676], [18.561], [7.874])
        assert reopened.laser_entries is None
        assert reopened.problems() == []
        reopened.undo()
        assert reopened.laser_entries == entries
        assert reopened.problems() == []


def test_plane_entries_are_kept_until_a_plane_is_applied(session: Session):
    image = read_picture(SAMPLE / "calibration.png")
    found = calibrate_plane(image, 6.35)
    keys = [session.keep_picture(f"{n}.png", image[n:]) for n in range(2)]
    entries = PlanePicture(6.35, found, keys[0], (keys[1],))
    session.set_entries("plane", entries)
    setup = session.setup_text
    session.close()
    with Session.open(session.path) as reopened:
        assert reopened.plane_entries == entries
        assert reopened.plane_calibration is None
        assert reopened.setup_text == setup
        np.testing.assert_array_equal(reopened.picture(keys[1]), image[1:])
        reopened.use_plane(found, 6.35, image)
        assert reopened.plane_entries is None
        assert reopened.problems() == []
        reopened.undo()
        assert reopened.plane_entries == entries
        assert reopened.problems() == []


def test_pictures_for_a_bench_check_are_kept_until_one_is_applied(session: Session):
    image = np.full((30, 40), 7, np.uint8)
    mirror = MirrorEntry("a.png", "cap", 0.9, 9.8, 0.01, None, session.keep_picture("a", image))
    session.set_entries("bench", BenchEntries((mirror,)))
    session.close()
    with Session.open(session.path) as reopened:
        assert reopened.bench_entries == BenchEntries((mirror,))
        assert reopened.bench_check is None
        np.testing.assert_array_equal(reopened.picture(mirror.picture_sha256), image)
        reopened.set_entries("bench", None)
        assert reopened.bench_entries is None


def test_missing_pictures_of_entries_are_problems(session: Session):
    unknown, found = "0" * 64, calibrate_plane(read_picture(SAMPLE / "calibration.png"), 6.35)
    known = session.keep_picture("a", np.zeros((30, 40), np.uint8))
    mirror = MirrorEntry("a", "plate", 0.0, None, None, None, unknown)
    session.set_entries("laser", LaserEntries((), 10.0, 0.1, 0.02, unknown))
    assert len(session.problems()) == 1
    session.set_entries("laser", None)
    session.set_entries("plane", PlanePicture(6.35, found, known, (unknown,)))
    assert len(session.problems()) == 1
    session.set_entries("plane", None)
    session.set_entries("bench", BenchEntries((mirror,)))
    assert len(session.problems()) == 1


def test_plane_calibration_stores_its_picture(session: Session):
    calibration = session.calibrate_plane(SAMPLE / "calibration.png", 6.35)
    stored = session.plane_calibration
    assert stored is not None
    assert (stored.unit_mm, stored.found) == (6.35, calibration)
    picture = cv2.imread(str(SAMPLE / "calibration.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(session.picture(stored.picture_sha256), picture)
    assert same(session.setup.calibration, calibration.image_calibration)
    session.undo()
    assert session.plane_calibration is None
    with pytest.raises(InputError, match="calibration picture: missing"):
        session.picture("0" * 64)


def test_picture_without_a_target_changes_nothing(session: Session, tmp_path: Path):
    cv2.imwrite(str(tmp_path / "dark.png"), np.zeros((200, 200), np.uint8))
    with pytest.raises(CannotMeasure):
        session.calibrate_plane(tmp_path / "dark.png", 6.35)
    assert [change.label for change in session.history] == ["experiment record", "set-up"]
    assert session.plane_calibration is None


# --- damage -----------------------------------------------------------------------------------


def test_damage_is_reported_and_other_results_remain(session: Session):
    with session._database.transaction() as connection:
        connection.execute("UPDATE detail SET content = substr(content, 1, 900) WHERE result = 1")
        connection.execute("UPDATE result SET height_mm = height_mm + 0.01 WHERE id = 2")
    with pytest.raises(InputError, match="result of frame 0"):
        session.result(0)
    assert session.result(2) is not None
    problems = session.problems()
    assert len(problems) == 2
    assert "result of frame 0 (fit) is damaged" in problems[0]
    assert "result of frame 2 (fit) differs" in problems[1]


# --- export -----------------------------------------------------------------------------------


def test_export_equals_the_output_of_the_command_line(session: Session, tmp_path: Path):
    """Session → CSV and STL: the same bytes as `labapp reconstruct` of the same frames."""
    setup = read_setup(SAMPLE / "setup.toml")
    direct = tmp_path / "direct"
    with (
        open_source(session.path.with_name("recording.avi")) as source,
        ResultsWriter(direct, setup.calibration, {}) as results,
    ):
        for number in (0, 2):
            result = session.result(number)
            assert result is not None
            time_s = source.frame(number).time_s
            results.write(FrameResult(number, time_s, result.measurement))
    session.export(tmp_path / "out")
    names = {path.name for path in direct.iterdir()} - {"run.json"}
    assert {"measures.csv", "dots.csv", "surface_000002.stl", "surface_000002.csv"} <= names
    for name in names:
        assert (tmp_path / "out" / name).read_bytes() == (direct / name).read_bytes(), name


def test_hdf5_contains_the_exact_values(session: Session, tmp_path: Path):
    session.export(tmp_path / "out", ExportChoice(hdf5=True))
    overview = session.overview()
    with h5py.File(tmp_path / "out" / "results.h5") as file:
        for name, values in overview.measures.items():
            np.testing.assert_array_equal(file["measures"][name][:], values[:2])
        result = session.result(2)
        assert result is not None
        assert result.measurement.reconstruction is not None
        points = file["frames/000002/points"]
        exported = np.column_stack([points[f"{axis}_mm"] for axis in "xyz"])
        np.testing.assert_array_equal(exported, result.measurement.reconstruction.points_mm)
        assert result.measurement.dots is not None
        dots = file["frames/000002/dots"]
        np.testing.assert_array_equal(dots["u_px"], result.measurement.dots.u_px)


def test_stale_results_are_not_exported(session: Session, tmp_path: Path):
    session.update_setup({"laser": {"distance_mm": 30.0}})
    with pytest.raises(InputError, match="2 of 2 frames are out of date: the rig"):
        session.export(tmp_path / "out")
    assert not (tmp_path / "out").exists()
    session.undo()
    files = session.export(tmp_path / "out", frames=[2], report=True)
    assert "report.pdf" in {file.name for file in files}
    assert verify_export(tmp_path / "out") == []


def test_export_needs_measured_frames(session: Session, tmp_path: Path):
    with pytest.raises(InputError, match="none by ers"):
        session.export(tmp_path / "out", scheme="ers")
    with pytest.raises(InputError, match="none by fit"):
        session.export(tmp_path / "out", frames=[4])


def test_worker_processes_give_equal_measurements(session: Session):
    expected = [measurement for _, measurement in session.measure_each([4])]
    with measuring_pool(1) as pool:
        measured = dict(session.measure_each([4, 6], pool))
    assert list(measured) == [4, 6]
    assert same(measured[4], expected[0])


def test_frame_corrected_and_measured_by_workers_is_current(
    session: Session,
):
    ((_, automatic),) = session.measure_each([4])
    session.correct({4: start_correction(automatic)})
    assert stale_frames(session) == [4]
    with measuring_pool(1) as pool:
        ((_, corrected),) = session.measure_each([4], pool)
    assert corrected.correction is not None
    assert stale_frames(session) == []
    session.undo()
    session.redo()
    assert stale_frames(session) == []
    session.undo()
    ((_, measured),) = session.measure_each([4], sinks=[lambda _: session.redo()])
    assert measured.correction is None
    assert stale_frames(session) == []


def stale_frames(session: Session) -> list[int]:
    overview = session.overview()
    return overview.frame[overview.stale].tolist()


def test_sinks_get_results_after_they_are_stored(session: Session):
    received: list[tuple[int, float | None, bool]] = []

    def receive(result: FrameResult) -> None:
        stored = session.result(result.frame)
        is_stored = stored is not None and same(stored.measurement, result.measurement)
        received.append((result.frame, result.time_s, is_stored))

    assert [frame for frame, _ in session.measure_each([4, 6], sinks=[receive])] == [4, 6]
    assert received == [(4, session.frame(4).time_s, True), (6, session.frame(6).time_s, True)]


def test_stopped_measuring_keeps_finished_frames(session: Session):
    with measuring_pool(1) as pool:
        measuring = session.measure_each([4, 6, 0], pool)
        assert next(measuring)[0] == 4
        measuring.close()
    assert session.overview().status == ("ok", "ok", "ok", "")
