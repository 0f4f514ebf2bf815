"""Chains of ridge points joined to lines, through gaps and crossings."""

from __future__ import annotations

import numpy as np

from labapp.core.lines.ridges import Ridges
from labapp.core.values import BoolArray, FloatArray, IntArray

TANGENT_POINTS = 20
"""The direction in which a chain ends is that of so many of its points."""

END_WIDTHS = 1.5
"""A line's ridge is not followed nearer to its end than so many standard deviations of its smoothed
light: there, it turns aside."""

UPRIGHT = 0.35
"""A line is upright that is narrower than this share of its height."""

DIP, LEAST_FOLDED = 0.6, 6
"""An upright chain is cut where it falls below this share of what it is on both sides; parts of
fewer points are left out."""

WHISKER_PX, WHISKER_OFF = 16, 3.0
"""A chain of fewer points that is no farther than so many times the ridges' scale from a stronger
one is part of that one's side."""

SHORT_PX = 25
"""Chains of fewer points are not joined when one is more above than beside the other."""

ALIKE = 2.5
"""Parts of one line are not brighter one than the other by a larger factor."""

GAP_SHARE = 0.1
"""A gap is longer where the pool spreads the line: by so much of the length of what it parts."""

WITHIN, INSET_PX = 0.25, 2.0
"""An upright or short chain below another is not part of it where its middle is farther in than so
much of its extent, or all of it so many pixels: that is a folded line below an arch, and no leg."""

BRIEF = 0.3
"""Cosine of the largest turn at a short chain's end where it follows on a longer one."""


def join_chains(
    ridges: Ridges, chosen: IntArray, scale_px: float, gap_px: float, turn_deg: float
) -> list[IntArray]:
    """Join chains to lines; the points of each line, in order.

    Parameters
    ----------
    ridges
        Of the frame.
    chosen
        Which of its chains count, shape (k,).
    scale_px
        The ridges' scale, px.
    gap_px, turn_deg
        Longest gap, px, and largest turn at either side of it, degrees.
    """
    parts = [
        part
        for k in chosen
        for part in _parts(ridges, np.arange(ridges.starts[k], ridges.starts[k + 1]))
    ]
    chains = _without_whiskers(ridges, [_core(ridges, part) for part in parts], scale_px)
    return _join(ridges, chains, gap_px, turn_deg)


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
    trim = min(round(END_WIDTHS * spread_of(ridges, points)), len(points) // 6)
    return points[trim : len(points) - trim]


def is_upright(place: FloatArray) -> bool:
    """Whether a line of places, shape (n, 2), goes up rather than across."""
    across, up = np.ptp(place, axis=0)
    return bool(across < UPRIGHT * up)


def spread_of(ridges: Ridges, points: IntArray) -> float:
    """Standard deviation of the smoothed frame's light across ridge points, px."""
    ratio = float(np.median(ridges.height[points] / ridges.strength[points]))
    return float(np.sqrt(max(ratio, 1.0)))  # what a brighter neighbour outshines has none


def _join(ridges: Ridges, chains: list[IntArray], gap_px: float, turn_deg: float) -> list[IntArray]:
    """Join chains end to end, the best pair of ends first; points of each line in order."""
    if not chains:
        return []
    place, out = _chain_ends(ridges, chains)
    step = place[None] - place[:, None]
    length = np.linalg.norm(step, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = np.vecdot(step, out[:, None]) / length
        behind = np.vecdot(-step, out[None]) / length
    least = np.cos(np.radians(turn_deg))
    near = length < 3.0
    # A short chain has no direction of its own to rely on: that of a longer one decides.
    brief = np.repeat([len(chain) < WHISKER_PX for chain in chains], 2)
    fine_ahead = (ahead > least) | (brief[:, None] & ~brief & (ahead > BRIEF))
    fits = fine_ahead & fine_ahead.T | near & (np.vecdot(out[:, None], out[None]) < 0)
    bright = np.repeat([np.median(ridges.strength[chain]) for chain in chains], 2)
    fits &= np.abs(np.log(bright[:, None] / bright)) < np.log(ALIKE)
    trimmed = np.repeat([END_WIDTHS * spread_of(ridges, chain) for chain in chains], 2)
    spread = GAP_SHARE * np.repeat([float(len(chain)) for chain in chains], 2)
    fits &= length <= gap_px + trimmed[:, None] + trimmed + spread[:, None] + spread
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
    """Whether each chain, or its middle, is well within the columns of each other, shape (k, k)."""
    columns = [ridges.image_px[chain, 0] for chain in chains]
    middle = np.array([each.mean() for each in columns])
    low, high = np.array([[each.min(), each.max()] for each in columns]).T
    room = WITHIN * (high - low)
    amid = (middle[:, None] > low + room) & (middle[:, None] < high - room)
    within = (low[:, None] > low + INSET_PX) & (high[:, None] < high - INSET_PX)
    return np.asarray(amid | within)


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
