"""`labapp analyze`: its files, its output and its errors."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import pytest

from labapp.studies import error_analysis
from labapp.studies.analysis import TABLES
from tests.conftest import Run

DATA = Path(__file__).parent / "data"
SETUP = Path(__file__).parents[1] / "sample_sessions" / "gtaw" / "setup.toml"
LINES_SETUP = str(SETUP.parents[1] / "five_lines" / "setup.toml")

pytestmark = pytest.mark.usefixtures("state")


@pytest.fixture
def few_caps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only two of the 28 caps, in this process."""
    caps = error_analysis.caps_8_3_1()[2::14]
    monkeypatch.setattr(error_analysis, "caps_8_3_1", lambda: caps)
    monkeypatch.setattr("os.cpu_count", lambda: 1)


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("kind", ["positioning", "correspondence"])
def test_tables_option_prints_and_writes_no_file(
    labapp: Run, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    code, out, err = labapp("analyze", kind, "--tables")
    assert (code, err) == (0, "")
    assert {"positioning": "| 20 ", "correspondence": "I/I*"}[kind] in out
    assert list((tmp_path / "here").iterdir()) == []


@pytest.mark.parametrize(
    ("kind", "tables", "pictures"), [("positioning", 4, 2), ("correspondence", 2, 3)]
)
def test_tables_and_pictures_are_written(
    labapp: Run, kind: str, tables: int, pictures: int, tmp_path: Path
) -> None:
    folder = tmp_path / "new" / "folder"
    code, out, _ = labapp("analyze", kind, "--out", str(folder))
    assert (code, out) == (0, "")
    assert len(list(folder.glob("*.csv"))) == len(list(folder.glob("*.md"))) == tables
    images = sorted(folder.glob("*.png"))
    assert len(images) == pictures
    for picture in images:
        assert cv2.imread(str(picture)).std() > 5
    for expected in DATA.glob("table_4_*.csv"):
        written = folder / expected.name
        assert not written.exists() or written.read_bytes() == expected.read_bytes()
    former = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert labapp("analyze", kind, "--out", str(folder))[0] == 0
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == former


def test_pictures_can_be_vector_graphics(labapp: Run, tmp_path: Path) -> None:
    assert labapp("analyze", "correspondence", "--out", str(tmp_path), "--format", "svg")[0] == 0
    assert (tmp_path / "figure_4_20_convex.svg").read_text("utf-8").startswith("<?xml")
    assert not list(tmp_path.glob("*.png"))


@pytest.mark.usefixtures("few_caps")
def test_selected_parts_of_the_errors_are_written(labapp: Run, tmp_path: Path) -> None:
    arguments = ("--part", "LE", "--part", "CE", "--scheme", "ers", "--step", "10")
    code, out, err = labapp("analyze", "errors", "--out", str(tmp_path), *arguments)
    assert (code, err) == (0, "")
    rows = table(tmp_path / "errors.csv")
    assert [row["error"] for row in rows[::3]] == ["CE-D", "CE-B", "LE-D", "LE-B"]
    assert float(rows[6]["ers_mean_pct"]) <= float(rows[6]["ers_worst_pct"])
    assert rows[2]["text_worst_pct"] == "26.9"
    assert "CE-D" in out
    caps = table(tmp_path / "errors_by_cap.csv")
    assert [row["height_mm"] for row in caps] == ["0.3"] * 5 + ["-0.3"] * 5 + ["0.3", "-0.3"]
    assert len({row["center_x_mm"] for row in caps[:10]}) == 10
    assert {path.stem for path in tmp_path.glob("*.csv")} == {*TABLES["CE"], *TABLES["LE"]}
    assert sorted(path.stem for path in tmp_path.glob("*.png")) == [
        "figure_8_6_CE",
        "figure_8_7_CE_are",
        "figure_8_8_LE",
        "figure_8_9_LE_are",
    ]


@pytest.mark.usefixtures("few_caps")
def test_parts_share_a_folder_and_replace_only_unchanged_files(
    labapp: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "chapters"
    errors = ("analyze", "errors", "--out", folder, "--scheme", "ers", "--part")
    assert labapp("analyze", "correspondence", "--out", folder)[0] == 0
    assert labapp(*errors, "parameters", "--draws", "10")[0] == 0
    (folder / "table_4_4_correspondence_concave.md").write_text("with notes")
    (folder / "errors.csv").write_text("mine")
    assert labapp(*errors, "parameters", "--draws", "11")[0] == 0  # beside the changed one
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert {"table_4_5_correspondence_convex.csv", "parameter_deviation.csv"} < before.keys()
    monkeypatch.setattr(error_analysis, "survey", pytest.fail)  # not after minutes of computing
    for arguments, name in (
        ((*errors, "CE"), "errors.csv"),
        (("analyze", "correspondence", "--out", folder), "table_4_4"),
    ):
        code, _, err = labapp(*arguments)
        assert code == 2
        assert name in err
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.usefixtures("few_caps")
def test_other_parts_are_written_to_tables(labapp: Run, tmp_path: Path) -> None:
    arguments = ("--part", "measurement", "--part", "parameters", "--scheme", "ers")
    arguments += ("--frames", "1", "--draws", "10")
    assert labapp("analyze", "errors", "--out", str(tmp_path), *arguments)[0] == 0
    names = {path.stem for path in tmp_path.glob("*.csv")}
    assert names == {*TABLES["measurement"], *TABLES["parameters"]}
    tack = table(tmp_path / "measurement_error.csv")
    assert [row["text"] for row in tack] == ["9.12", "1.4903", "0.18815"]
    assert float(tack[0]["frames_mean"]) < 10
    moved = table(tmp_path / "parameter_deviation.csv")
    assert [row["surface"] for row in moved] == ["convex"] * 13 + ["concave"] * 13
    assert moved[0]["quantity"] == "laser, projection angle"
    assert float(moved[12]["height_pct"]) > 0
    assert (tmp_path / "figure_8_2_thumb_tack.png").exists()
    assert (tmp_path / "parameter_deviation_concave.png").exists()


@pytest.mark.usefixtures("few_caps")
def test_budget_of_a_setup_file(
    labapp: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("labapp.studies.predicted_budget.POOLS", 2)
    monkeypatch.setattr("labapp.studies.predicted_budget.MOVED_POOLS", 1)
    arguments = ("--setup", str(SETUP), "--width", "6.5", "--length", "7.5", "--height", "0.3")
    code, out, _ = labapp("analyze", "budget", *arguments, "--out", str(tmp_path))
    assert code == 0
    rows = {row["source"]: row for row in table(tmp_path / "error_budget.csv")}
    assert "which rays come back" in out
    assert float(rows["laser, distance"]["simulated_pct"]) > 0
    everything, random = rows["everything"], rows["these together"]
    assert float(everything["predicted_pct"]) > float(random["predicted_pct"]) > 0


def test_budget_of_a_pool_without_enough_dots_is_refused(
    labapp: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("labapp.studies.predicted_budget.POOLS", 2)
    monkeypatch.setattr("labapp.studies.predicted_budget.MOVED_POOLS", 1)
    size = ("--width", "1", "--length", "1", "--height", "0.05")
    code, out, err = labapp("analyze", "budget", *size, "--out", str(tmp_path / "out"))
    assert (code, out) == (2, "")
    assert "none of 2 pools like it gives a surface" in " ".join(err.split())
    assert "Warning" not in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("positioning",), "--out: folder: none; expected one for tables and pictures, or"),
        (("errors", "--out", "{}", "--part", "XE"), "--part: part: XE; expected one of CE, LE"),
        (("errors", "--out", "{}", "--scheme", "EPA"), "--scheme: scheme: EPA; expected one of"),
        (("errors", "--out", "{}", "--step", "0"), "--step"),
        (("errors", "--out", "{}/file"), "expected a folder that can be written"),
        (("budget", "--height", "0"), "the expected pool: height: 0.0; expected 0.01 to 30 mm"),
        (("budget", "--height", "nan"), "the expected pool: height: nan; expected 0.01 to 30 mm"),
        (("budget", "--height", "4"), "expected a possible pool"),
        (("budget", "--setup", LINES_SETUP), "pattern"),
        (
            ("budget", "--width", "1", "--length", "1", "--height", "0.05"),
            "the expected pool: size: 1 × 1 × 0.05 mm; expected a larger pool",
        ),
        (("budget", "--width", "-3"), "the expected pool: width: -3.0; expected 1 to 30 mm"),
        (("budget", "--setup", "{}/none.toml"), "none.toml"),
        (("positioning", "--out", "{}", "--format", "gif"), "--format"),
    ],
)
def test_impossible_options_are_rejected(
    labapp: Run, arguments: tuple[str, ...], message: str, tmp_path: Path
) -> None:
    folder = tmp_path / "here"
    folder.mkdir()
    (folder / "file").write_text("mine")
    code, out, err = labapp("analyze", *(argument.format(folder) for argument in arguments))
    assert (code, out) == (2, "")
    assert message in " ".join(err.split())
    assert (folder / "file").read_text() == "mine"
    assert [path.name for path in folder.iterdir()] == ["file"]


@pytest.mark.slow
def test_algorithms_are_compared_on_a_frame(labapp: Run, tmp_path: Path) -> None:
    recording = SETUP.with_name("recording.avi")
    arguments = ["analyze", "frame", str(recording), "--setup", str(SETUP), "--frame", "4"]
    code, _, err = labapp(*arguments, "--known-object", "7", "0.3", "--out", str(tmp_path))
    assert code == 0, err
    (shape,) = table(tmp_path / "section_7_1_row_shape.csv")
    assert (shape["by_residual"], shape["agree"]) == ("S/S", "yes")
    known = table(tmp_path / "section_8_2_known_object.csv")
    assert [row["status"] for row in known if row["scheme"] == "fit"] == ["ok"]
    assert len(table(tmp_path / "figure_6_10_edge_points.csv")) == 9
    rows = table(tmp_path / "figure_6_13_base_height.csv")
    assert len({row["base_height_mm"] for row in rows}) == 11


def test_impossible_known_object_is_rejected(labapp: Run) -> None:
    recording = SETUP.with_name("recording.avi")
    arguments = ["analyze", "frame", str(recording), "--setup", str(SETUP)]
    code, _, err = labapp(*arguments, "--known-object", "9", "5", "--tables")
    assert code == 2
    assert "--known-object" in err


def test_missing_frame_is_rejected(labapp: Run) -> None:
    recording = SETUP.with_name("recording.avi")
    arguments = ["analyze", "frame", str(recording), "--setup", str(SETUP), "--frame", "30"]
    code, _, err = labapp(*arguments, "--tables")
    assert code == 2
    assert "--frame" in err
