"""The checklists of Appendix II: safety, equipment and steps of an experiment.

Session files store ticked items by name with the time: renamed items are in `FORMER`.
"""

from __future__ import annotations

from dataclasses import replace

from labapp.session.record import Record

Items = tuple[tuple[str, str], ...]

SAFETY: Items = (
    (
        "Laser points at nobody's eyes",
        "It is of class 3B: never into the beam, nor into its reflection on metal.",
    ),
    ("Laser goggles are worn", "By everybody in the room, for 685 nm."),
    ("Welding helmet is worn", "The arc is bright enough to hurt the eyes."),
    ("Welding clothes are worn", "Against metal spatter."),
    ("Hands stay off the arc", "Arc, torch and work piece are very hot."),
    ("Water cooling is on", "Before the welding machine is switched on."),
    ("Shielding gas is on", "Before the welding machine is switched on."),
)
"""Title and explanation of each item."""

EQUIPMENT: Items = (
    ("Welding machine", "GTAW, with water cooling and shielding gas."),
    ("Welding platform", "It moves the work piece under the torch."),
    (
        "Laser with its lens",
        "685 nm, 20 mW; 19 × 19 dots with 0.77° between rays, or five lines with 0.23°.",
    ),
    ("Imaging plane", "Paper on a square glass is enough."),
    ("Camera with its filter", "A band-pass of 20 nm round the laser's wavelength."),
    ("Goggles for the laser", "For 685 nm."),
    ("Welding helmet and clothes", "For everybody near the arc."),
)

STEPS: Items = (
    ("1 Plate on the platform", "Mild steel of 2 mm; one piece is enough to watch the pool."),
    ("2 Torch upright", "Electrode tip 3 to 5 mm above the work piece."),
    (
        "3 Laser along the weld",
        "At about 30°, about 35 mm from the electrode's tip (90 mm for five lines). The pattern "
        "covers the pool's place; lines lie across the weld. Step Laser measures where it stands.",
    ),
    (
        "4 Imaging plane behind the torch",
        "Across the weld, upright, about 50 mm from the electrode's axis. Step Imaging plane "
        "calibrates it.",
    ),
    (
        "5 Camera before the plane",
        "About 2 m away, square to it; focus and aperture so that the plane is clearly seen; 60 "
        "frames a second or more.",
    ),
    (
        "6 Weld and record",
        "Cooling and gas on, goggles and helmet on; 65 to 75 A; start the platform and the camera. "
        "At the end switch the machine off.",
    ),
)

LISTS = {"Safety": SAFETY, "Equipment": EQUIPMENT, "Steps": STEPS}


FORMER = {
    "Welding goggles are worn": "Welding helmet is worn",
    "Welding goggles and clothes": "Welding helmet and clothes",
}
"""Names of items in older sessions → present names."""


def ticked(record: Record) -> tuple[tuple[str, str], ...]:
    """Return the ticked items by their present names, with times (ISO 8601)."""
    return tuple((FORMER.get(item, item), time) for item, time in record.safety)


def tick(record: Record, item: str, on: bool, now: str) -> Record:
    """Return the record with an item ticked at a time (ISO 8601), or unticked."""
    others = tuple(pair for pair in ticked(record) if pair[0] != item)
    return replace(record, safety=(*others, (item, now)) if on else others)
