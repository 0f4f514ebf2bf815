"""Frames of every kind of pool through `labapp reconstruct`, compared with their truth.

Run as ``python tests/benchmarks/pool_kinds.py [--warm] [--frames N] [--seed S] [KIND …]``. Prints a
line per kind: frames, those measured, statuses of the others, wrong labels (each is listed), the
share of the shown dots with their ray, the error of the height. Fails if any label is wrong. With
``--warm`` the frame rate is 200 Hz, and each frame is followed from the previous one.
"""

from __future__ import annotations

import argparse
import csv
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from labapp.simulation.pools import egg

EXAMPLES = Path(__file__).parents[2] / "resources" / "simulations"

TRUE_PX = 3.0
"""A dot farther from its ray's true one, or nearer to another, has a wrong label."""

EGG = """shape = "egg"
width_mm = 6.66
head_mm = 3.0
tail_mm = 4.4
height_mm = 0.29
center_mm = [0.0, -0.6]
wander_percent = 2.0
"""

OTHERS = {
    "concave_cap": 'shape = "cap"\ndiameter_mm = 5.6\nheight_mm = -0.56\nwander_percent = 2.0',
    "concave_ellipsoid": 'shape = "ellipsoid"\nwidth_mm = 5.6\nlength_mm = 6.2\nheight_mm = -0.6\n'
    "center_mm = [0.1, -0.3]\nwander_percent = 2.0",
    "paraboloid": 'shape = "ellipsoid"\nwidth_mm = 6.4\nlength_mm = 7.2\nheight_mm = 0.3\n'
    "fullness = 0.0\ncenter_mm = [-0.1, -0.5]\nwander_percent = 2.0",
    "dent_and_wave": EGG + "[pool.dent]\ndepth_mm = 0.03\nradius_mm = 1.0\n"
    "[[pool.wave]]\nmode = [1, 1]\namplitude_mm = 0.02\nfrequency_hz = 50.0",
    "low_rear_and_rings": EGG + "[pool.low_rear]\ndrop_mm = 0.06\n"
    "[[pool.wave]]\nmode = [0, 2]\namplitude_mm = 0.01\nfrequency_hz = 70.0",
    "cone_torch": EGG + "[torch]\ntip_mm = [0.0, 0.0, 5.0]",
    "mesh": 'shape = "surface"\nfile = "mesh.ply"',
    "outline": 'shape = "surface"\nfile = "outline.npy"\nspacing_mm = 0.25\noutline_mm = {outline}',
}
"""[pool] sections of the kinds without an example."""


@dataclass(frozen=True)
class Verdict:
    """Results for frames of known pools.

    Parameters
    ----------
    statuses
        Number of frames by status.
    wrong
        Each wrong label: the frame and the ray.
    labelled, shown
        Dots with their true ray, and all shown dots, of the frames measured.
    height
        Relative error of each frame's height (depth of a concave pool).
    """

    statuses: Counter[str]
    wrong: list[str]
    labelled: int
    shown: int
    height: list[float]

    @property
    def line(self) -> str:
        frames, answered = sum(self.statuses.values()), self.statuses["ok"]
        others = ", ".join(f"{n} {name}" for name, n in self.statuses.items() if name != "ok")
        off = 100 * np.abs(self.height or [np.nan])
        return (
            f"{frames:6} {answered:8} {len(self.wrong):5} {self.labelled / max(self.shown, 1):8.3f}"
            f" {np.median(off):11.2f} {off.max():6.2f}  {others}"
        )


HEADER = "frames answered wrong labelled height %: median  worst  not answered"


def rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table."""
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def judge(simulated: Path, results: Path) -> Verdict:
    """Compare the tables written by `reconstruct` with those of `simulate`."""
    truth, dots = rows(simulated / "dots_truth.csv"), rows(results / "dots.csv")
    verdict = Verdict(Counter(), [], 0, 0, [])
    height, labelled, shown_dots = [], 0, 0
    for size, measured in zip(
        rows(simulated / "truth.csv"), rows(results / "measures.csv"), strict=True
    ):
        number = size["frame"]
        verdict.statuses[measured["status"]] += 1
        shown = [row for row in truth if row["frame"] == number and row["visible"] == "1"]
        true_px = np.array([[float(row["u_px"]), float(row["v_px"])] for row in shown])
        rays = [(row["ray_row"], row["ray_column"]) for row in shown]
        for dot in dots:
            if dot["frame"] != number or not dot["ray_row"]:
                continue
            distance = np.hypot(*(true_px - [float(dot["u_px"]), float(dot["v_px"])]).T)
            nearest, ray = int(distance.argmin()), (dot["ray_row"], dot["ray_column"])
            if rays[nearest] == ray and distance[nearest] <= TRUE_PX:
                labelled += 1
            else:
                verdict.wrong.append(f"frame {number}: ray ({ray[0]}, {ray[1]})")
        if measured["status"] == "ok":
            shown_dots += len(shown)
            high, deep = float(size["height_mm"]), float(size["depth_mm"])
            name, true = ("height_mm", high) if high >= -deep else ("depth_mm", deep)
            height.append(float(measured[name]) / true - 1)
    return Verdict(verdict.statuses, verdict.wrong, labelled, shown_dots, height)


def scenarios(folder: Path) -> dict[str, Path]:
    """Return the scenario of every kind; those without an example are written to ``folder``."""
    paths = {path.stem: path for path in sorted(EXAMPLES.glob("*.toml"))}
    bench = "\n[laser]" + paths["egg"].read_text("utf-8").partition("[laser]")[2]
    outline = write_surfaces(folder)
    for number, (kind, pool) in enumerate(OTHERS.items()):
        path = folder / f"{kind}.toml"
        text = bench.replace("seed = 5003", f"seed = {5200 + number}")
        path.write_text(f"[pool]\n{pool.replace('{outline}', str(outline))}\n{text}", "utf-8")
        paths[kind] = path
    return paths


def quickened(scenario: Path, folder: Path) -> Path:
    """Copy a scenario with its files to a folder, at 200 frames/s."""
    text, path = scenario.read_text("utf-8"), folder / f"{scenario.stem}-quick.toml"
    shutil.copy(EXAMPLES / "height_map.csv", folder)
    path.write_text(re.sub(r"frame_rate_hz = [\d.]+", "frame_rate_hz = 200.0", text), "utf-8")
    return path


def write_surfaces(folder: Path) -> list[list[float]]:
    """Write the mesh and the height map; return the outline of the map."""
    pool = egg(6.6, 3.0, 4.2, 0.29, (0.0, -0.6))
    rim, rings = pool.boundary_mm(72)[:, :2], np.linspace(0.04, 1 - 1e-9, 25)
    xy = np.array([0.0, -0.6]) + rings[:, None, None] * (rim - [0.0, -0.6])
    z = np.maximum(pool.height(xy[..., 0], xy[..., 1]), 0.0)
    places = np.concatenate([xy.reshape(-1, 2), z.reshape(-1, 1)], axis=1)
    corners = []
    for ring in range(len(rings) - 1):
        for k in range(len(rim)):
            a, b = ring * len(rim) + k, ring * len(rim) + (k + 1) % len(rim)
            corners += [(a, a + len(rim), b), (b, a + len(rim), b + len(rim))]
    corners += [(0, k, k + 1) for k in range(1, len(rim) - 1)]
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {len(places)}\nproperty float x\n"
        f"property float y\nproperty float z\nelement face {len(corners)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    body = [" ".join(f"{value:.7f}" for value in place) for place in places]
    body += [f"3 {a} {b} {c}" for a, b, c in corners]
    (folder / "mesh.ply").write_text(head + "\n".join(body) + "\n", "ascii")
    # A paraboloid over a rotated ellipse; its heights continue below the work piece.
    turn = np.radians(25)
    y, x = 0.25 * (np.mgrid[:45, :45] - 22)
    along, across = y * np.cos(turn) + x * np.sin(turn), x * np.cos(turn) - y * np.sin(turn)
    np.save(folder / "outline.npy", 0.3 * (1 - (across / 3.2) ** 2 - (along / 3.6) ** 2))
    angle = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    across, along = 3.2 * np.cos(angle), 3.6 * np.sin(angle)
    outline = [across * np.cos(turn) + along * np.sin(turn),
               along * np.cos(turn) - across * np.sin(turn)]  # fmt: skip
    return np.round(np.transpose(outline), 5).tolist()


def run(*arguments: object) -> None:
    """Run the command; exit code 1 means that no frame was measured."""
    command = [sys.executable, "-m", "labapp", *map(str, arguments)]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    if process.returncode not in (0, 1):
        raise SystemExit(process.stderr)


def main() -> int:
    """Print the results; return the number of wrong labels."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="*", metavar="KIND")
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--seed", type=int)
    parser.add_argument("--warm", action="store_true")
    chosen = parser.parse_args()
    wrong = 0
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        paths = scenarios(folder)
        print(f"{'':18} {HEADER}")
        for kind in chosen.kinds or paths:
            out, results = folder / kind, folder / f"{kind}_results"
            seed = () if chosen.seed is None else ("--seed", chosen.seed)
            if chosen.warm:
                paths[kind] = quickened(paths[kind], folder)
            run("simulate", paths[kind], "--out", out, "--frames", chosen.frames, *seed)
            run(
                *("reconstruct", out / "recording.avi", "--setup", out / "setup.toml"),
                *("--out", results, "--surfaces", "none", *["--warm"] * chosen.warm),
            )
            verdict = judge(out, results)
            print(f"{kind:18} {verdict.line}", flush=True)
            print("".join(f"  WRONG {one}\n" for one in verdict.wrong), end="")
            wrong += len(verdict.wrong)
    return wrong


if __name__ == "__main__":
    sys.exit(min(main(), 1))
