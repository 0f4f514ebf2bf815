"""Joining of chains of ridge points to lines, across gaps and crossings."""

from __future__ import annotations

import numpy as np

from labapp.core.lines.detection.ridges import Ridges
from labapp.core.values import BoolArray, FloatArray, IntArray

TANGENT_POINTS = 20
"""Number of points that determine the direction at a chain's end."""

END_WIDTHS = 1.5
"""A ridge is not used within this many standard deviations of its smoothed light from its end,
where it turns aside."""

UPRIGHT = 0.35
"""A line is upright if its width is less than this share of its height."""

DIP, LEAST_FOLDED = 0.6, 6
"""An upright chain is cut where its strength falls below this share of that on both sides; parts of
fewer points are left out."""

WHISKER_PX, WHISKER_OFF = 16, 3.0
"""A chain of fewer points within this many times the ridges' scale of a stronger chain belongs to
the flank of that chain."""

SHORT_PX = 25
"""Chains of fewer points are not joined if one lies above rather than beside the other."""

ALIKE = 2.5
"""Largest ratio of brightness between parts of one line."""

LONGEST_GAP_PX, MOST_TURN_DEG = 14.0, 45.0
"""Longest gap that is joined, px, and largest turn at either side of it, degrees."""

GAP_SHARE = 0.1
"""A gap may be longer by this share of the joined chains' lengths, as the pool spreads them."""

WITHIN, INSET_PX = 0.25, 2.0
"""An upright or short chain below another is not part of it if its middle is inside the other by
more than this share of its extent, or all of it by this many pixels: it is then a folded line below
an arch, not a leg of the arch."""

BRIEF = 0.3
"""Cosine of the largest turn at a short chain's end where it continues a longer one."""


def join_chains(ridges: Ridges, chosen: IntArray, scale_px: float) -> list[IntArray]:
    """Join chains to lines; return the points of each line in order.

    Parameters
    ----------
    chosen
        Indices of the chains to use, shape (k,).
    scale_px
        The ridges' scale, px.
    """
    parts = [
        part
        for k in chosen
        for part in _parts(ridges, np.arange(ridges.starts[k], ridges.starts[k + 1]))
    ]
    chains = _without_whiskers(ridges, [_core(ridges, part) for part in parts], scale_px)
    return _join(ridges, chains)


def _parts(ridges: Ridges, points: IntArray) -> list[IntArray]:
    """Split an upright chain where its strength dips: folded lines, one above the other."""
    if not is_upright(ridges.image_px[points]):
        return [points]
    height = ridges.height[points]
    before, after = np.maximum.accumulate(height), np.maximum.accumulate(height[::-1])[::-1]
    dark = height < DIP * np.minimum(before, after)
    edges = np.flatnonzero(np.diff(np.pad(dark, 1).astype(int)))
    cuts = [int(a + np.argmin(height[a:b])) for a, b in edges.reshape(-1, 2).tolist()]
    return [part for part in np.split(points, cuts) if len(part) >= LEAST_FOLDED]


def _without_whiskers(ridges: Ridges, chains: list[IntArray], scale: float) -> list[IntArray]:
    """Remove short chains on the flank of a stronger one."""
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
    """Return a chain without its ends, where the ridge is weak and turns aside."""
    strength = ridges.strength[points]
    bright = np.flatnonzero(strength > np.median(strength) / 2)
    points = points[bright[0] : bright[-1] + 1]
    trim = min(round(END_WIDTHS * spread_of(ridges, points)), len(points) // 6)
    return points[trim : len(points) - trim]


def is_upright(place: FloatArray) -> bool:
    """Whether a line of points, shape (n, 2), is steep rather than flat."""
    across, up = np.ptp(place, axis=0)
    return bool(across < UPRIGHT * up)


def spread_of(ridges: Ridges, points: IntArray) -> float:
    """Standard deviation of the smoothed frame's light across ridge points, px."""
    ratio = float(np.median(ridges.height[points] / ridges.strength[points]))
    return float(np.sqrt(max(ratio, 1.0)))  # a brighter neighbour can make it meaningless


def _join(ridges: Ridges, chains: list[IntArray]) -> list[IntArray]:
    """Join chains end to end, the best pair of ends first; return each line's points in order."""
    if not chains:
        return []
    place, out = _chain_ends(ridges, chains)
    step = place[None] - place[:, None]
    length = np.linalg.norm(step, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = np.vecdot(step, out[:, None]) / length
        behind = np.vecdot(-step, out[None]) / length
    least = np.cos(np.radians(MOST_TURN_DEG))
    near = length < 3.0
    # The direction of a short chain is unreliable: that of the longer one decides.
    brief = np.repeat([len(chain) < WHISKER_PX for chain in chains], 2)
    fine_ahead = (ahead > least) | (brief[:, None] & ~brief & (ahead > BRIEF))
    fits = fine_ahead & fine_ahead.T | near & (np.vecdot(out[:, None], out[None]) < 0)
    bright = np.repeat([np.median(ridges.strength[chain]) for chain in chains], 2)
    fits &= np.abs(np.log(bright[:, None] / bright)) < np.log(ALIKE)
    trimmed = np.repeat([END_WIDTHS * spread_of(ridges, chain) for chain in chains], 2)
    spread = GAP_SHARE * np.repeat([float(len(chain)) for chain in chains], 2)
    fits &= length <= LONGEST_GAP_PX + trimmed[:, None] + trimmed + spread[:, None] + spread
    # Upright chains one above the other are lines that the pool has folded together (a caustic).
    folded = np.repeat([is_upright(ridges.image_px[chain]) for chain in chains], 2)
    short = np.repeat([len(chain) < SHORT_PX for chain in chains], 2)
    steep = np.abs(step[..., 0]) < np.abs(step[..., 1])
    inside = np.repeat(np.repeat(_inside(ridges, chains), 2, axis=0), 2, axis=1)
    inside &= (folded | short)[:, None]
    fits &= ~(folded[:, None] & folded | steep & short[:, None] & short | inside | inside.T)
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


def _inside(ridges: Ridges, chains: list[IntArray]) -> BoolArray:
    """Whether each chain, or its middle, is well within the columns of another, shape (k, k)."""
    columns = [ridges.image_px[chain, 0] for chain in chains]
    middle = np.array([each.mean() for each in columns])
    low, high = np.array([[each.min(), each.max()] for each in columns]).T
    room = WITHIN * (high - low)
    amid = (middle[:, None] > low + room) & (middle[:, None] < high - room)
    within = (low[:, None] > low + INSET_PX) & (high[:, None] < high - INSET_PX)
    return np.asarray(amid | within)


def _chain_ends(ridges: Ridges, chains: list[IntArray]) -> tuple[FloatArray, FloatArray]:
    """Positions of both ends of each chain and outward unit vectors there, shape (2·chains, 2)."""
    place, out = [], []
    for chain in chains:
        for points in (chain, chain[::-1]):
            at = ridges.image_px[points[:TANGENT_POINTS]]
            place.append(at[0])
            away = at[0] - at[-1]
            # Extrapolate the bend: the direction at the end has turned twice as far.
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
