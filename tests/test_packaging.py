"""The package descriptions fit the program: the files that they name exist, for each system."""

from __future__ import annotations

import configparser
import re
import shlex
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import pytest

from labapp import __version__
from labapp.session.file.database import SUFFIX

ROOT = Path(__file__).resolve().parents[1]
PACKAGING = ROOT / "packaging"


class FakeClass:
    """Replacement for PyInstaller's classes, which records their arguments."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self.args, self.options = args, options
        self.pure: list[Any] = []
        self.scripts: list[Any] = []
        self.datas: list[Any] = list(options.get("datas", []))
        self.binaries: list[Any] = [
            (name, f"/site-packages/{name}", "BINARY")
            for name in (
                *("libstdc++.so.6", "vtkmodules/libvtkCommonCore.so", "libvtkCommonCore.so"),
                *("vtkmodules/libviskores_cont.so", "vtkmodules/viskores_cont.dll"),
                *("vtkmodules/vtkTestingCore.abi3.so", "pyarrow/libarrow_flight.so.2600"),
                *("pyarrow/libarrow.so.2600", "pyarrow/_flight.abi3.so", "pyarrow/_fs.abi3.so"),
            )
        ]


def run_specification(monkeypatch: pytest.MonkeyPatch, platform: str) -> dict[str, Any]:
    """Run PyInstaller's specification as on a given platform; return its names."""
    hooks = ModuleType("PyInstaller.utils.hooks")
    hooks.__dict__.update(
        collect_all=lambda package: ([], [], [package]),
        collect_submodules=lambda package: [package],
    )
    for name in ("PyInstaller", "PyInstaller.utils"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, hooks.__name__, hooks)
    with monkeypatch.context() as patched:
        patched.setattr(sys, "platform", platform)
        names: dict[str, Any] = {
            "SPECPATH": str(PACKAGING),
            **dict.fromkeys(("Analysis", "PYZ", "EXE", "COLLECT"), FakeClass),
        }
        bundles: list[FakeClass] = []
        names["BUNDLE"] = lambda *args, **options: bundles.append(FakeClass(*args, **options))
        exec(compile((PACKAGING / "labapp.spec").read_text("utf-8"), "labapp.spec", "exec"), names)
    return {**names, "bundles": bundles}


@pytest.mark.parametrize("platform", ["linux", "win32", "darwin"])
def test_specification_names_existing_files(platform: str, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run_specification(monkeypatch, platform)
    analysis, program = names["analysis"], names["program"]
    assert all(Path(script).is_file() for script in analysis.args[0])
    assert all(Path(source).exists() for source, _ in analysis.options["datas"])
    targets = {target for _, target in analysis.options["datas"]}
    assert targets == {"labapp/resources", "labapp/docs/guide", "labapp/sample_sessions"}
    assert Path(program.options["icon"]).is_file()
    binaries = {name for name, _, _ in analysis.binaries}
    assert {"vtkmodules/libvtkCommonCore.so", "pyarrow/libarrow.so.2600"} <= binaries
    assert {"libvtkCommonCore.so", "pyarrow/_fs.abi3.so"} <= binaries
    assert not [name for name in binaries if re.search("viskores|Testing|flight", name)]
    assert ("libstdc++.so.6" in binaries) == (platform != "linux")
    assert len(names["bundles"]) == (platform == "darwin")
    for bundle in names["bundles"]:
        (kind,) = bundle.options["info_plist"]["CFBundleDocumentTypes"]
        assert kind["CFBundleTypeExtensions"] == [SUFFIX[1:]]


def test_windows_installer_contains_the_frozen_program(monkeypatch: pytest.MonkeyPatch) -> None:
    names = run_specification(monkeypatch, "win32")
    frozen, program = names["folder"].options["name"], names["program"].options["name"]
    text = (PACKAGING / "labapp.iss").read_text("utf-8")
    (source,) = re.findall(r'^Source: "(.+?)"', text, re.M)
    assert source == rf"..\build\frozen\{frozen}\*"
    assert set(re.findall(r"\{app\}\\([\w.]+)", text)) == {f"{program}.exe"}
    assert rf"Software\Classes\{SUFFIX}" in text
    assert f"/DVersion={__version__}" in text
    for file in re.findall(r"packaging\\([\w.]+)", text):
        assert (PACKAGING / file).is_file(), file
    sections = re.findall(r"^\[(\w+)\]", text, re.M)
    assert sections == ["Setup", "Files", "Icons", "Registry"]
    for line in filter(None, map(str.strip, text.splitlines())):
        assert re.match(r"(;|#|\[|\w+=|\w+: )", line), line


def test_debian_package_installs_existing_files() -> None:
    text = (PACKAGING / "build.sh").read_text("utf-8")
    for line in re.findall(r"^ +cp ((?:packaging|resources)/.*)$", text, re.M):
        assert (ROOT / shlex.split(line)[0]).is_file(), line
    (depends,) = re.findall(r"^Depends: (.*)$", text, re.M)
    (required,) = re.findall(r"^packages='(.*?)'", (ROOT / "run").read_text("utf-8"), re.M | re.S)
    assert set(required.split()) - {"ca-certificates"} <= set(re.findall(r"[\w.+-]+", depends))


def test_sessions_are_associated_with_labapp_on_linux() -> None:
    entry = configparser.ConfigParser(interpolation=None)
    entry.read(PACKAGING / "labapp.desktop", "utf-8")
    desktop = entry["Desktop Entry"]
    assert desktop["Exec"].split() == ["labapp", "%f"]
    name = "{http://www.freedesktop.org/standards/shared-mime-info}"
    (kind,) = ElementTree.parse(PACKAGING / "labapp-mime.xml").getroot()
    assert desktop["MimeType"].rstrip(";").split(";") == [kind.get("type")]
    glob = kind.find(f"{name}glob")
    assert glob is not None
    assert glob.get("pattern") == f"*{SUFFIX}"
    assert (ROOT / "resources/icons" / f"{desktop['Icon']}.svg").is_file()
