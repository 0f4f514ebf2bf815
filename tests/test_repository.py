"""Rules for the whole repository: lock file, texts, commands, code."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path
from urllib.parse import urlparse

import pytest

import labapp

ROOT = Path(__file__).resolve().parent.parent
MODULES = sorted((ROOT / "labapp").rglob("*.py"))
TEXTS = sorted(
    [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "resources").rglob("*.md")]
)

# Files over 500 lines and functions over 60, each with its reason.
LONG_FILES: dict[str, str] = {
    "labapp/session/session.py": "all that a script may do with a session, with its checks",
    "labapp/gui/pages/dots/page.py": "the keys and buttons of dots, and the change to lines",
}
LONG_FUNCTIONS: dict[str, str] = {}

REPOSITORY_FOLDERS = (
    *(".ci", ".github", "docs", "labapp", "packaging", "resources", "sample_sessions", "tests"),
)


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def repository_files() -> Iterator[Path]:
    """Files that git would track, listed without git, which may not be installed."""
    for top in ROOT.iterdir():
        if top.is_file() and top.name != ".git":  # a file in a work tree
            yield top
    for folder in REPOSITORY_FOLDERS:
        for path in (ROOT / folder).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                yield path


# --- lock and package -------------------------------------------------------------------------


def test_lock_names_only_the_public_hosts():
    lock = (ROOT / "uv.lock").read_text("utf-8")
    registries = set(re.findall(r'registry = "([^"]*)"', lock))
    hosts = {urlparse(url).netloc for url in re.findall(r'url = "([^"]*)"', lock)}
    assert registries == {"https://pypi.org/simple"}
    assert hosts == {"files.pythonhosted.org"}
    local = [p["name"] for p in tomllib.loads(lock)["package"] if "registry" not in p["source"]]
    assert local == ["labapp"]


def test_version_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)
    assert newest is not None
    assert project["version"] == labapp.__version__ == newest[1]


def test_core_needs_no_drawing_packages():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    names = {re.split(r"[<>=\[]", line)[0].lower() for line in project["dependencies"]}
    assert "numpy" in names
    assert not names & {"pyside6", "pyside6-essentials", "pyqtgraph", "pyvista", "pyvistaqt", "vtk"}


# --- texts ------------------------------------------------------------------------------------


def test_readme_opens_with_the_two_commands():
    lines = (ROOT / "README.md").read_text("utf-8").splitlines()
    assert lines[0].startswith("# ")
    commands = [line.split("#")[0].strip() for line in lines[1:5] if line.startswith("    ")]
    assert commands == ["./run demo", "./run test"]


def test_links_in_the_texts_are_not_broken():
    broken = [
        f"{relative(text)}: {target}"
        for text in TEXTS
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text.read_text("utf-8"))
        if "://" not in target and not (text.parent / target).exists()
    ]
    assert not broken


def test_decisions_are_numbered_without_gaps():
    names = sorted(path.name for path in (ROOT / "docs" / "adr").glob("0*.md"))
    assert [int(name[:4]) for name in names] == list(range(1, len(names) + 1))
    for name in names:
        title = (ROOT / "docs" / "adr" / name).read_text("utf-8").splitlines()[0]
        assert title.startswith(f"# {int(name[:4])}. ")
        assert f"]({name})" in (ROOT / "docs" / "adr" / "index.md").read_text("utf-8")


def test_no_file_contains_a_path_of_one_machine():
    one_machine = re.compile(r"(?<![\w.])/(?:root|work|farm|tmp|home|Users)/\w")
    paths = []
    for path in repository_files():
        try:
            text = path.read_text("utf-8")
        except UnicodeDecodeError:
            continue
        paths += [f"{relative(path)}: {m[0]}" for m in one_machine.finditer(text)]
    assert not paths


def test_sample_sessions_are_small_enough_for_git():
    files = [path for path in (ROOT / "sample_sessions").rglob("*") if path.is_file()]
    recorded: Counter[str] = Counter()
    for path in files:
        if path.suffix != ".labsession":
            recorded[path.relative_to(ROOT / "sample_sessions").parts[0]] += path.stat().st_size
    assert recorded
    assert max(recorded.values()) <= 5_000_000
    assert sum(path.stat().st_size for path in files) <= 20_000_000


# --- commands ---------------------------------------------------------------------------------


@pytest.mark.parametrize("script", ["run", ".ci/run"])
def test_scripts_are_executable(script: str):
    assert os.access(ROOT / script, os.X_OK)


def test_continuous_integration_runs_the_same_test():
    commands = (ROOT / ".ci" / "run").read_text("utf-8").splitlines()[1:]
    assert [line.split("&&")[-1].strip() for line in commands] == ["./run test"]


def test_run_includes_every_folder_of_tests(tmp_path: Path):
    """Even after its functions were called: one of them once overwrote the list of folders."""
    functions = (ROOT / "run").read_text("utf-8").split("\ncase ${1:-} in")[0]
    last = "compile_loops env; echo $core_tests $file_tests"
    (tmp_path / "env").mkdir()
    for loop in (ROOT / "labapp").rglob("*.py"):  # none is newer than the compiled files
        copy = tmp_path / loop.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(loop.read_bytes())
    (tmp_path / "env" / "loops-compiled").touch()
    (tmp_path / "run").write_text(f"{functions}\n{last}\n", "utf-8")
    process = subprocess.run(["sh", tmp_path / "run"], capture_output=True, text=True, check=True)
    folders = {path.relative_to(ROOT).parts[1] for path in (ROOT / "tests").rglob("*/test_*.py")}
    assert {*process.stdout.split(), "tests/gui"} == {f"tests/{folder}" for folder in folders}


def test_run_without_a_command_lists_the_commands():
    process = subprocess.run([ROOT / "run"], capture_output=True, text=True, check=False)
    assert process.returncode == 2
    assert {"./run demo", "./run test"} <= set(re.findall(r"\./run \w+", process.stderr))


def test_run_and_pyproject_require_the_same_uv():
    required = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["uv"]
    assert f"'uv{required['required-version']}'" in (ROOT / "run").read_text("utf-8")


def test_module_can_be_run_as_the_command():
    process = subprocess.run(
        [sys.executable, "-m", "labapp", "--help"], capture_output=True, text=True, check=False
    )
    assert process.returncode == 0, process.stderr
    for command in ("reconstruct", "detect", "calibrate", "demo"):
        assert command in process.stdout


# --- rules of the code -------------------------------------------------------------------------


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_every_module_has_a_docstring(path: Path):
    assert ast.get_docstring(ast.parse(path.read_text("utf-8")))


def test_no_import_is_circular():
    """Imports for type checking and within functions are included."""
    files = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in MODULES}
    files = {name.removesuffix(".__init__"): path for name, path in files.items()}
    imports: dict[str, set[str]] = {name: set() for name in files}
    for name, path in files.items():
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                imports[name] |= {alias.name for alias in node.names} & set(files)
            elif isinstance(node, ast.ImportFrom):
                assert node.module is not None, f"{name}: imports by a relative name"
                full_names = {f"{node.module}.{alias.name}" for alias in node.names}
                imports[name] |= {alias if alias in files else node.module for alias in full_names}
                imports[name] &= set(files)
    assert imports["labapp.gui.app"]
    TopologicalSorter(imports).prepare()  # its error names the modules of a cycle


def test_long_files_have_a_reason():
    lines = {relative(path): len(path.read_text("utf-8").splitlines()) for path in MODULES}
    assert {name for name, count in lines.items() if count > 500} == set(LONG_FILES)


def test_long_functions_have_a_reason():
    """Long means over 60 lines from the signature to the end, without the docstring."""
    long = set()
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                assert node.end_lineno is not None
                count = node.end_lineno - node.lineno + 1
                if ast.get_docstring(node) is not None:
                    docstring = node.body[0]
                    assert docstring.end_lineno is not None
                    count -= docstring.end_lineno - docstring.lineno + 1
                if count > 60:
                    long.add(f"{relative(path)}:{node.name}")
    assert long == set(LONG_FUNCTIONS)
