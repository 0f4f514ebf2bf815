"""A measurement as the rows and surface files that leave the program; mm, px, degrees, s."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence

import numpy as np

from labapp.core.coordinates import ImageCalibration
from labapp.core.measures import Measures, surface_grid, surface_mesh
from labapp.core.pipeline import Measurement
from labapp.core.reconstruction import Reconstruction

SIZES = (
    "are_mm mre_mm width_mm length_mm height_mm depth_mm area_mm2 volume_mm3 "
    "center_x_mm center_y_mm peak_x_mm peak_y_mm"
).split()
MORE_SIZES = (
    "width_sigma_mm length_sigma_mm height_sigma_mm depth_sigma_mm area_sigma_mm2 "
    "volume_sigma_mm3 are_inner_mm mre_inner_mm"
).split()
TABLES = {
    "dots.csv": (
        "frame u_px v_px plane_x_mm plane_z_mm reflected_row reflected_column "
        "ray_row ray_column blocked source"
    ).split(),
    "points.csv": "frame ray_row ray_column x_mm y_mm z_mm residual_mm sigma_mm".split(),
    "boundary.csv": "frame theta_deg x_mm y_mm z_mm".split(),
    "measures.csv": [
        *"frame time_s status scheme correspondence dots rows".split(),
        *SIZES,
        *MORE_SIZES,
        "reason",
    ],
}
"""The tables and their columns, in the order in which a frame is written to them."""

PX_DIGITS, MM_DIGITS = 4, 6

STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("attribute", "<u2")])


def measures_row(frame: int, time_s: float | None, measurement: Measurement) -> str:
    """The frame's row of `measures.csv`; every frame has one."""
    lattice, match = measurement.lattice, measurement.match
    rows = None if lattice is None else len(np.unique(lattice.row[lattice.row > 0]))
    return as_csv(
        [
            [
                frame,
                number(time_s),
                measurement.status,
                measurement.scheme,
                "" if match is None else match.orientation,
                0 if measurement.dots is None else len(measurement.dots),
                "" if rows is None else rows,
                *(_size(measurement.measures, name) for name in [*SIZES, *MORE_SIZES]),
                measurement.reason,
            ]
        ]
    )


def _size(measures: Measures | None, name: str) -> str:
    return "" if measures is None else number(getattr(measures, name))


def dots_rows(frame: int, measurement: Measurement, calibration: ImageCalibration) -> str:
    """The frame's rows of `dots.csv`: every dot found, cells empty for what it has not."""
    dots, lattice, match = measurement.dots, measurement.lattice, measurement.match
    if dots is None or not len(dots):
        return ""
    rays = {} if match is None else dict(zip(match.dot.tolist(), match.ray.tolist(), strict=True))
    plane = calibration.to_plane(dots.image_px)
    rows = []
    for k, ((u, v), (x, z)) in enumerate(zip(dots.image_px, plane, strict=True)):
        row, column = (0, 0) if lattice is None else (lattice.row[k], lattice.column[k])
        blocked = "" if lattice is None or not row else int(row in lattice.blocked_rows)
        rows.append(
            [
                frame,
                number(u, PX_DIGITS),
                number(v, PX_DIGITS),
                number(x),
                number(z),
                row or "",
                column or "",
                *rays.get(k, ("", "")),
                blocked,
                "auto",
            ]
        )
    return as_csv(rows)


def points_rows(frame: int, reconstruction: Reconstruction | None) -> str:
    """The frame's rows of `points.csv`: reflection points and how far their dots are off."""
    if reconstruction is None:
        return ""
    return as_csv(
        [frame, i, j, *map(number, point), number(residual), number(sigma)]
        for (i, j), point, residual, sigma in zip(
            reconstruction.ray,
            reconstruction.points_mm,
            np.linalg.norm(reconstruction.residual_mm, axis=-1),
            reconstruction.sigma_mm,
            strict=True,
        )
    )


def boundary_rows(frame: int, reconstruction: Reconstruction | None) -> str:
    """The frame's rows of `boundary.csv`."""
    if reconstruction is None:
        return ""
    boundary = reconstruction.boundary
    return as_csv(
        [frame, number(theta, PX_DIGITS), *map(number, point)]
        for theta, point in zip(boundary.theta_deg, boundary.points_mm, strict=True)
    )


def surface_csv(reconstruction: Reconstruction, spacing_mm: float) -> bytes:
    """Nodes of the surface within the boundary, as `x_mm,y_mm,z_mm`."""
    nodes = np.column_stack(surface_grid(reconstruction, spacing_mm))
    nodes = nodes[np.isfinite(nodes).all(axis=1)]
    text = io.StringIO()
    np.savetxt(text, nodes, f"%.{MM_DIGITS}f", ",", header="x_mm,y_mm,z_mm", comments="")
    return text.getvalue().encode()


def surface_stl(reconstruction: Reconstruction, spacing_mm: float) -> bytes:
    """The surface within the boundary as a binary STL, mm, normals up."""
    vertices, triangles = surface_mesh(reconstruction, spacing_mm)
    corners = vertices[triangles]
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    whole = area[:, 0] > 0
    mesh = np.zeros(int(whole.sum()), STL_TRIANGLE)
    mesh["normal"] = normal[whole] / area[whole]
    mesh["corner"] = corners[whole]
    title = b"labapp pool surface, mm".ljust(80)
    return b"".join([title, len(mesh).to_bytes(4, "little"), mesh.tobytes()])


def number(value: float | None, digits: int = MM_DIGITS) -> str:
    """A number as a cell; empty where it is unknown."""
    return f"{value:z.{digits}f}" if value is not None and math.isfinite(value) else ""


def as_csv(rows: Iterable[Sequence[object]]) -> str:
    """Rows as CSV text."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
