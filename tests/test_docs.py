"""The worked examples of the documents do what they say."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any, get_args

import matplotlib as mpl
import pytest
import typer.core
import typer.main

from labapp import cli
from labapp.core.bench_check.check import Status
from labapp.export.folder import verify_export
from labapp.export.tables import TABLES
from labapp.session.session import Session
from tests.conftest import Run

ROOT = Path(__file__).resolve().parent.parent


def test_the_tutorial_leads_to_a_figure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(ROOT / "sample_sessions/gtaw", tmp_path / "sample_sessions/gtaw")
    monkeypatch.chdir(tmp_path)
    mpl.use("Agg")
    text = (ROOT / "docs/tutorial.md").read_text("utf-8")
    names: dict[str, object] = {}
    for example in re.findall(r"```python\n(.*?)```", text, re.S):
        exec(example, names)
    assert (tmp_path / "pool.pdf").read_bytes().startswith(b"%PDF")


def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(ROOT / "sample_sessions/gtaw", tmp_path / "sample_sessions/gtaw")
    monkeypatch.chdir(tmp_path)
    mpl.use("Agg")
    notebook = json.loads((ROOT / "docs/notebooks/measured_and_true.ipynb").read_text("utf-8"))
    names: dict[str, Any] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert not cell["outputs"]  # results belong to who runs it
            exec("".join(cell["source"]), names)
    comparison = names["comparison"]
    assert (comparison["median error, %"] < 2).all()
    assert (comparison["error / ±, RMS"] < 2).all()
    assert (tmp_path / "measured_and_true.png").exists()


def test_the_commands_of_the_site_are_those_of_the_command_line() -> None:
    spec = importlib.util.spec_from_file_location("site_hooks", ROOT / "docs" / "site_hooks.py")
    assert spec is not None
    assert spec.loader is not None
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    page = hooks.commands_page()
    for command in ("labapp reconstruct", "labapp session measure", "labapp calibrate bench"):
        assert f"`{command}`" in page


def test_the_examples_of_the_python_api_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("thumb_tack", "blocked_rows"):
        shutil.copytree(ROOT / "sample_sessions" / name, tmp_path / "sample_sessions" / name)
    monkeypatch.chdir(tmp_path)
    examples = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs/python.md").read_text("utf-8"), re.S
    )
    names: dict[str, object] = {}
    for example in examples:
        exec(example, names)
    told = capsys.readouterr().out
    height = re.search(r"height ([\d.]+) ± ([\d.]+) mm", told)
    assert height is not None
    assert float(height[1]) == pytest.approx(0.91, rel=0.03)
    assert verify_export("tack_results") == []
    (height_mm,) = re.findall(r"^ok (0\.\d+)$", told, re.MULTILINE)
    assert float(height_mm) == pytest.approx(0.22067, rel=0.02)  # the true height
    assert told.splitlines()[-1] == "ambiguous-rows"  # back again
    for session in ("tack", "blocked"):
        with Session.open(f"{session}.labsession", read_only=True) as opened:
            assert opened.problems() == []


def test_the_worked_example_of_the_command_line_says_what_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, labapp: Run
) -> None:
    sample = ROOT / "sample_sessions/blocked_rows"
    for name in ("blocked_rows.labsession", "recording.mkv", "setup.toml"):
        shutil.copy(sample / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs/command-line.md").read_text("utf-8").replace("\\\n", " ")
    example = text.partition("### A worked example")[2].partition("### correct")[0]
    commands = re.findall(r"^    labapp session (.*)$", example, re.MULTILINE)
    assert [line.split()[0] for line in commands] == "new import measure correct export".split()
    # The sample is what the first three make, with a set-up found and frame 2 corrected.
    (tmp_path / "blocked_rows.labsession").rename("run.labsession")
    assert labapp("session", "undo", "run.labsession")[0] == 0
    assert labapp("session", "setup", "run.labsession", "setup.toml")[0] == 0
    assert labapp("session", "measure", "run.labsession", "--frames", "5")[0] == 1
    code, told, _ = labapp("session", *commands[3].split())
    assert code == 0
    said = example.partition("    Corrected")[1:]
    expected = re.findall(r"^    (.*)$", "".join(said), re.MULTILINE)[:4]
    assert expected.pop() == "  …"
    assert not set(expected) - set(told.splitlines())
    code, told, _ = labapp(
        "session", *commands[4].removesuffix(" --report").split(), "--frames", "5:"
    )
    assert code == 0
    assert verify_export("results") == []


def test_the_columns_of_the_tables_are_those_that_are_written() -> None:
    """In their order; of ``a … b`` the table has all from a to b."""
    text = (ROOT / "docs/results.md").read_text("utf-8")
    for table, columns in TABLES.items():
        names = [column.name for column in columns]
        found: list[str] = []
        section = text.partition(f"### {table}.csv")[2].partition("\n## ")[0].partition("\n### ")[0]
        for cell in re.findall(r"^\| (`.*?) \|", section, re.MULTILINE):
            first, *others = re.findall(r"`(\w+)`", cell)
            if "…" in cell:
                found += names[names.index(first) : names.index(others[-1]) + 1]
            else:
                found += [first, *others]
        assert found == names


def test_every_status_is_explained() -> None:
    given = {word for part in get_args(Status) for word in get_args(part)}
    for path in (ROOT / "labapp").rglob("*.py"):
        pattern = r'(?:CannotMeasure|Measurement|LineFrame|RowsOpen)\(\s*"([a-z-]+)"'
        given |= set(re.findall(pattern, path.read_text("utf-8")))
    assert {"too-many-dots", "unreadable", "size-off", "folded-lines"} <= given
    explained = set(
        re.findall(r"`([a-z-]+)`", (ROOT / "docs/troubleshooting.md").read_text("utf-8"))
    )
    assert given - explained == {"noise-like"}  # what is left of a check that is ok


TEXTS = ["README.md", *sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("docs/*.md"))]

LONG = (
    *(["analyze", part] for part in ("positioning", "correspondence", "errors", "budget")),
    *(["advise"], ["cameras"], ["session", "correct"], ["session", "export"]),
)
"""Examples that are not run here: they take minutes, need a camera, or are run above."""

FEWER = {"simulate": "--frames 2", "reconstruct": "--frames 0", "record": "--seconds 0.2"}
"""What makes examples short."""


def examples(text: str) -> list[list[str]]:
    """The commands of a text's examples: their words after ``labapp``."""
    joined = re.sub(r"\\\n\s*", " ", (ROOT / text).read_text("utf-8"))
    lines = re.findall(r"^    labapp (.*)$", joined, re.MULTILINE)
    return [shlex.split(line, comments=True) for line in lines]


def shown_files(text: str) -> dict[str, str]:
    """Files that a text shows whole, by name."""
    shown = re.findall(
        r'^```toml title="(.+?)"\n(.*?)```', (ROOT / text).read_text("utf-8"), re.M | re.S
    )
    return dict(shown)


@pytest.mark.parametrize("text", TEXTS)
def test_examples_can_be_typed_as_they_are(text: str, tmp_path: Path) -> None:
    """The options are there, and so is every file: in a checkout, or made by an example before."""
    made = {"bench.toml", *shown_files(text)}
    for words in examples(text):
        command: object = typer.main.get_command(cli.app)
        context, rest = None, words
        while isinstance(command, typer.core.TyperGroup):
            context = command.make_context(command.name or "", list(rest), parent=context)
            name, command, rest = command.resolve_command(context, rest)
            assert name is not None, words
        assert isinstance(command, typer.core.TyperCommand)
        command.make_context(command.name or "", list(rest), parent=context)
        for before, word in zip(["", *words], words, strict=False):
            path = word.removeprefix("simulated:")
            if before in ("--out", "new") or (before == "--setup" and words[0] == "calibrate"):
                made.add(word)
            elif set(path) & set("*{"):  # a pattern
                continue
            elif re.search(r"\.[a-z]+$", path) and path.partition("/")[0] not in made:
                assert (ROOT / path).is_file(), words


@pytest.mark.parametrize("text", [text for text in TEXTS if examples(text)])
def test_examples_run_one_after_the_other(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, labapp: Run
) -> None:
    for folder in ("sample_sessions", "resources"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    monkeypatch.chdir(tmp_path)
    for name, content in shown_files(text).items():
        Path(name).write_text(content, "utf-8")
    for words in examples(text):
        if any(words[: len(long)] == long for long in LONG):
            continue
        fewer = FEWER.get(words[0], "").split()
        if words[:2] == ["session", "measure"]:
            fewer = ["--frames", "0"]
        if fewer and fewer[0] in words:
            place = words.index(fewer[0])
            words[place : place + 2] = []
        if "--lines" in words:
            words[words.index("--lines") + 1] = "0"  # a port that is free
        code, _, said = labapp(*words, *fewer)
        assert code == 0, said
    if text in (
        "docs/studies.md",
        "docs/penetration.md",
    ):  # goes on with what its commands have made
        for example in re.findall(r"```python\n(.*?)```", (ROOT / text).read_text("utf-8"), re.S):
            exec(example, {})


def test_commands_in_the_texts_have_no_gaps_and_options_that_there_are() -> None:
    program = typer.main.get_command(cli.app)
    for text in (*TEXTS, *(str(path.relative_to(ROOT)) for path in ROOT.glob("docs/guide/*.md"))):
        found = re.findall(r"`(?:\./run )?labapp ([^`]*)`", (ROOT / text).read_text("utf-8"))
        assert not [command for command in found if "…" in command], text
        for words in (shlex.split(command) for command in found):
            command: object = program
            while isinstance(command, typer.core.TyperGroup) and words and words[0][0].islower():
                command = command.commands[words.pop(0)]
            if isinstance(command, typer.core.TyperCommand):
                known = [name for each in command.params for name in each.opts]
                for word in words:
                    assert word in known or not word.startswith("--"), (text, command.name, word)
