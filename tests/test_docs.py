"""The examples of the documentation run and give the stated results."""

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
from labapp.core.schemes import SCHEMES
from labapp.export.folder import verify_export
from labapp.export.tables import TABLES
from labapp.session.session import Session
from tests.conftest import Run

ROOT = Path(__file__).resolve().parent.parent


def test_tutorial_writes_its_figure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(ROOT / "sample_sessions/gtaw", tmp_path / "sample_sessions/gtaw")
    monkeypatch.chdir(tmp_path)
    mpl.use("Agg")
    text = (ROOT / "docs/tutorial.md").read_text("utf-8")
    names: dict[str, object] = {}
    for example in re.findall(r"```python\n(.*?)```", text, re.S):
        exec(example, names)
    assert (tmp_path / "pool.pdf").read_bytes().startswith(b"%PDF")


def test_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(ROOT / "sample_sessions/gtaw", tmp_path / "sample_sessions/gtaw")
    monkeypatch.chdir(tmp_path)
    mpl.use("Agg")
    notebook = json.loads((ROOT / "docs/notebooks/measured_and_true.ipynb").read_text("utf-8"))
    names: dict[str, Any] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert not cell["outputs"]  # the notebook is stored without results
            exec("".join(cell["source"]), names)
    comparison = names["comparison"]
    assert (comparison["median error, %"] < 2).all()
    assert (comparison["error / ±, RMS"] < 2).all()
    assert (tmp_path / "measured_and_true.png").exists()


def test_site_lists_the_commands_of_the_command_line() -> None:
    spec = importlib.util.spec_from_file_location("site_hooks", ROOT / "docs" / "site_hooks.py")
    assert spec is not None
    assert spec.loader is not None
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    page = hooks.commands_page()
    for command in ("labapp reconstruct", "labapp session measure", "labapp calibrate bench"):
        assert f"`{command}`" in page


def test_examples_of_the_python_api_run(
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
    stdout = capsys.readouterr().out
    height = re.search(r"height ([\d.]+) ± ([\d.]+) mm", stdout)
    assert height is not None
    assert float(height[1]) == pytest.approx(0.91, rel=0.03)
    assert verify_export("tack_results") == []
    before_mm, after_mm = map(float, re.findall(r"^ok (0\.\d+)$", stdout, re.MULTILINE))
    assert after_mm == pytest.approx(0.22067, rel=0.02)  # the true height
    assert float(stdout.splitlines()[-1]) == before_mm != after_mm  # after the undo
    for session in ("tack", "blocked"):
        with Session.open(f"{session}.labsession", read_only=True) as sample:
            assert sample.problems() == []


def test_worked_example_of_the_command_line_prints_its_output(
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
    # The sample is the result of the first three, with a set-up found and frame 2 corrected.
    (tmp_path / "blocked_rows.labsession").rename("run.labsession")
    assert labapp("session", "undo", "run.labsession")[0] == 0
    assert labapp("session", "setup", "run.labsession", "setup.toml")[0] == 0
    assert labapp("session", "measure", "run.labsession", "--frames", "5")[0] == 0
    code, stdout, _ = labapp("session", *commands[3].split())
    assert code == 0
    output = example.partition("    Corrected")[1:]
    expected = re.findall(r"^    (.*)$", "".join(output), re.MULTILINE)[:4]
    assert expected.pop() == "  …"
    assert not set(expected) - set(stdout.splitlines())
    code, stdout, _ = labapp(
        "session", *commands[4].removesuffix(" --report").split(), "--frames", "5:"
    )
    assert code == 0
    assert verify_export("results") == []


def test_documented_columns_are_the_written_ones() -> None:
    """In their order; ``a … b`` stands for all columns from a to b."""
    text = (ROOT / "docs/results.md").read_text("utf-8")
    for table, columns in TABLES.items():
        names = [column.name for column in columns]
        documented: list[str] = []
        section = text.partition(f"### {table}.csv")[2].partition("\n## ")[0].partition("\n### ")[0]
        for cell in re.findall(r"^\| (`.*?) \|", section, re.MULTILINE):
            first, *others = re.findall(r"`(\w+)`", cell)
            if "…" in cell:
                documented += names[names.index(first) : names.index(others[-1]) + 1]
            else:
                documented += [first, *others]
        assert documented == names


def test_every_status_is_explained() -> None:
    used = {word for part in get_args(Status) for word in get_args(part)}
    for path in (ROOT / "labapp").rglob("*.py"):
        pattern = r'(?:CannotMeasure|Measurement|LineFrame|RowsOpen)\(\s*"([a-z-]+)"'
        used |= set(re.findall(pattern, path.read_text("utf-8")))
    assert {"too-many-dots", "unreadable", "size-off", "folded-lines"} <= used
    explained = set(
        re.findall(r"`([a-z-]+)`", (ROOT / "docs/troubleshooting.md").read_text("utf-8"))
    )
    assert used - explained == {"noise-like"}  # part of a check that is ok


@pytest.mark.parametrize("scheme", SCHEMES)
def test_scheme_is_documented(scheme: str) -> None:
    options = (ROOT / "docs/command-line.md").read_text("utf-8").split("| `--scheme` |")[1:]
    assert len(options) == 2
    assert all(f"`{scheme}`" in row.partition("\n")[0] for row in options)
    results = (ROOT / "docs/results.md").read_text("utf-8").partition("| `scheme` |")[2]
    assert f"`{scheme}`" in results.partition("\n")[0]


TEXTS = ["README.md", *sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("docs/*.md"))]

LONG = (
    *(["analyze", part] for part in ("positioning", "correspondence", "errors", "budget")),
    *(["advise"], ["cameras"], ["session", "correct"], ["session", "export"]),
)
"""Examples that are not run below: they take minutes, need a camera, or are run above."""

FEWER = {"simulate": "--frames 2", "reconstruct": "--frames 0", "record": "--seconds 0.2"}
"""Options that shorten examples."""


def examples(text: str) -> list[list[str]]:
    """Commands of the examples in a text: their arguments after ``labapp``."""
    joined = re.sub(r"\\\n\s*", " ", (ROOT / text).read_text("utf-8"))
    lines = re.findall(r"^    labapp (.*)$", joined, re.MULTILINE)
    return [shlex.split(line, comments=True) for line in lines]


def shown_files(text: str) -> dict[str, str]:
    """Files that a text shows completely, by name."""
    files = re.findall(
        r'^```toml title="(.+?)"\n(.*?)```', (ROOT / text).read_text("utf-8"), re.M | re.S
    )
    return dict(files)


@pytest.mark.parametrize("text", TEXTS)
def test_options_and_files_of_examples_exist(text: str, tmp_path: Path) -> None:
    """A file is in the checkout, or an earlier example writes it."""
    written = {"bench.toml", *shown_files(text)}
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
                written.add(word)
            elif set(path) & set("*{"):  # a pattern
                continue
            elif re.search(r"\.[a-z]+$", path) and path.partition("/")[0] not in written:
                assert (ROOT / path).is_file(), words


@pytest.mark.parametrize("text", [text for text in TEXTS if examples(text)])
def test_examples_run_in_order(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, labapp: Run
) -> None:
    for folder in ("sample_sessions", "resources"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    monkeypatch.chdir(tmp_path)
    for name, content in shown_files(text).items():
        Path(name).write_text(content, "utf-8")
    for words in examples(text):
        if any(words[: len(skipped)] == skipped for skipped in LONG):
            continue
        fewer = FEWER.get(words[0], "").split()
        if words[:2] == ["session", "measure"]:
            fewer = ["--frames", "0"]
        if fewer and fewer[0] in words:
            index = words.index(fewer[0])
            words[index : index + 2] = []
        if "--lines" in words:
            words[words.index("--lines") + 1] = "0"  # any free port
        code, _, stderr = labapp(*words, *fewer)
        assert code == 0, stderr
    if text in (
        "docs/studies.md",
        "docs/penetration.md",
    ):  # the Python examples use the files written by the commands
        for example in re.findall(r"```python\n(.*?)```", (ROOT / text).read_text("utf-8"), re.S):
            exec(example, {})


def test_commands_in_the_texts_are_complete_and_valid() -> None:
    program = typer.main.get_command(cli.app)
    for text in (*TEXTS, *(str(path.relative_to(ROOT)) for path in ROOT.glob("docs/guide/*.md"))):
        commands = re.findall(r"`(?:\./run )?labapp ([^`]*)`", (ROOT / text).read_text("utf-8"))
        assert not [command for command in commands if "…" in command], text
        for words in (shlex.split(command) for command in commands):
            command: object = program
            while isinstance(command, typer.core.TyperGroup) and words and words[0][0].islower():
                command = command.commands[words.pop(0)]
            if isinstance(command, typer.core.TyperCommand):
                options = [name for parameter in command.params for name in parameter.opts]
                for word in words:
                    assert word in options or not word.startswith("--"), (text, command.name, word)
