"""The band-passed picture of a frame, and its peaks that may be dots.

Wide Gaussian blurs are computed on a downsampled picture, and quantities that are needed at few
pixels are computed only there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np

from labapp.core.images.dot_size import SLENDER
from labapp.core.images.dots import Grey, Picture
from labapp.core.images.filters import (
    NARROW,
    WIDE,
    blur,
    kernel,
    pairs,
    peak_disc,
    saturated_light,
    scratch,
    smaller_blurred,
    widen,
    without_spikes,
)
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays

Peaks = tuple[IntArray, IntArray, FloatArray]
"""Columns and rows of pixels, and the value of the band-passed picture there."""

HOT_RATIO = 1.6
"""Lowest ratio of a hot-pixel cluster's response to a band at a third of the dot size and its
response to the band at the dot size."""

REMAINS_SHARE = 0.5
"""A peak near repaired pixels is a dot if it has at least this fraction of the typical dot's
brightness; residues of hot pixels are fainter."""

WIDEST_WINDOW = 1.1
"""Largest width of a window for centroids, over the reach of its centre."""

LIGHT_BLUR = 0.5
"""Blur of the light before centroids are computed, in dot sizes."""

MOST_SURROUNDINGS = 0.3
"""If the dots' windows cover a larger share of the picture, all of it is blurred at once."""

HALVED_PX, NEARLY = 1.5, 0.75
"""Dots of at least this size are searched for at half resolution, where a peak above the threshold
has a pixel above this fraction of it."""

PROMINENT, PROMINENT_SHARE = 0.5, 0.2
"""A peak stands out from a ridge, such as the edge of a saturated spot, if its prominence exceeds
these shares of the threshold or of its response: that of noise on the ridge is less than both."""

SATURATED_SHARE, SATURATED_REACH = 0.4, 3.0
"""A peak is in saturated light if so large a share of the pixels within the second, in dot sizes
along either axis, are."""

PEAK_GAIN = 1 / (1 + NARROW**2) - 1 / (1 + WIDE**2)
"""Peak height of a Gaussian dot of the band's size after the band-pass, over its height before."""

AROUND_SIZES = 4.2
"""Standard deviation of the blur that gives the background of the dots, in dot sizes."""

# Light in the wider blur of the band over that in the blur of the background, as a share of the
# band's response: at the peak of a dot of twice the band's size, and of a much broader spot.
DOT_SHARE = (1 / (1 + (WIDE / 2) ** 2) - 1 / (1 + (AROUND_SIZES / 2) ** 2)) / (
    1 / (1 + (NARROW / 2) ** 2) - 1 / (1 + (WIDE / 2) ** 2)
)
BROAD_SHARE = (AROUND_SIZES**2 - WIDE**2) / (WIDE**2 - NARROW**2)

AROUND_PX2 = 3.0
"""Least variance of that blur in the joint fit, px² of the downsampled picture, so that its samples
resolve it."""


@dataclass(frozen=True)
class DetectorTuning(ReadOnlyArrays):
    """Dot size and noise estimated from a frame, for use with the following frames.

    Valid as long as illumination and camera settings do not change.

    Parameters
    ----------
    size_px
        Standard deviation of a dot's light, px.
    noise
        Local standard deviation of the camera's noise, grey levels, shape (height, width).
    over_noise, least
        Threshold for peaks of the band, as a multiple of the noise; its minimum, grey levels.
    """

    size_px: float
    noise: Grey
    over_noise: float
    least: float

    def floor(self, noise: Grey) -> Grey:
        """Threshold for peaks where the noise has given values, of any shape."""
        return np.asarray(np.maximum(np.float32(self.over_noise) * noise, np.float32(self.least)))

    @cached_property
    def coarse(self) -> Grey:
        """Threshold for pixels of the half-resolution band that may contain a peak."""
        return np.float32(NEARLY) * self.floor(self.noise[::2, ::2])


def typical(brightness: FloatArray) -> float:
    """Return the light-weighted median brightness, which is insensitive to many faint specks."""
    order = np.sort(brightness)
    light = np.cumsum(order)
    return float(order[np.searchsorted(light, 0.5 * light[-1])])


class BandPassed:
    """A picture and its band-pass at the dot size, in this thread's scratch memory.

    The band is at half resolution if the dots are large enough; ``step`` is the factor.
    """

    def __init__(self, picture: Picture, size: float) -> None:
        (height, width), self.picture, self.size = picture.shape, picture, size
        self.step = 2 if size >= HALVED_PX and height % 2 == width % 2 == 0 else 1
        shape = height // self.step, width // self.step
        self._narrow, self._wide, self.band = (scratch(f"{k} band", shape) for k in range(3))
        self._pass()

    def _pass(self) -> None:
        from labapp.core.images import band_pass_kernels

        size, lost = self.size / self.step, (1 - self.step**-2) / 12
        seen = band_pass_kernels.halved(self.picture) if self.step == 2 else self.picture
        blur(seen, float(np.sqrt((NARROW * size) ** 2 - lost)), self._narrow)
        widen(self._narrow, self._wide, (WIDE**2 - NARROW**2) * size**2)
        cv2.subtract(self._narrow, self._wide, dst=self.band)
        variance = (AROUND_SIZES**2 - NARROW**2) * size**2
        self._background = smaller_blurred(self._narrow, variance)

    def peaks(self, tuning: DetectorTuning, are_crowded: bool = False) -> Peaks:
        """Return the peaks above the threshold that may be dots.

        Of crowded dots peaks on a ridge or in saturated light are included, too: such dots overlap.

        Peaks as sharp as hot pixels or as elongated as lines of them are suspect. Their pixels
        are repaired, since a dot of usual brightness may lie beneath them.
        """
        from labapp.core.images import band_pass_kernels

        u, v, bright = self._over(tuning, are_crowded)
        good = self._dot_like(u, v, bright)
        if good.all():
            return u, v, bright
        suspects = u[~good], v[~good]
        repaired = without_spikes(self.picture, tuning.noise, self.size, suspects)
        if repaired is not self.picture:
            typical_brightness = typical(bright[good]) if good.any() else 0.0
            self.picture = repaired
            self._pass()
            u, v, bright = self._over(tuning, are_crowded)
            near = band_pass_kernels.two_nearest(pairs(u, v), pairs(*suspects))[0][:, 0]
            good = self._dot_like(u, v, bright)
            good &= (near > 2.0 * self.size) | (bright >= REMAINS_SHARE * typical_brightness)
        return u[good], v[good], bright[good]

    def _over(self, tuning: DetectorTuning, are_crowded: bool) -> Peaks:
        """Return the peaks above the threshold, but for those of a broad spot or of a ridge.

        Noise makes peaks on these. Nor are peaks in saturated light returned.
        """
        from labapp.core.images import band_pass_kernels, prominence_kernels

        band, disc, step = self.band, peak_disc(self.size), self.step
        low = tuning.floor(tuning.noise) if step == 1 else tuning.coarse
        if step == 1:
            u, v = band_pass_kernels.peaks(band, low, disc)
            bright = band[v, u].astype(float)
        else:
            (u, v), bright = band_pass_kernels.upsampled_peaks(band, low, disc)
        floor = tuning.floor(tuning.noise[v, u])
        over = (bright > floor) & (self._without_broad(u, v, bright) > floor)
        if not are_crowded:
            prominence = prominence_kernels.prominences(band, low, u // step, v // step)
            over &= prominence > np.minimum(PROMINENT * floor, PROMINENT_SHARE * bright)
            over &= ~self._is_saturated(u, v)
        return u[over], v[over], bright[over]

    def _is_saturated(self, u: IntArray, v: IntArray) -> BoolArray:
        """Whether peaks are in saturated light, where dots are not seen."""
        if (saturated := saturated_light(self.picture, self.size)) is None:
            return np.zeros(len(u), bool)
        side = 2 * round(SATURATED_REACH * self.size) + 1
        share = cv2.blur(saturated.astype(np.float32), (side, side))
        return np.asarray(share[v, u] > SATURATED_SHARE)

    def _without_broad(self, u: IntArray, v: IntArray, bright: FloatArray) -> FloatArray:
        """Responses of peaks without that of a broader spot that they are on, such as the arc's.

        On its top noise makes peaks, and the spot itself responds.
        """
        around, (height, width) = self._background, self.picture.shape
        far = around[v * around.shape[0] // height, u * around.shape[1] // width]
        beyond = self._wide[v // self.step, u // self.step] - far
        return np.asarray((BROAD_SHARE * bright - beyond) / (BROAD_SHARE - DOT_SHARE))

    def _dot_like(self, u: IntArray, v: IntArray, bright: FloatArray) -> BoolArray:
        """Whether peaks are round and do not respond more strongly to a much finer band."""
        from labapp.core.images import band_pass_kernels, centroid_kernels

        scale = max(0.4, self.size / 3.0)
        narrow, wide = (_shifted_gaussians(sigma * scale, WIDE * scale) for sigma in (NARROW, WIDE))
        fine = centroid_kernels.largest_fine_response(self.picture, u, v, narrow, wide)
        sharp = fine >= HOT_RATIO * bright
        ridges = band_pass_kernels.ridges(self.band, u // self.step, v // self.step, SLENDER)
        return np.asarray(~sharp & ~ridges)

    def light(
        self, u: IntArray, v: IntArray, width: FloatArray, reach: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return centroids and second moments of the background-subtracted light.

        Centroids (u, v) have shape (2, n), px; moments, the sum of the second central moments along
        u and v, shape (n,), px².

        Windows are moved a few times only; otherwise they would drift to a brighter neighbour.
        """
        from labapp.core.images import centroid_kernels

        margin, taps, picture = margin_of(reach), kernel(LIGHT_BLUR * self.size), self.picture
        if len(u) * (2 * margin + 1) ** 2 > MOST_SURROUNDINGS * picture.size:
            into = scratch("picture", picture.shape)
            picture, taps = blur(picture, LIGHT_BLUR * self.size, into), kernel(0.0)
        (x, y), moment = centroid_kernels.centroids(
            picture, self._background, taps, u, v, margin, width, reach
        )
        return np.array([u + x, v + y]), moment

    def around(self) -> tuple[Grey, float]:
        """Return the downsampled, blurred picture and the blur's standard deviation, px."""
        image, (height, width), scale = self._narrow, self._narrow.shape, 1
        variance = (AROUND_SIZES**2 - NARROW**2) * (self.size / self.step) ** 2
        while (
            variance / (2 * scale) ** 2 > AROUND_PX2
            and height % (2 * scale) == width % (2 * scale) == 0
        ):
            scale *= 2
        shape = height // scale, width // scale
        if scale > 1:
            into = scratch(f"around {scale}", shape)
            image = np.asarray(
                cv2.resize(image, shape[::-1], into, 0, 0, cv2.INTER_AREA), np.float32
            )
        left = variance / scale**2 - (1 - scale**-2) / 12
        blurred = blur(image, float(np.sqrt(left)), scratch(f"around {scale} blurred", shape))
        return blurred, AROUND_SIZES * self.size


@lru_cache(maxsize=8)
def _shifted_gaussians(sigma: float, widest: float) -> Grey:
    """Gaussian weights centred on a pixel and its two neighbours, shape (3, side).

    They are padded to the length of the widest kernel and by a pixel on either side.
    """
    weights, side = kernel(sigma), len(kernel(widest))
    shifted, before = np.zeros((3, side + 2), np.float32), (side - len(weights)) // 2
    for k in range(3):
        shifted[k, before + k : before + k + len(weights)] = weights
    shifted.flags.writeable = False
    return shifted


def margin_of(reach: float) -> int:
    """Half side of the square about a peak in which light is integrated, px.

    It is twice the width of the widest window.
    """
    return int(np.ceil(2 * WIDEST_WINDOW * reach)) + 1
