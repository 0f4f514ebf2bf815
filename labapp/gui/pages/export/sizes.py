"""Estimate of the size of an export, based on exports of the samples."""

from __future__ import annotations

from labapp.export.formats import SURFACE_FORMATS
from labapp.gui.pages.export.presenter import ExportRequest

ROWS = {"measures": 400.0, "dots": 5_500.0, "points": 7_000.0, "boundary": 14_000.0}
"""Bytes per frame in each table."""

EDGE_TRIANGLES = 22_000
"""Triangles along the boundary for any grid; inside there are two per node."""

PIXEL = {"png": 1.5, "jpg": 0.3, "tif": 3.0}
"""Bytes per pixel of a picture of a frame."""

SURFACE_PIXEL, FILM_PIXEL = 0.16, 0.03
"""Bytes per pixel of a picture of a surface, and of a frame of a film."""

TREND_PICTURE, REPORT = 80_000.0, 2_000_000.0


def estimated_bytes(
    request: ExportRequest, frames: int, surfaces: int, area_mm2: float, frame_px: int
) -> float:
    """Approximate number of bytes that will be written.

    The frames have ``frame_px`` pixels each, and the surfaces this area on average.
    """
    nodes = area_mm2 / request.spacing_mm**2
    triangles = 2 * nodes + EDGE_TRIANGLES
    choice = request.choice()
    a_frame = sum(ROWS[name] for name in choice.tables)
    surface_formats = [SURFACE_FORMATS[name] for name in choice.surfaces]
    a_node = sum(each.bytes_each for each in surface_formats if each.of == "nodes")
    a_triangle = sum(each.bytes_each for each in surface_formats if each.of == "mesh")
    a_surface = a_node * nodes + a_triangle * triangles * (1 + choice.solid)
    for each in choice.run_formats:
        a_frame += each.frame_bytes
        a_surface += each.node_bytes * nodes
    view_px = request.size_px[0] * request.size_px[1]
    if "frames" in choice.pictures:
        a_frame += PIXEL[request.picture_format] * frame_px
    a_surface += SURFACE_PIXEL * view_px * ("surfaces" in choice.pictures)
    a_surface += FILM_PIXEL * view_px * ("film" in choice.pictures)
    once = TREND_PICTURE * ("trends" in choice.pictures) + REPORT * ("report" in request.ticked)
    return once + frames * a_frame + surfaces * a_surface
