"""Rules for the keys of a scenario besides those of a setup."""

from __future__ import annotations

from typing import Any

from labapp.config.toml_keys import Rule, are_numbers, between, is_number, one_of, whole, within

LARGEST_POOL_MM = 100.0
"""Upper limit of a pool's lengths."""

RECORDINGS = {"avi": "recording.avi", "tif": "recording.tif", "png": "recording"}
"""Format → the recording's name: a video, a TIFF stack, a folder of PNG files."""

BITS = (8, 12, 16)


def _places(count: int, what: str, required: bool = False) -> Rule:
    return Rule(
        what,
        lambda value: are_numbers(value, count) and max(map(abs, value)) < LARGEST_POOL_MM,
        required,
    )


def _is_outline(value: object) -> bool:
    return isinstance(value, list) and len(value) >= 3 and all(are_numbers(at, 2) for at in value)


def _is_mode(value: object) -> bool:
    return (
        isinstance(value, list)
        and [type(number) for number in value] == [int, int]
        and 0 <= value[0] <= 8
        and 1 <= value[1] <= 8
    )


_LENGTH = between(0, LARGEST_POOL_MM, "mm")
_HEIGHT = between(-LARGEST_POOL_MM / 2, LARGEST_POOL_MM / 2, "mm; below 0 for a concave pool")
_ANGLE = within(-360, 360, "degrees")

_EVERY_CAP = {
    "height_mm": _HEIGHT,
    "center_mm": _places(2, "[x, y], two numbers (mm)"),
    "fullness": Rule(
        "a number from 0 to below 1 (0: a paraboloid)",
        lambda value: is_number(value) and 0 <= value < 1,
        required=False,
    ),
    "wander_percent": within(0, 20, "% of its size, standard deviation over time"),
}

SHAPES: dict[str, dict[str, Rule]] = {
    "cap": {"diameter_mm": _LENGTH, **_EVERY_CAP},
    "ellipsoid": {"width_mm": _LENGTH, "length_mm": _LENGTH, **_EVERY_CAP},
    "egg": {"width_mm": _LENGTH, "head_mm": _LENGTH, "tail_mm": _LENGTH, **_EVERY_CAP},
    "surface": {
        "file": Rule(
            "the name of a height map (.csv, .npy, .npz) or of a mesh (.stl, .ply)",
            lambda value: isinstance(value, str) and value != "",
        ),
        "spacing_mm": between(0, 10, "mm", required=False),
        "center_mm": _EVERY_CAP["center_mm"],
        "outline_mm": Rule("a list of three or more corners [x, y] (mm)", _is_outline, False),
    },
}
"""Shape → keys of [pool] besides `shape`."""

SHAPE = one_of(*SHAPES, required=True)

TERMS: dict[str, dict[str, Rule]] = {
    "dent": {
        "depth_mm": within(-10, 10, "mm", required=True),
        "radius_mm": _LENGTH,
        "offset_mm": _places(2, "[x, y] from the pool's centre, two numbers (mm)"),
    },
    "low_rear": {"drop_mm": within(0, 10, "mm", required=True)},
    "wave": {
        "mode": Rule("[m, n], whole numbers: m from 0 and n from 1, both up to 8", _is_mode),
        "amplitude_mm": within(0, 10, "mm", required=True),
        "frequency_hz": within(0, 1e5, "Hz", required=True),
        "kind": one_of("standing", "travelling"),
        "turned_deg": _ANGLE,
        "phase_deg": _ANGLE,
        "damping_per_s": within(0, 1e4, "1/s"),
    },
}
"""Disturbances of a cap, each a table [pool.NAME] or several [[pool.NAME]]: name → keys."""

TABLES: dict[str, dict[str, Rule]] = {
    "torch": {
        "tip_mm": _places(3, "[x, y, z], three numbers (mm)", required=True),
        "tip_radius_mm": within(0, 50, "mm"),
        "radius_mm": within(0, 50, "mm"),
        "half_angle_deg": within(0, 89, "degrees"),
    },
    "camera": {
        "width_px": whole(64, 8192),
        "height_px": whole(64, 8192),
        "focal_px": within(10, 1e6, "px"),
        **{name: within(-10, 10, "") for name in ("k1", "k2", "p1", "p2", "k3")},
    },
    "look": {
        "dot_peak": within(0, 1000, "grey levels"),
        "unevenness": within(0, 3, ""),
        "beam_fraction": within(0, 1, "of the inter-beam angle"),
        "dot_floor_mm": between(0, 10, "mm", required=False),
        "dot_ceiling_mm": between(0, 10, "mm", required=False),
        "speckle": within(0, 1, "contrast"),
        "blur_px": within(0, 50, "px"),
        "background": within(0, 255, "grey levels"),
        "glow": within(0, 255, "grey levels"),
        "read_noise": within(0, 100, "grey levels"),
        "photon_noise": within(0, 10, "grey levels² per grey level"),
        "hot_pixels": whole(0, 100_000),
        "false_dots": whole(0, 10_000),
        "missing": within(0, 1, "probability"),
        "full_scale": between(0, 255.5, "grey levels", required=False),
        "bits": Rule("8, 12 or 16", lambda v: type(v) is int and v in BITS, False),
    },
    "recording": {
        "frames": whole(1, 1_000_000, required=True),
        "frame_rate_hz": between(0, 1e6, "Hz"),
        "exposure_ms": within(0, 1e5, "ms"),
        "seed": whole(0, 2**31 - 1, required=True),
        "format": one_of(*RECORDINGS),
    },
}
"""Every table except the set-up's and [pool]; [torch], [camera] and [look] are optional."""


def pool_rules(keys: dict[str, Any]) -> dict[str, Rule]:
    """Rules for [pool], given its keys: its shape determines which keys it may have."""
    rules = SHAPES.get(str(keys.get("shape")), {})
    some = Rule("a table, or a list of them", lambda v: isinstance(v, dict | list), required=False)
    terms = {} if "file" in rules else dict.fromkeys(TERMS, some)
    return {"shape": SHAPE, **rules, **terms}
