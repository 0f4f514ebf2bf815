"""Camera lens and image calibration, with uncertainties, from pictures of a calibration board.

The board of the first picture stands in the imaging plane. One such picture is enough; further
ones, of the same board in any pose before the camera, determine the lens's distortion better and
nearer to the picture's corners (`lens_fit`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from labapp.core.calibration.boards import Board, BoardCorners, find_board
from labapp.core.calibration.lens_fit import LensFit, covered, fit_lens, fit_terms
from labapp.core.calibration.seen_axes import POINTS, SeenAxes
from labapp.core.calibration.target_marks import ColourOrGrey
from labapp.core.geometry.coordinates import ImageCalibration
from labapp.core.values import CannotMeasure, FloatArray

STRAY, LEAST_STRAY_PX = 6.0, 0.3
"""A corner is rejected if its residual exceeds both this multiple of the median and this length."""

MOST_STRAY = 0.15
"""If more than this share of the corners would be rejected, the board is not the assumed one."""

LARGEST_RMS = 1.0 / 640.0
"""Largest root-mean-square residual of a flat board, as a share of the picture's longer side."""

MOST_PICTURES = 100

FEW_COVERED = 0.5
"""If the corners span a smaller share of the picture, the distortion outside is uncertain."""


@dataclass(frozen=True)
class BoardCalibration(SeenAxes):
    """Detected board corners in each picture, and the calibration derived from them.

    Parameters
    ----------
    size_px
        Width and height of the pictures.
    seen
        The corners in each picture; in the first picture the board is in the imaging plane.
    left_out
        Number of corners rejected as outliers.
    """

    size_px: tuple[int, int]
    seen: tuple[BoardCorners, ...]
    left_out: int = 0

    @property
    def board(self) -> Board:
        """The board."""
        return self.seen[0].board

    @property
    def x_axis_mm(self) -> float:  # type: ignore[override]
        """X′ of the last corner on O′X′."""
        return (self.board.columns - 2) * self.board.square_mm

    @property
    def z_axis_mm(self) -> float:  # type: ignore[override]
        """Z′ of the last corner on O′Z′."""
        return (self.board.rows - 2) * self.board.square_mm

    @cached_property
    def fit(self) -> LensFit:
        """Lens and homographies."""
        return fit_lens(self.seen, self.size_px)

    @cached_property
    def distortion_percent(self) -> tuple[float, float]:
        """Distortion in the picture's corner, %, and its standard uncertainty.

        If no distortion is detected: 0 and an upper estimate of its size.
        """
        if "k1" in self.fit.terms:
            return self.fit.distortion_percent()
        terms = (*self.fit.terms, "k1")
        value, sigma = fit_terms(self.seen, self.size_px, terms).distortion_percent()
        return 0.0, max(abs(value), sigma)

    @property
    def image_calibration(self) -> ImageCalibration:
        """The image calibration used for measurements."""
        return self.fit.calibration()

    @property
    def points_px(self) -> FloatArray:
        """(u, v) of O′ and of the last corners on O′X′ and O′Z′, shape (3, 2)."""
        return self.image_calibration.to_image(self._points_mm)

    @property
    def points_covariance_px2(self) -> FloatArray:
        """Covariance of these points, shape (6, 6), px²."""
        return self.fit.covariance_px2(self._points_mm)

    @property
    def affine_covariance_px2(self) -> FloatArray:
        """Covariance of these points under an affine change of the picture, shape (6, 6), px²."""
        corners = self.board.corners_mm
        return self._affine_covariance_px2(corners, self.fit.covariance_px2(corners))

    @property
    def residual_px(self) -> FloatArray:
        """Computed minus measured position of each corner of the first picture, (n, 2), px."""
        return self.fit.residuals_px[: len(self.seen[0].index)]

    @property
    def covered(self) -> float:
        """Share of the picture spanned by the corners of all pictures together."""
        return covered(self.seen, self.size_px)

    @cached_property
    def corner_sigma_mm(self) -> float:
        """Largest standard uncertainty of a position on the plane at the picture's corners, mm."""
        width, height = self.size_px
        corners = np.array([[u, v] for u in (0, width - 1) for v in (0, height - 1)], float)
        plane = self.image_calibration.to_plane(corners)
        variance = np.diag(self.fit.covariance_px2(plane)).reshape(-1, 2).mean(axis=1)
        scale = np.sqrt(np.abs(np.linalg.det(self.image_calibration.jacobian(corners))))
        return float((np.sqrt(variance) * scale).max())

    @property
    def setup_keys(self) -> dict[str, dict[str, object]]:
        """Calibration as setup-file keys by section; None for a key that must be removed."""
        calibration, lens = self.image_calibration, self.fit.lens
        image: dict[str, object] = {
            **dict.fromkeys((*POINTS, "x_axis_mm", "z_axis_mm")),
            "homography": calibration.matrix.tolist(),
            "points_mm": [self.x_axis_mm, self.z_axis_mm],
            **self.setup_uncertainty,
        }
        camera: dict[str, object] = dict.fromkeys(("focal_px", "center_px", "distortion"))
        if lens is not None:
            camera = {name: list(getattr(lens, name)) for name in camera}
        camera["distortion_percent_sigma"] = self.distortion_percent[1]
        return {"image_calibration": image, "camera_lens": camera}

    def with_square(self, square_mm: float) -> BoardCalibration:
        """Return the calibration for the same pictures with another square size."""
        board = self.board.with_square(square_mm)
        seen = (replace(one, board=board) for one in self.seen)
        return BoardCalibration(self.size_px, tuple(seen), self.left_out)

    def undetermined(self) -> tuple[str, ...]:
        """Return descriptions of the quantities that the pictures do not determine."""
        words = ["the focal length, which no result depends on"]
        names = {"k1": "radial distortion", "p1": "tangential distortion", "k2": "its higher power"}
        words += [
            f"{names[term]} (noise alone gains as much in {chance:.0%} of pictures)"
            for term, chance in self.fit.chances.items()
            if term in names
        ]
        if self.covered < FEW_COVERED:
            words.append(
                f"distortion outside the {self.covered:.0%} of the picture that the corners span: "
                "use a larger board, or add pictures of it near the picture's corners"
            )
        return tuple(words)

    def fit_lines(self) -> list[str]:
        """Return text lines on the lens, the residuals and undetermined quantities."""
        found = len(self.seen[0].index), len(self.board.corners_mm)
        value, sigma = self.distortion_percent
        lens = f"{value:+.3f} ± {sigma:.3f} % in the picture's corner"
        if self.fit.lens is None:
            lens = f"none is seen: it is below ± {sigma:.3f} % in the picture's corner"
        left_out = f", {self.left_out} left out" if self.left_out else ""
        pictures = f" of {len(self.seen)} pictures" if len(self.seen) > 1 else ""
        worst = float(np.hypot(*self.fit.residuals_px.T).max())
        return [
            f"{'board':<10} {self.board}",
            f"{'corners':<10} {found[0]} of {found[1]} in the first picture{left_out}",
            f"{'distortion':<10} {lens}",
            f"{'residual':<10} {self.fit.rms_px:.3f} px{pictures}; worst {worst:.2f} px",
            f"{'error':<10} ± {self.corner_sigma_mm:.3f} mm on the plane in the picture's corners",
            f"{'open':<10} {'; '.join(self.undetermined())}",
        ]


def calibrate_board(images: Sequence[ColourOrGrey], board: Board | None = None) -> BoardCalibration:
    """Calibrate the camera from pictures of a board.

    Parameters
    ----------
    images
        Pictures, shape (rows, columns[, channels]) each; in the first, the board is in the imaging
        plane.
    board
        The board; None: the one of `boards.BOARDS` that the first picture shows.

    Raises
    ------
    ValueError
        If there are no pictures, more than `MOST_PICTURES`, or an image is not a valid picture.
    CannotMeasure
        ``no-board`` if the board is not found in one of them or the sizes differ, ``wrong-board``
        if another board is found or the corners do not fit a flat board.
    """
    if not 1 <= len(images) <= MOST_PICTURES:
        raise ValueError(f"a camera is calibrated by 1 to {MOST_PICTURES} pictures")
    sizes = {np.asarray(image).shape[1::-1] for image in images}
    if len(sizes) > 1:
        shown = ", ".join(f"{width} × {height} px" for width, height in sorted(sizes))
        raise CannotMeasure("no-board", f"The pictures are of different sizes: {shown}.")
    seen: list[BoardCorners] = []
    for number, image in enumerate(images, 1):
        try:
            seen.append(find_board(image, seen[0].board if seen else board))
        except CannotMeasure as why:
            if len(images) == 1:
                raise
            reason = f"Picture {number} of {len(images)}: {why.reason}"
            raise CannotMeasure(why.status, reason) from None
    width, height = sizes.pop()
    return _without_strays(BoardCalibration((width, height), tuple(seen)))


def _without_strays(found: BoardCalibration) -> BoardCalibration:
    """Reject outlying corners until none is left."""
    total = sum(len(one.index) for one in found.seen)
    while True:
        off = np.hypot(*found.fit.residuals_px.T)
        stray = off > max(STRAY * float(np.median(off)), LEAST_STRAY_PX)
        left_out = found.left_out + int(stray.sum())
        limit = LARGEST_RMS * max(found.size_px)
        if left_out > MOST_STRAY * total or (not stray.any() and found.fit.rms_px > limit):
            rms = f"{found.fit.rms_px:.1f} px"
            raise CannotMeasure(
                "wrong-board",
                f"The corners are {rms} from where {found.board.name} has them: the board is not "
                "flat, the picture is smeared, or it is another board.",
            )
        if not stray.any():
            return found
        ends = np.cumsum([len(one.index) for one in found.seen])[:-1]
        kept = (
            one.keep(~which) for one, which in zip(found.seen, np.split(stray, ends), strict=True)
        )
        found = BoardCalibration(found.size_px, tuple(kept), left_out)
