"""The descriptions of packages fit the program: what they name is there, on each system's terms."""

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


class Made:
    """Takes the place of PyInstaller's classes; keeps what they were given."""

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


def specified(monkeypatch: pytest.MonkeyPatch, platform: str) -> dict[str, Any]:
    """Run PyInstaller's description as on a system; return its names."""
    hooks = ModuleType("PyInstaller.utils.hooks")
    hooks.__dict__.update(
        collect_all=lambda package: ([], [], [package]),
        collect_submodules=lambda package: [package],
    )
    for name in ("PyInstaller", "PyInstaller.utils"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, hooks.__name__, hooks)
    with monkeypatch.context() as there:
        there.setattr(sys, "platform", platform)
        names: dict[str, Any] = {
            "SPECPATH": str(PACKAGING),
            **dict.fromkeys(("Analysis", "PYZ", "EXE", "COLLECT"), Made),
        }
        bundles: list[Made] = []
        names["BUNDLE"] = lambda *args, **options: bundles.append(Made(*args, **options))
        exec(compile((PACKAGING / "labapp.spec").read_text("utf-8"), "labapp.spec", "exec"), names)
    return {**names, "bundles": bundles}


@pytest.mark.parametrize("platform", ["linux", "win32", "darwin"])
def test_the_specification_names_files_that_are_there(
    platform: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = specified(monkeypatch, platform)
    analysis, program = made["analysis"], made["program"]
    assert all(Path(script).is_file() for script in analysis.args[0])
    assert all(Path(source).exists() for source, _ in analysis.options["datas"])
    into = {target for _, target in analysis.options["datas"]}
    assert into == {"labapp/resources", "labapp/docs/guide", "labapp/sample_sessions"}
    assert Path(program.options["icon"]).is_file()
    kept = {name for name, _, _ in analysis.binaries}
    assert {"vtkmodules/libvtkCommonCore.so", "pyarrow/libarrow.so.2600"} <= kept
    assert {"libvtkCommonCore.so", "pyarrow/_fs.abi3.so"} <= kept
    assert not [name for name in kept if re.search("viskores|Testing|flight", name)]
    assert ("libstdc++.so.6" in kept) == (platform != "linux")
    assert len(made["bundles"]) == (platform == "darwin")
    for bundle in made["bundles"]:
        (kind,) = bundle.options["info_plist"]["CFBundleDocumentTypes"]
        assert kind["CFBundleTypeExtensions"] == [SUFFIX[1:]]


def test_the_installer_for_windows_packs_what_is_frozen(monkeypatch: pytest.MonkeyPatch) -> None:
    made = specified(monkeypatch, "win32")
    frozen, program = made["folder"].options["name"], made["program"].options["name"]
    text = (PACKAGING / "labapp.iss").read_text("utf-8")
    (source,) = re.findall(r'^Source: "(.+?)"', text, re.M)
    assert source == rf"..\build\frozen\{frozen}\*"
    assert set(re.findall(r"\{app\}\\([\w.]+)", text)) == {f"{program}.exe"}
    assert rf"Software\Classes\{SUFFIX}" in text
    assert f"/DVersion={__version__}" in text
    for named in re.findall(r"packaging\\([\w.]+)", text):
        assert (PACKAGING / named).is_file(), named
    sections = re.findall(r"^\[(\w+)\]", text, re.M)
    assert sections == ["Setup", "Files", "Icons", "Registry"]
    for line in filter(None, map(str.strip, text.splitlines())):
        assert re.match(r"(;|#|\[|\w+=|\w+: )", line), line


def test_the_debian_package_installs_files_that_are_there() -> None:
    text = (PACKAGING / "build.sh").read_text("utf-8")
    for line in re.findall(r"^ +cp ((?:packaging|resources)/.*)$", text, re.M):
        assert (ROOT / shlex.split(line)[0]).is_file(), line
    (depends,) = re.findall(r"^Depends: (.*)$", text, re.M)
    (wanted,) = re.findall(r"^packages='(.*?)'", (ROOT / "run").read_text("utf-8"), re.M | re.S)
    assert set(wanted.split()) - {"ca-certificates"} <= set(re.findall(r"[\w.+-]+", depends))


def test_sessions_open_in_labapp_on_linux() -> None:
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
