"""Kinds of dot pattern: their requirements; an added one is read, simulated and measured."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomlkit

from labapp.config.setup import (
    parse_setup,
    pattern_values,
    read_setup,
    update_setup,
    updated_setup,
)
from labapp.core.geometry.bench import Bench
from labapp.core.geometry.optics import ray_directions
from labapp.core.geometry.patterns import PATTERNS, PatternKind, square
from labapp.core.geometry.rig import DotPattern, Rig
from labapp.core.pipeline import Settings, measure
from labapp.errors import InputError
from labapp.simulation.forward import trace
from labapp.simulation.pools import spherical_cap
from labapp.studies.image_error import BENCH, VIEW, axes_of, rendered

SETUP = Path(__file__).parents[2] / "sample_sessions" / "gtaw" / "setup.toml"


def stretched(rows: int, columns: int, step: float) -> np.ndarray:
    """Return a pattern with rows closer than columns, each slightly shifted from the one above."""
    tangents = square(rows, columns, step)
    tangents[..., 1] *= 0.9
    tangents[..., 0] += 0.2 * tangents[..., 1]
    return tangents


@pytest.fixture(autouse=True)
def one_kind_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PATTERNS, "stretched", PatternKind("stretched", stretched))


@pytest.mark.parametrize("kind", [*PATTERNS, "stretched"])
def test_pattern_kind_has_rows_and_columns_around_the_axis(kind: str) -> None:
    step = np.radians(0.77)
    tangents = PATTERNS[kind].tangents(19, 17, step)
    assert tangents.shape == (19, 17, 2)
    np.testing.assert_allclose(tangents[9, 8], 0, atol=1e-15)
    assert (np.diff(tangents[..., 0], axis=1) > 0).all()
    assert (np.diff(tangents[..., 1], axis=0) < 0).all()
    # The boundary needs the rays that would come next on all sides.
    np.testing.assert_allclose(
        PATTERNS[kind].tangents(21, 19, step)[1:-1, 1:-1], tangents, atol=1e-15
    )
    # Limits of setup values are derived from the angle: no neighbours are farther apart.
    assert np.abs(np.diff(tangents[9, :, 0])).min() <= np.tan(step) * (1 + 1e-9)
    assert np.abs(np.diff(tangents[:, 8, 1])).min() <= np.tan(step) * (1 + 1e-9)


@pytest.mark.parametrize("kind", PATTERNS)
def test_kind_is_documented(kind: str) -> None:
    table = (
        (SETUP.parents[2] / "docs/command-line.md").read_text("utf-8").partition("`[pattern]`")[2]
    )
    assert f'`"{kind}"`' in table


def test_setup_file_names_the_kind() -> None:
    text = SETUP.read_text("utf-8")
    usual = parse_setup(text, SETUP)
    assert usual.rig.pattern.kind == "square"
    assert "kind" not in pattern_values(usual.rig.pattern)
    other = parse_setup(updated_setup(text, SETUP, {"pattern": {"kind": "stretched"}}), SETUP)
    assert other.rig.pattern == replace(usual.rig.pattern, kind="stretched")
    again = updated_setup(text, SETUP, {"pattern": pattern_values(other.rig.pattern)})
    assert tomllib.loads(again)["pattern"]["kind"] == "stretched"
    with pytest.raises(InputError, match=r"pattern\.kind: .rings.; expected one of square"):
        parse_setup(updated_setup(text, SETUP, {"pattern": {"kind": "rings"}}), SETUP)


def test_simulation_and_measurement_have_the_same_rays() -> None:
    rig = replace(BENCH, pattern=DotPattern(kind="stretched"))
    assert not np.allclose(
        ray_directions(rig.laser, rig.pattern), ray_directions(rig.laser, DotPattern())
    )
    np.testing.assert_allclose(
        trace(spherical_cap(6.0, 0.3), rig).incident,
        ray_directions(rig.laser, rig.pattern),
        atol=1e-12,
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*PATTERNS, "stretched"])
def test_frame_of_every_kind_is_measured(kind: str) -> None:
    rig = replace(BENCH, pattern=DotPattern(kind=kind))
    frame = rendered(spherical_cap(6.0, 0.3), rig, 0)
    result = measure(frame.image, Bench(rig, axes_of(VIEW).calibration), Settings())[0]
    assert result.status == "ok", result.reason
    assert result.match is not None
    assert result.measures is not None
    assert len(result.match.ray) > 0.9 * frame.shown.sum()
    true_px = frame.dot_px[tuple(result.match.ray.T - 1)]
    assert result.dots is not None
    assert np.abs(result.dots.image_px[result.match.dot] - true_px).max() < 3
    assert result.measures.height_mm == pytest.approx(0.3, abs=0.002)


def test_hexagonal_pattern_is_a_hexagon_of_rays() -> None:
    pattern = DotPattern(21, 21, 0.7, kind="hexagonal")
    present = [
        ray for ray in np.ndindex(21, 21) if (ray[0] + 1, ray[1] + 1) not in pattern.absent_rays
    ]
    assert len(present) == 331 - 1
    assert pattern.marker == (11, 11)
    tangents = pattern.tangents
    places = np.array([tangents[ray] for ray in present])
    distances = np.sort(np.linalg.norm(places - tangents[12, 12], axis=-1))[1:8]
    np.testing.assert_allclose(distances[:6], np.tan(np.radians(0.7)), rtol=0.02)
    assert distances[6] > 1.5 * distances[5]
    corners = [tangents[10, 0], tangents[10, 20], tangents[0, 5], tangents[20, 15]]
    np.testing.assert_allclose(np.linalg.norm(corners, axis=-1), np.tan(np.radians(7.0)), rtol=0.02)


def bent(rows: int, columns: int, step: float) -> np.ndarray:
    """Return a square pattern stretched towards the rim, by 3 % at the corners."""
    tangents = square(rows, columns, step)
    share = np.sum(tangents**2, axis=-1, keepdims=True) / np.sum(tangents[0, 0] ** 2)
    return np.asarray(tangents * (1 + 0.03 * share))


def ray_table(rig: Rig, universal: bool) -> str:
    """Return a table of a rig's rays, in the UCS or relative to the beam axis."""
    directions = ray_directions(rig.laser, rig.pattern)
    if not universal:
        axis, aside, up = rig.laser.axes
        directions = directions @ np.array([aside, up, axis]).T
    names = "x,y,z" if universal else "aside,up,along"
    lines = [f"ray_row,ray_column,{names}"]
    for i, j in np.ndindex(directions.shape[:2]):
        if (i + 1, j + 1) not in rig.pattern.absent_rays:
            lines.append(f"{i + 1},{j + 1}," + ",".join(f"{v:.9f}" for v in directions[i, j]))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("universal", [True, False])
def test_measured_rays_are_read_from_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, universal: bool
) -> None:
    monkeypatch.setitem(PATTERNS, "bent", PatternKind("bent", bent))
    path = tmp_path / "setup.toml"
    path.write_text(SETUP.read_text("utf-8"), "utf-8")
    update_setup(path, {"pattern": {"kind": "bent", "rotation_deg": 1.5}})
    true = read_setup(path).rig
    (tmp_path / "rays.csv").write_text(ray_table(true, universal), "utf-8")
    removed = {"rows": None, "columns": None, "inter_beam_angle_deg": None}
    update_setup(path, {"pattern": {"kind": "directions", "file": "rays.csv", **removed}})
    if not universal:  # a table relative to the beam axis includes the rotation
        update_setup(path, {"pattern": {"rotation_deg": None}})
    setup = read_setup(path)
    pattern = setup.rig.pattern
    assert (pattern.rows, pattern.columns) == (19, 19)
    assert pattern.absent_rays == true.pattern.absent_rays
    assert pattern.marker == true.pattern.marker
    present = np.ones((19, 19), bool)
    present[tuple(np.array(sorted(true.pattern.absent_rays)).T - 1)] = False
    np.testing.assert_allclose(
        ray_directions(setup.rig.laser, pattern)[present],
        ray_directions(true.laser, true.pattern)[present],
        atol=1e-8,
    )
    # The absent ray and those beyond the rim are extrapolated from their neighbours.
    wider = replace(pattern, rows=21, columns=21), replace(true.pattern, rows=21, columns=21)
    rays = [ray_directions(true.laser, one) for one in wider]
    assert np.abs(rays[0] - rays[1]).max() < 0.15 * np.radians(pattern.inter_beam_angle_deg)
    # The text contains the rays: a session needs no table.
    (tmp_path / "rays.csv").unlink()
    assert parse_setup(setup.text, "elsewhere").rig.pattern == pattern
    again = updated_setup(setup.text, path, {"pattern": pattern_values(pattern)})
    assert parse_setup(again, path).rig.pattern == pattern


@pytest.mark.parametrize(
    "head",
    [
        'pattern = { kind = "directions", file = "rays.csv" }\n',
        'pattern.kind = "directions"\npattern.file = "rays.csv"\n',
    ],
    ids=["inline", "dotted"],
)
def test_pattern_may_be_an_inline_table_or_dotted_keys(tmp_path: Path, head: str) -> None:
    text = SETUP.read_text("utf-8")
    rig = parse_setup(text, SETUP).rig
    others = {
        section: keys for section, keys in tomllib.loads(text).items() if section != "pattern"
    }
    (tmp_path / "rays.csv").write_text(ray_table(rig, True), "utf-8")
    path = tmp_path / "setup.toml"
    path.write_text(head + tomlkit.dumps(others), "utf-8")
    assert len(read_setup(path).rig.pattern.measured) == 360


@pytest.mark.parametrize(
    ("keys", "table", "field"),
    [
        ({"file": "../rays.csv"}, "", "pattern.file"),
        ({"file": "/etc/passwd"}, "", "pattern.file"),
        ({"file": "c:\\rays.csv"}, "", "pattern.file"),
        ({"file": "other.csv"}, "", "file"),
        ({}, "ray_row,ray_column,x,y\n", "line 1, names"),
        ({}, "ray_row,ray_column,x,y,z\n1,1,0,0,-1\n1,1,0,0,-1\n", "line 3"),
        ({}, "ray_row,ray_column,x,y,z\n1,0,0,0,-1\n", "line 2, ray"),
        ({}, "ray_row,ray_column,x,y,z\n1,1,0,0,-0.5\n", "line 2, direction"),
        ({}, "ray_row,ray_column,x,y,z\n1,1,0,nan,-1\n", "line 2, direction"),
        ({}, "ray_row,ray_column,x,y,z\n1,1,0,0,-1\n", "rays"),
        ({"rows": 17}, None, "pattern.rays"),
        ({"rows": 18}, None, "pattern.rows"),
        ({"rows": "many"}, None, "pattern.rows"),
        ({"inter_beam_angle_deg": -1.0}, None, "pattern.inter_beam_angle_deg"),
        ({"inter_beam_angle_deg": float("nan")}, None, "pattern.inter_beam_angle_deg"),
        ({"file": None}, None, "pattern.rays"),
    ],
)
def test_invalid_table_of_rays_is_rejected(
    tmp_path: Path, keys: dict[str, object], table: str | None, field: str
) -> None:
    path = tmp_path / "setup.toml"
    text = SETUP.read_text("utf-8")
    rig = parse_setup(text, SETUP).rig
    (tmp_path / "rays.csv").write_text(ray_table(rig, True) if table is None else table, "utf-8")
    pattern = {"kind": "directions", "file": "rays.csv"} | keys
    path.write_text(updated_setup(text, path, {"pattern": pattern}), "utf-8")
    with pytest.raises(InputError) as error:
        read_setup(path)
    assert error.value.field == field


@pytest.mark.slow
@pytest.mark.parametrize("pattern", ["hexagonal", "directions", "two markers", "denser"])
def test_frames_of_other_patterns_are_measured(
    pattern: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(PATTERNS, "bent", PatternKind("bent", bent))
    true, known = {
        "hexagonal": (DotPattern(21, 21, 0.72, kind="hexagonal"),) * 2,
        "directions": (DotPattern(kind="bent"), measured_pattern(DotPattern(kind="bent"))),
        "two markers": (DotPattern(absent=frozenset({(10, 10), (8, 13)})),) * 2,
        "denser": (DotPattern(37, 37, 0.385),) * 2,
    }[pattern]
    rig = replace(BENCH, pattern=true)
    frame = rendered(spherical_cap(6.0, 0.3), rig, 3)
    bench = Bench(replace(rig, pattern=known), axes_of(VIEW).calibration)
    result = measure(frame.image, bench, Settings())[0]
    assert result.status == "ok", result.reason
    assert result.match is not None
    assert result.measures is not None
    assert result.dots is not None
    assert len(result.match.ray) > 0.9 * frame.shown.sum()
    true_px = frame.dot_px[tuple(result.match.ray.T - 1)]
    assert np.abs(result.dots.image_px[result.match.dot] - true_px).max() < 2.5
    assert result.measures.height_mm == pytest.approx(0.3, abs=0.01)


def measured_pattern(pattern: DotPattern) -> DotPattern:
    """Return the pattern as if its rays were measured individually."""
    steps = pattern.tangents / np.tan(np.radians(pattern.inter_beam_angle_deg))
    i, j = pattern.center_ray
    rays = (ray for ray in np.ndindex(steps.shape[:2]))
    measured = tuple(
        (a + 1 - i, b + 1 - j, *steps[a, b].tolist())
        for a, b in rays
        if (a + 1, b + 1) not in pattern.absent_rays
    )
    return replace(pattern, kind="directions", measured=measured, absent=frozenset())
