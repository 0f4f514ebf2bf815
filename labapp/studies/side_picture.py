"""The bench from the side, black on white: its central rays by their fate, pool, plane, torch."""

from __future__ import annotations

from typing import Any

from labapp.simulation.positioning import Fate, SideView

FATES = {
    Fate.CAUGHT: "#1b7a3d",
    Fate.PAST: "#c05a00",
    Fate.BLOCKED: "#b01030",
    Fate.UNUSED: "0.8",
}


def draw_side(plot: Any, view: SideView, roof_mm: float = 40.0) -> None:
    """Draw the bench to scale into a plot of Y and Z; the first ray of each fate has a label.

    The torch reaches up to a height of `roof_mm`; its width is not to scale.
    """
    labelled: set[Fate] = set()
    for ray in view.rays:
        label = None if ray.fate in labelled else ray.fate.value
        labelled.add(ray.fate)
        plot.plot(*ray.path_mm.T, color=FATES[ray.fate], lw=0.6, label=label)
    plot.axhline(0, color="0.3", lw=0.6)
    plot.plot(*view.pool_mm.T, color="#c05a00", lw=1.6)
    plot.plot(*view.plane_mm.T, "k", lw=1.8)
    plot.plot(*view.laser_mm, "ks", ms=4)
    tip = view.tip_mm[1]
    torch = [(0, tip), (1.2, tip + 4), (1.2, roof_mm), (-1.2, roof_mm), (-1.2, tip + 4)]
    plot.fill(*zip(*torch, strict=True), "0.7", ec="0.3", lw=0.5)
    plot.set(aspect="equal", ylabel="Z (mm)")
