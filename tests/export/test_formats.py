"""The formats of an export: a format added to the registry is written and offered everywhere."""

from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.pipeline import Measurement
from labapp.core.values import FloatArray
from labapp.errors import InputError
from labapp.export.folder import ExportChoice, export
from labapp.export.formats import (
    RUN_FORMATS,
    SURFACE_FORMATS,
    RunFormat,
    SurfaceFormat,
    add_export_format,
    mesh_formats,
)
from labapp.export.frame_result import FrameResult
from labapp.export.meshes import Mesh
from tests.conftest import Run

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "sample_sessions/gtaw/gtaw.labsession"


def xyz(nodes: FloatArray) -> bytes:
    """A list of points in the usual form of point clouds."""
    return "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in nodes).encode()


def off(mesh: Mesh) -> bytes:
    return f"OFF\n{len(mesh.vertices_mm)} {len(mesh.triangles)} 0\n".encode()


class Frames:
    """Writes numbers and statuses of the frames as JSON."""

    def __init__(self, path: Path, about: dict[str, object], spacing_mm: float) -> None:
        self.path, self.about, self.frames = path, about, {}

    def write(self, frame: int, tables: dict, reconstruction: object) -> None:
        self.frames[frame] = (*tables["measures"]["status"], reconstruction is not None)

    def __enter__(self) -> Frames:
        return self

    def __exit__(self, *_: object) -> None:
        self.path.write_text(json.dumps({"by": self.about["program"], "frames": self.frames}))


@pytest.fixture(autouse=True)
def toys(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add three formats: points, triangles, and one file of all frames."""
    module = ModuleType("labapp.export.toys")
    module.__dict__.update(xyz=xyz, off=off, Frames=Frames)
    monkeypatch.setitem(sys.modules, "labapp.export.toys", module)
    for name, content in (("xyz", "nodes"), ("off", "mesh")):
        toy = SurfaceFormat(f".{name}", name.upper(), "A toy, mm", content, f"toys:{name}")
        monkeypatch.setitem(SURFACE_FORMATS, name, toy)
    json_format = RunFormat("frames.json", "JSON", "A toy", "toys:Frames")
    monkeypatch.setitem(RUN_FORMATS, "json", json_format)


def test_added_formats_are_exported(
    measured: Measurement, unmeasured: Measurement, calibration: ImageCalibration, tmp_path: Path
) -> None:
    choice = ExportChoice(
        tables=frozenset(),
        surfaces=frozenset({"csv", "xyz", "off"}),
        solid=True,
        together=frozenset({"json"}),
        spacing_mm=0.5,
    )
    frames = [FrameResult(3, 0.5, measured), FrameResult(4, None, unmeasured)]
    written = export(tmp_path / "out", frames, calibration, {}, choice)
    assert [file.name for file in written] == [
        *("frames.json", "solid_000003.off"),
        *("surface_000003.csv", "surface_000003.off", "surface_000003.xyz"),
    ]
    points = np.loadtxt(tmp_path / "out/surface_000003.xyz")
    table = np.loadtxt(tmp_path / "out/surface_000003.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(points, table)
    assert json.loads((tmp_path / "out/frames.json").read_text()) == {
        "by": "labapp",
        "frames": {"3": ["ok", True], "4": ["ambiguous-rows", False]},
    }
    with pytest.raises(InputError) as caught:
        ExportChoice(surfaces=frozenset({"no-format"}))
    assert caught.value.expected == f"some of {', '.join(SURFACE_FORMATS)}"
    with pytest.raises(InputError) as caught:
        ExportChoice(surfaces=frozenset({"xyz"}), solid=True)
    assert caught.value.expected.startswith(f"one of {', '.join(mesh_formats())}")
    with pytest.raises(InputError) as caught:
        ExportChoice(together=frozenset({"no-format"}))
    assert caught.value.expected == f"some of {', '.join(RUN_FORMATS)}"


def test_command_line_offers_and_writes_added_formats(
    labapp: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "250")
    code, stdout, _ = labapp("session", "export", "--help")
    assert code == 0
    assert f"Some of {', '.join(SURFACE_FORMATS)}, or none" in stdout
    assert f"some of {', '.join(RUN_FORMATS)}, or none" in stdout
    code, _, stderr = labapp(
        *("session", "export", SAMPLE, "--out", tmp_path / "out", "--frames", "4"),
        *("--no-tables", "--surfaces", "xyz", "--together", "json"),
    )
    assert (code, stderr) == (0, "")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        *("frames.json", "manifest.json", "surface_000004.xyz")
    ]


PACKAGE = """
import labapp

def asc(nodes):
    return "".join(f"{x:.6f};{y:.6f};{z:.6f}\\n" for x, y, z in nodes).encode()

ASC = labapp.SurfaceFormat(".asc", "ASC", "x; y; z, mm", "nodes", asc)
"""


def test_package_adds_formats_by_an_entry_point(tmp_path: Path) -> None:
    site = tmp_path / "site"
    about = site / "toy_format-1.dist-info"
    about.mkdir(parents=True)
    (site / "toy_format.py").write_text(PACKAGE)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-format\nVersion: 1\n")
    (about / "entry_points.txt").write_text(
        "[labapp.exports]\nasc = toy_format:ASC\nbroken = toy_format:NOTHING\n"
    )
    out = tmp_path / "out"
    process = subprocess.run(
        [
            *(sys.executable, "-m", "labapp", "session", "export", SAMPLE, "--out", out),
            *("--frames", "4", "--no-tables", "--surfaces", "asc,csv"),
        ],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(site), str(ROOT)])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    assert "broken" in process.stderr
    assert "Traceback" not in process.stderr
    points = np.loadtxt(out / "surface_000004.asc", delimiter=";")
    table = np.loadtxt(out / "surface_000004.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(points, table)


def test_added_format_needs_a_new_name_and_suffix() -> None:
    toy = SurfaceFormat(".toy", "Toy", "A toy, mm", "nodes", xyz)
    add_export_format("toy", toy)
    try:
        assert ExportChoice(surfaces=frozenset({"toy"})).surfaces == {"toy"}
        for name, added, field in (
            ("toy", SurfaceFormat(".new", "Toy", "", "nodes", xyz), "name"),
            ("hdf5", SurfaceFormat(".new", "Toy", "", "nodes", xyz), "name"),
            ("two,names", SurfaceFormat(".new", "Toy", "", "nodes", xyz), "name"),
            ("none", SurfaceFormat(".new", "Toy", "", "nodes", xyz), "name"),
            ("new", SurfaceFormat(".stl", "Toy", "", "nodes", xyz), "end"),
            ("new", RunFormat("results.h5", "Toy", "", Frames), "file"),
            ("new", xyz, "type"),
        ):
            with pytest.raises(InputError) as caught:
                add_export_format(name, added)
            assert caught.value.field == field
        assert "new" not in SURFACE_FORMATS
    finally:
        del SURFACE_FORMATS["toy"]


@pytest.mark.parametrize(
    ("added", "field", "value"),
    [
        (SurfaceFormat(".bad", "S", "t", "other", xyz), "of", "other"),  # type: ignore[arg-type]
        *(
            (SurfaceFormat(end, "S", "t", "nodes", xyz), "end", end)
            for end in ("", "bad", ".", "/../x.bad", ".b/d", "\\x.bad", ".bad ", ".b:d", "1.bad")
        ),
        *((SurfaceFormat(end, "S", "t", "mesh", off), "end", end) for end in (".png", ".PNG")),
        (SurfaceFormat(".STL", "S", "t", "mesh", off), "end", ".STL"),
        *(
            (RunFormat(file, "R", "t", Frames), "file", file)
            for file in (
                *("", ".", "..", ".bad", "a/b.bad", "a\\b.bad", "../b.bad", "b.bad ", "b:d.bad"),
                *("manifest.json", "Manifest.JSON", "trends.png", "film.mp4", "report.pdf"),
                *("measures.csv", "dots.csv", "points.csv", "boundary.csv", "Results.h5"),
                *("surface_000003.bad", "solid_000003.bad", "frame_000003.png"),
            )
        ),
    ],
)
def test_format_that_could_not_be_written_is_refused(
    added: SurfaceFormat | RunFormat, field: str, value: str
) -> None:
    before = dict(SURFACE_FORMATS), dict(RUN_FORMATS)
    with pytest.raises(InputError) as caught:
        add_export_format("bad", added)
    assert (caught.value.field, caught.value.value) == (field, value)
    assert before == (SURFACE_FORMATS, RUN_FORMATS)


@pytest.mark.parametrize(
    "added",
    [
        SurfaceFormat("_fine-1.tar.gz", "S", "t", "mesh", off),
        RunFormat("My results (all).json", "R", "t", Frames),
        RunFormat("surfaces.json", "R", "t", Frames),
    ],
)
def test_plain_file_names_are_accepted(added: SurfaceFormat | RunFormat) -> None:
    registry = SURFACE_FORMATS if isinstance(added, SurfaceFormat) else RUN_FORMATS
    add_export_format("fine", added)
    assert registry.pop("fine") is added


def test_writer_that_returns_no_bytes_is_named() -> None:
    text = SurfaceFormat(".toy", "Toy", "A toy, mm", "nodes", lambda nodes: str(len(nodes)))
    with pytest.raises(InputError) as caught:
        text.content(np.zeros((2, 3)))
    assert (caught.value.source, caught.value.value) == ("export format Toy", "str")


def test_hdf5_is_a_format_of_a_whole_run() -> None:
    combined = ExportChoice(hdf5=True, together=frozenset({"json"}))
    assert [run_format.file for run_format in combined.run_formats] == ["results.h5", "frames.json"]
    assert [
        run_format.file for run_format in ExportChoice(together=frozenset({"hdf5"})).run_formats
    ] == ["results.h5"]
    assert ExportChoice().run_formats == []


@pytest.mark.parametrize("name", [*SURFACE_FORMATS, *RUN_FORMATS])
def test_every_format_has_a_writer_and_documentation(name: str) -> None:
    export_format = (SURFACE_FORMATS | RUN_FORMATS)[name]
    assert isinstance(export_format.writer, str)
    module, _, function = export_format.writer.partition(":")
    writer = getattr(__import__(f"labapp.export.{module}", fromlist=[function]), function)
    if isinstance(export_format, SurfaceFormat):
        assert list(inspect.signature(writer).parameters) == [export_format.of]
        assert (name in mesh_formats()) == (export_format.of == "mesh")
    options = (ROOT / "docs/command-line.md").read_text("utf-8").partition("### export")[2]
    assert name in options
    end = export_format.end if isinstance(export_format, SurfaceFormat) else export_format.file
    assert end in (ROOT / "docs/results.md").read_text("utf-8")
