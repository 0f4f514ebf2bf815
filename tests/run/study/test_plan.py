"""Study files: recordings with their setup, settings and conditions, as TOML and as CSV."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from labapp.errors import InputError
from labapp.run.study.plan import MOST_RECORDINGS, read_study, write_study

SAMPLES = Path(__file__).parents[3] / "sample_sessions"


def write(folder: Path, text: str, name: str = "study.toml") -> Path:
    path = folder / name
    path.write_text(text, "utf-8")
    return path


def fields(error: pytest.ExceptionInfo[InputError]) -> set[str]:
    return {problem.field for problem in error.value.problems}


def test_recording_combines_defaults_and_its_own_keys(tmp_path: Path) -> None:
    text = """
title = "Two"
setup = "bench.toml"
scheme = "ers"
[[recording]]
file = "a.avi"
conditions = { current_a = 100, gas = "Ar" }
[[recording]]
file = "/data/b.avi"
name = "second"
setup = "sub/other.toml"
frames = "2:8"
scheme = "irs"
algorithm = "epa-r"
warm = false
"""
    plan = read_study(write(tmp_path, text))
    first, second = plan.recordings
    assert (plan.title, plan.conditions) == ("Two", ("current_a", "gas"))
    assert (first.name, first.path, first.setup) == (
        "a",
        tmp_path / "a.avi",
        tmp_path / "bench.toml",
    )
    assert (first.frames, first.settings.scheme, first.warm) == (":", "ers", True)
    assert first.conditions == {"current_a": 100, "gas": "Ar"}
    assert (second.name, second.path, second.setup) == (
        "second",
        Path("/data/b.avi"),
        tmp_path / "sub/other.toml",
    )
    assert (second.frames, second.settings.scheme, second.settings.algorithm) == (
        "2:8",
        "irs",
        "epa-r",
    )
    assert not second.warm


@pytest.mark.parametrize("separator", [",", ";"])
def test_table_has_a_recording_per_row_and_columns_of_conditions(
    tmp_path: Path, separator: str
) -> None:
    decimal = "1,5" if separator == ";" else "1.5"
    rows = [
        ["file", "setup", "warm", "speed", "gas"],
        ["a.avi", "s.toml", "", decimal, "Ar"],
        ["b.avi", "s.toml", "false", "", "He"],
    ]
    text = "\n".join(separator.join(row) for row in rows)
    plan = read_study(write(tmp_path, text, "study.csv"))
    first, second = plan.recordings
    assert first.conditions == {"speed": 1.5, "gas": "Ar"}
    assert second.conditions == {"gas": "He"}
    assert [first.warm, second.warm] == [True, False]


def test_pattern_matches_files_and_their_conditions(tmp_path: Path) -> None:
    for name in ("I100_Ar_1", "I100_Ar_2", "I80.5_He_1"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "recording.avi").touch()
    text = 'setup = "s.toml"\n[[recording]]\nfile = "runs/I{current_a}_{gas}_*/recording.avi"\n'
    plan = read_study(write(tmp_path, text))
    assert [recording.name for recording in plan.recordings] == [
        "I100_Ar_1",
        "I100_Ar_2",
        "I80.5_He_1",
    ]
    assert [recording.conditions["current_a"] for recording in plan.recordings] == [100, 100, 80.5]
    assert [recording.conditions["gas"] for recording in plan.recordings] == ["Ar", "Ar", "He"]


def test_existing_file_named_like_a_pattern_is_used(tmp_path: Path) -> None:
    (tmp_path / "odd*{name}.avi").touch()
    text = 'setup = "s.toml"\n[[recording]]\nfile = "odd*{name}.avi"\n'
    (recording,) = read_study(write(tmp_path, text)).recordings
    assert recording.path == tmp_path / "odd*{name}.avi"
    assert not recording.conditions


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("", "recording"),
        ("recording = 3", "recording"),
        ('setups = "s"', "setups"),
        ('setup = "s"\n[[recording]]\n', "recording[1].file"),
        ('[[recording]]\nfile = "a.avi"', "recording[1].setup"),
        ('setup = "s"\n[[recording]]\nfile = "a"\nscheme = "magic"', "recording[1].scheme"),
        (
            'setup = "s"\nscheme = "fit"\n[[recording]]\nfile = "a"\nalgorithm = "epa-r"',
            "recording[1].algorithm",
        ),
        (
            'setup = "s"\nalgorithm = "epa-r"\n[[recording]]\nfile = "a"',
            "recording[1].algorithm",
        ),
        ('setup = "s"\n[[recording]]\nfile = "a"\nname = "../a"', "recording[1].name"),
        ('setup = "s"\n[[recording]]\nfile = "a"\nname = ".a"', "recording[1].name"),
        ('setup = "s"\n[[recording]]\nfile = "a"\nname = "a/b"', "recording[1].name"),
        ('setup = "s"\n[[recording]]\nfile = "a\\u0000b"', "recording[1].file"),
        ('setup = "s"\n[[recording]]\nfile = "none_*.avi"', "recording[1].file"),
        ('setup = "s"\n[[recording]]\nfile = "**/x"', "recording[1].file"),
        ('setup = "s"\n[[recording]]\nfile = "{a}{a}"', "recording[1].file"),
        ('setup = "s"\n[[recording]]\nfile = "{height_mm}"', "recording[1].file"),
        (
            'setup = "s"\n[[recording]]\nfile = "a"\nconditions = { status = 1 }',
            "recording[1].conditions.status",
        ),
        (
            'setup = "s"\n[[recording]]\nfile = "a"\nconditions = { "x/y" = 1 }',
            "recording[1].conditions.x/y",
        ),
        (
            'setup = "s"\n[[recording]]\nfile = "a"\nconditions = { x = [1] }',
            "recording[1].conditions.x",
        ),
        (
            'setup = "s"\n[[recording]]\nfile = "x"\nname = "a"\n'
            '[[recording]]\nfile = "y"\nname = "A"',
            "recording[2].name",
        ),
        ('setup = "s\\u0000"\n[[recording]]\nfile = "a"', "setup"),
        (f'setup = "s"\n[[recording]]\nfile = "{"a" * 300}*.avi"', "recording[1].file"),
    ],
)
def test_wrong_key_is_named(tmp_path: Path, text: str, field: str) -> None:
    with pytest.raises(InputError) as error:
        read_study(write(tmp_path, text))
    assert field in fields(error)


@pytest.mark.parametrize("text", ["", "setup\ns", "file,file\n", "file\na,b\n", "file,\0\n"])
def test_invalid_table_is_rejected(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError):
        read_study(write(tmp_path, text, "study.csv"))


def test_number_of_recordings_is_limited(tmp_path: Path) -> None:
    rows = "".join(f"{k}.avi,s\n" for k in range(MOST_RECORDINGS + 1))
    with pytest.raises(InputError):
        read_study(write(tmp_path, f"file,setup\n{rows}", "study.csv"))


@pytest.mark.parametrize("name", ["new.toml", "new.csv"])
def test_new_study_file_contains_its_recordings(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for file in ("I80_a.avi", "I90_b.avi", "=odd.avi"):
        (tmp_path / file).touch()
    shutil.copy(SAMPLES / "gtaw" / "setup.toml", tmp_path / "bench.toml")
    (tmp_path / "sub").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"none\.toml"):
        write_study(tmp_path / "sub" / name, ["=odd.avi"], "none.toml")
    assert not (tmp_path / "sub" / name).exists()
    plan = write_study(tmp_path / "sub" / name, ["I{current_a}_*.avi", "=odd.avi"], "bench.toml")
    assert plan == read_study(tmp_path / "sub" / name)
    assert [recording.path.resolve() for recording in plan.recordings] == [
        tmp_path / "I80_a.avi",
        tmp_path / "I90_b.avi",
        tmp_path / "=odd.avi",
    ]
    assert {recording.setup.resolve() for recording in plan.recordings} == {tmp_path / "bench.toml"}
    assert [recording.conditions.get("current_a") for recording in plan.recordings] == [
        80,
        90,
        None,
    ]
    with pytest.raises(InputError):
        write_study(tmp_path / "sub" / name, ["=odd.avi"], "bench.toml")
    plan = write_study(tmp_path / "sub" / name, ["=odd.avi"], "bench.toml", replace=True)
    assert len(plan.recordings) == 1
    other = tmp_path / f"other{Path(name).suffix}"
    other.write_text("a = 1\n")
    with pytest.raises(InputError):
        write_study(other, ["=odd.avi"], "bench.toml", replace=True)
    assert other.read_text() == "a = 1\n"


@pytest.mark.parametrize("suffix", ["toml", "csv"])
@pytest.mark.parametrize("key", ["file", "name", "setup", "frames", "warm", "conditions"])
def test_key_of_a_study_is_no_name_of_a_condition(
    tmp_path: Path, suffix: str, key: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "I100_1.avi").touch()
    shutil.copy(SAMPLES / "gtaw" / "setup.toml", tmp_path / "bench.toml")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=f"{{{key}}}"):
        write_study(f"new.{suffix}", [f"I{{{key}}}_*.avi"], "bench.toml")
    assert not Path(f"new.{suffix}").exists()
    text = 'setup = "s"\n[[recording]]\nfile = "a.avi"\n'
    with pytest.raises(InputError) as refused:
        read_study(write(tmp_path, f"{text}conditions = {{ {key} = 1 }}"))
    assert fields(refused) == {f"recording[1].conditions.{key}"}


def test_column_of_conditions_is_refused(tmp_path: Path) -> None:
    text = "file,setup,conditions\na.avi,bench.toml,argon\n"
    with pytest.raises(InputError) as refused:
        read_study(write(tmp_path, text, "study.csv"))
    assert fields(refused) == {"line 1"}


def test_open_quotation_mark_loses_no_recording(tmp_path: Path) -> None:
    text = 'file,setup,gas\na.avi,bench.toml,"argon\nb.avi,bench.toml,helium\n'
    with pytest.raises(InputError) as refused:
        read_study(write(tmp_path, text, "study.csv"))
    assert fields(refused) == {"syntax"}


@pytest.mark.parametrize("name", ["new.toml", "new.csv"])
def test_refused_study_is_not_written(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.avi").touch()
    shutil.copy(SAMPLES / "gtaw" / "setup.toml", tmp_path / "bench.toml")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="each file once"):
        write_study(name, ["a.avi", "a.avi"], "bench.toml")
    assert not Path(name).exists()
