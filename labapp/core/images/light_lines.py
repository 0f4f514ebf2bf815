"""Reflected lines of a frame: ridges joined through gaps and crossings, smoothed, with their ends.

The pattern's own lines and the diffraction fringes beside them (§3.2.1, Fig. 3-9) are told apart by
`line_order`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from labapp.core.images.dots import Grey, Image
from labapp.core.images.ridges import Ridges, RidgeSettings, find_ridges
from labapp.core.images.smooth_path import SmoothPath
from labapp.core.values import BoolArray, FloatArray, IntArray, ReadOnlyArrays

TANGENT_POINTS = 20
"""The direction in which a chain ends is that of so many of its points."""

END_WIDTHS = 1.5
"""A line's ridge is not followed nearer to its end than so many standard deviations of its smoothed
light: there, it turns aside."""

END_PX, END_REACH_PX = 10.0, 30.0
"""A line's light near its end is the median over so much of it; its end is looked for so far ahead
of where its ridge was followed, px."""

UPRIGHT = 0.35
"""A line is upright that is narrower than this share of its height."""

DIP, LEAST_FOLDED = 0.6, 6
"""An upright chain is cut where it falls below this share of what it is on both sides; parts of
fewer points are left out."""

WHISKER_PX, WHISKER_OFF = 16, 3.0
"""A chain of fewer points that is no farther than so many times the ridges' scale from a stronger
one is part of that one's side."""

GAP_SHARE = 0.4
"""A line has a gap where its ridge falls below this share of its median strength."""

SHORT_PX = 25
"""Chains of fewer points are not joined when one is more above than beside the other."""

ALIKE = 2.5
"""Parts of one line are not brighter one than the other by a larger factor."""

CENTER_ROUNDS = 4
"""Of the window that follows the middle of a line's light."""

PATH_SMOOTHER = 1.8
"""The path that a line's light is averaged along is smoothed over so many times that length."""

GLOW_ROUNDS = 5

GRAIN_COLUMNS = 3.3
"""So many columns of pixels along a line share a grain of speckle."""


@dataclass(frozen=True)
class LineSettings:
    """How lines are found.

    Parameters
    ----------
    ridges
        Of the first pass; in the second, the scale is that of the lines' own width.
    least_scale_px, most_scale_px
        Limits of that scale.
    least_px
        Shortest chain of ridge points and shortest line that count, px.
    gap_px
        Longest gap that is joined, px.
    turn_deg
        Largest turn at either side of a gap, degrees.
    smooth_px, smooth_widths
        Standard deviation of the weights by which a line is smoothed along itself: px, and at least
        so many times its width.
    edge_px
        A line that ends so near to the picture's edge is cut off there, px.
    """

    ridges: RidgeSettings = field(default_factory=RidgeSettings)
    least_scale_px: float = 1.6
    most_scale_px: float = 4.0
    least_px: float = 7.0
    gap_px: float = 14.0
    turn_deg: float = 45.0
    smooth_px: float = 6.0
    smooth_widths: float = 3.0
    edge_px: float = 6.0


@dataclass(frozen=True)
class LightLine(ReadOnlyArrays):
    """A reflected line, from its left end to its right one.

    Parameters
    ----------
    image_px
        (u, v) of its ridge at about every pixel, gaps left out, shape (n, 2), px.
    tangent
        Unit vector along it, shape (n, 2).
    sigma_px
        Standard uncertainty of the ridge across itself, shape (n,), px.
    curvature
        Of the ridge, 1/px, shape (n,); positive where it turns to the right (clockwise as seen).
    ends_px
        (u, v) where its light falls to half, shape (2, 2), px.
    cut
        Whether each end is at the picture's edge rather than the line's own, shape (2,).
    width_px
        Standard deviation of its light across it, px.
    light
        Its light over its length: integral across it, grey levels·px, the median of its points.
    gap_px
        Length of its longest gap, px.
    smoothed_px
        Standard deviation of the weights that it is smoothed by along itself, px.
    """

    image_px: FloatArray
    tangent: FloatArray
    sigma_px: FloatArray
    curvature: FloatArray
    ends_px: FloatArray
    cut: BoolArray
    width_px: float
    light: float
    gap_px: float
    smoothed_px: float

    @property
    def length_px(self) -> float:
        """Length along the ridge, px."""
        return float(np.linalg.norm(np.diff(self.image_px, axis=0), axis=-1).sum())

    @property
    def folded(self) -> bool:
        """Whether both halves lie on each other: the pool gathers the line (a caustic)."""
        return is_upright(self.image_px)


def find_lines(frame: Image, settings: LineSettings) -> tuple[LightLine, ...]:
    """Find all bright lines of a grey frame, shape (height, width), fringes included."""
    ridges = find_ridges(frame, settings.ridges)
    scale = settings.ridges.scale_px
    long = _long_chains(ridges, settings)
    if not len(long):
        return ()
    of_long = np.concatenate([np.arange(*ridges.starts[k : k + 2]) for k in long])
    ratio = ridges.height[of_long] / ridges.strength[of_long]
    width = float(np.sqrt(max(np.median(ratio) - scale**2, 0.0)))
    scale = float(np.clip(width, settings.least_scale_px, settings.most_scale_px))
    ridges = find_ridges(frame, replace(settings.ridges, scale_px=scale))
    chains = [
        part
        for k in _long_chains(ridges, settings)
        for part in _parts(ridges, np.arange(ridges.starts[k], ridges.starts[k + 1]))
    ]
    chains = _without_whiskers(ridges, [_core(ridges, part) for part in chains], scale)
    joined = _join(ridges, chains, settings)
    picture = np.ascontiguousarray(frame, np.float32)
    picture = picture - glow(picture)
    lines = (_line(picture, ridges, one, scale, settings) for one in joined)
    return tuple(one for one in lines if one is not None)


def glow(picture: Grey) -> Grey:
    """Smooth light under a picture's lines: a cubic in u and v that few of its pixels lie below.

    Its slope would draw the middle of a line's light to the brighter side.
    """
    height, width = picture.shape
    size = max(width // 8, 8), max(height // 8, 8)
    small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
    u, v = np.meshgrid(*(np.linspace(-1, 1, count) for count in size))
    terms = np.stack(
        [u.ravel() ** i * v.ravel() ** j for i in range(4) for j in range(4 - i)], axis=-1
    )
    light, weights = small.ravel().astype(float), np.ones(small.size)
    for _ in range(GLOW_ROUNDS):
        fitted = np.linalg.lstsq(terms * weights[:, None], light * weights, rcond=None)[0]
        off = light - terms @ fitted
        limit = 3.0 * 1.4826 * float(np.median(np.abs(off))) + 1e-6
        weights = (off < limit).astype(float)
    smooth = (terms @ fitted).reshape(small.shape).astype(np.float32)
    return np.asarray(cv2.resize(smooth, (width, height), interpolation=cv2.INTER_LINEAR))


def _long_chains(ridges: Ridges, settings: LineSettings) -> IntArray:
    return np.flatnonzero(np.diff(ridges.starts) >= settings.least_px)


def _parts(ridges: Ridges, points: IntArray) -> list[IntArray]:
    """A chain in parts where it is upright and dips: folded lines, one above the other."""
    if not is_upright(ridges.image_px[points]):
        return [points]
    height = ridges.height[points]
    before, after = np.maximum.accumulate(height), np.maximum.accumulate(height[::-1])[::-1]
    dark = height < DIP * np.minimum(before, after)
    edges = np.flatnonzero(np.diff(np.pad(dark, 1).astype(int)))
    cuts = [int(a + np.argmin(height[a:b])) for a, b in edges.reshape(-1, 2).tolist()]
    return [part for part in np.split(points, cuts) if len(part) >= LEAST_FOLDED]


def _without_whiskers(ridges: Ridges, chains: list[IntArray], scale: float) -> list[IntArray]:
    """Chains without the short ones that stand off a stronger one's side."""
    bright = [float(ridges.strength[chain].sum()) for chain in chains]
    kept: list[IntArray] = []
    for k in np.argsort(bright)[::-1]:
        chain = chains[k]
        if kept and len(chain) < WHISKER_PX:
            others = ridges.image_px[np.concatenate(kept)]
            away = np.linalg.norm(ridges.image_px[chain][:, None] - others, axis=-1).min(axis=1)
            if np.median(away) < WHISKER_OFF * scale:
                continue
        kept.append(chain)
    return kept


def _core(ridges: Ridges, points: IntArray) -> IntArray:
    """Points of a chain without its ends, where the ridge is weak and turns aside."""
    strength = ridges.strength[points]
    bright = np.flatnonzero(strength > np.median(strength) / 2)
    points = points[bright[0] : bright[-1] + 1]
    trim = min(round(END_WIDTHS * _spread(ridges, points)), len(points) // 6)
    return points[trim : len(points) - trim]


def is_upright(place: FloatArray) -> bool:
    """Whether a line of places, shape (n, 2), goes up rather than across."""
    across, up = np.ptp(place, axis=0)
    return bool(across < UPRIGHT * up)


def _spread(ridges: Ridges, points: IntArray) -> float:
    """Standard deviation of the smoothed frame's light across ridge points, px."""
    return float(np.sqrt(np.median(ridges.height[points] / ridges.strength[points])))


# --- joining --------------------------------------------------------------------------------------


def _join(ridges: Ridges, chains: list[IntArray], settings: LineSettings) -> list[IntArray]:
    """Join chains end to end, the best pair of ends first; points of each line in order."""
    if not chains:
        return []
    place, out = _chain_ends(ridges, chains)
    step = place[None] - place[:, None]
    length = np.linalg.norm(step, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = np.vecdot(step, out[:, None]) / length
        behind = np.vecdot(-step, out[None]) / length
    least = np.cos(np.radians(settings.turn_deg))
    near = length < 3.0
    fits = ((ahead > least) & (behind > least)) | near & (np.vecdot(out[:, None], out[None]) < 0)
    bright = np.repeat([np.median(ridges.strength[chain]) for chain in chains], 2)
    fits &= np.abs(np.log(bright[:, None] / bright)) < np.log(ALIKE)
    trimmed = np.repeat([END_WIDTHS * _spread(ridges, chain) for chain in chains], 2)
    fits &= length <= settings.gap_px + trimmed[:, None] + trimmed
    # Upright chains one above the other are lines that the pool has folded together (a caustic).
    folded = np.repeat([is_upright(ridges.image_px[chain]) for chain in chains], 2)
    short = np.repeat([len(chain) < SHORT_PX for chain in chains], 2)
    steep = np.abs(step[..., 0]) < np.abs(step[..., 1])
    fits &= ~(folded[:, None] & folded | steep & short[:, None] & short)
    one, other = np.nonzero(np.triu(fits, 1))
    cost = length[one, other] * (3.0 - ahead[one, other] - behind[one, other])
    partner: dict[int, int] = {}
    root = list(range(len(chains)))
    for k in np.argsort(cost):
        a, b = int(one[k]), int(other[k])
        if a in partner or b in partner or root[a // 2] == root[b // 2]:
            continue
        partner[a], partner[b] = b, a
        old, new = root[b // 2], root[a // 2]
        root = [new if each == old else each for each in root]
    return _walk(chains, partner)


def _chain_ends(ridges: Ridges, chains: list[IntArray]) -> tuple[FloatArray, FloatArray]:
    """Places of both ends of each chain and outward unit vectors there, shape (2·chains, 2)."""
    place, out = [], []
    for chain in chains:
        for points in (chain, chain[::-1]):
            at = ridges.image_px[points[:TANGENT_POINTS]]
            place.append(at[0])
            away = at[0] - at[-1]
            # A chain that bends goes on bending: its end's direction is twice as far turned.
            first = at[0] - at[len(at) // 2]
            away = 2 * first / np.linalg.norm(first) - away / np.linalg.norm(away)
            out.append(away / np.linalg.norm(away))
    return np.array(place), np.array(out)


def _walk(chains: list[IntArray], partner: dict[int, int]) -> list[IntArray]:
    """Points of each line in order, from pairs of joined ends; end 2k is chain k's first."""
    lines, done = [], set[int]()
    for start in [end for end in range(2 * len(chains)) if end not in partner]:
        end, parts = start, []
        if end // 2 in done:
            continue
        while True:
            chain = chains[end // 2]
            done.add(end // 2)
            parts.append(chain if end % 2 == 0 else chain[::-1])
            far = end ^ 1
            if far not in partner:
                break
            end = partner[far]
        lines.append(np.concatenate(parts))
    return lines


# --- a line ---------------------------------------------------------------------------------------


def _line(
    picture: Grey, ridges: Ridges, points: IntArray, scale: float, settings: LineSettings
) -> LightLine | None:
    """A line of ridge points in order; None where too little is left of it."""
    strength = ridges.strength[points]
    points = points[strength > GAP_SHARE * np.median(strength)]
    place, strength = ridges.image_px[points], ridges.strength[points]
    spread2 = _spread(ridges, points) ** 2
    least = LEAST_FOLDED / 2 if is_upright(place) else settings.least_px
    if len(points) < least:
        return None
    first, last = place[0], place[-1]
    if first[1] > last[1] if is_upright(place) else first[0] > last[0]:
        points, place = points[::-1], place[::-1]
    width = float(np.sqrt(max(spread2 - scale**2, (0.75 * scale) ** 2)))
    smooth_px = min(max(settings.smooth_widths * width, settings.smooth_px), len(place) / 8)
    # What wavers in the path would stay in the line: it is smoother than the line.
    path = SmoothPath.through(place, PATH_SMOOTHER * smooth_px)
    off, sigma = _centers(picture, path, width, smooth_px)
    # A bent line's light, blurred, has its ridge on the inner side: by σ²κ/2.
    off -= path.curvature * width**2 / 2
    path = path.moved(off, settings.smooth_px)
    light = float(np.median(strength) * spread2**1.5 * np.sqrt(2 * np.pi))
    near, heights = round(END_PX), ridges.height[points]
    ends = [
        _end(ridges.smooth, path, end, float(np.median(height)))
        for end, height in ((0, heights[:near]), (-1, heights[-near:]))
    ]
    size = np.array(picture.shape[::-1])
    places = np.array(ends)
    cut = ((places < settings.edge_px) | (places > size - 1 - settings.edge_px)).any(axis=-1)
    seen = path.seen
    return LightLine(
        image_px=path.place[seen],
        tangent=path.tangent[seen],
        sigma_px=np.full(int(seen.sum()), sigma),
        curvature=path.curvature[seen],
        ends_px=places,
        cut=np.asarray(cut),
        width_px=width,
        light=light,
        gap_px=path.longest_gap,
        smoothed_px=smooth_px,
    )


def _centers(
    picture: Grey, path: SmoothPath, width: float, smooth_px: float
) -> tuple[FloatArray, float]:
    """Offset of the light's middle from a path, across it, shape (n,), px, and its uncertainty.

    The light beside the path is taken as a straight strip, weighed by a Gaussian window that
    follows its middle, and averaged along the path.
    """
    reach = 2.6 * width + 1.0
    side = np.arange(-reach, reach + 0.25, 0.5)
    at = (path.place[:, None] + side[:, None] * path.across[:, None]).astype(np.float32)
    strip = np.asarray(
        cv2.remap(
            picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ),
        float,
    )
    edge = max(2, len(side) // 8)
    low, high = strip[:, :edge].mean(axis=1), strip[:, -edge:].mean(axis=1)
    along = np.arange(len(strip), dtype=float)
    bell = np.exp(-(((along - along[:, None]) / smooth_px) ** 2) / 2) * path.seen
    bell /= bell.sum(axis=1, keepdims=True) + 1e-12
    strip -= (bell @ np.minimum(low, high))[:, None]
    off = np.zeros(len(strip))
    for _ in range(CENTER_ROUNDS):
        away = side - off[:, None]
        window = np.exp(-((away / width) ** 2) / 4)  # its variance is twice that of the light
        weight = (window * strip).sum(axis=1)
        moment = (window * strip * away).sum(axis=1)
        total = np.maximum(bell @ weight, 1e-9 + 0.1 * np.median(np.abs(weight)))
        step = bell @ moment / total
        off = np.clip(off + 1.5 * step, -width, width)  # (2 + 1)/2: the window draws it back
    scatter = 1.5 * (moment - (bell @ moment / total) * weight)
    variance = GRAIN_COLUMNS * (bell**2 @ scatter**2) / total**2
    return off, float(np.sqrt(np.median(variance[path.seen])))


def _end(smooth: Grey, path: SmoothPath, end: int, height: float) -> FloatArray:
    """Where the light ahead of a path's end falls to half, (u, v), px."""
    sign = -1.0 if end == 0 else 1.0
    inward = slice(0, round(END_PX)) if end == 0 else slice(-round(END_PX), None)
    curvature = float(np.median(path.curvature[inward]))
    place, tangent, across = path.place[end], sign * path.tangent[end], sign * path.across[end]
    step = np.arange(0.0, END_REACH_PX, 0.5)
    bend = sign * curvature * sign * step**2 / 2
    ahead = place + step[:, None] * tangent + bend[:, None] * across
    inside = path.place[inward]
    at = np.concatenate([inside, ahead]).astype(np.float32)[None]
    light = cv2.remap(smooth, at[..., 0], at[..., 1], cv2.INTER_LINEAR)[0]
    level = float(np.median(light[: len(inside)])) - height / 2
    below = light[len(inside) :] < level
    if not below.any() or below[0]:
        return np.asarray(ahead[0 if below.any() else -1])
    k = int(np.argmax(below))
    before, after = light[len(inside) + k - 1 : len(inside) + k + 1]
    share = float((before - level) / (before - after))
    return np.asarray(ahead[k - 1] + share * (ahead[k] - ahead[k - 1]))
