"""Tables of the session file, and migrations of files of earlier versions.

The operator's input is in `document`, one row per document; `change` has every change with the
values before and after. `recording` and `frame` have the frames, `result` the measurements, and
`inputs` their inputs with the verdict on the set-up. Data derived from these are not stored.
"""

from __future__ import annotations

APPLICATION_ID = 0x4C414250
"""“LABP” in SQLite's header, which identifies a session."""

VERSION = 5
"""Version of the tables below. A change to them adds 1, and a step to `MIGRATIONS`."""

NO_FRAME = -1
"""Frame number of documents that belong to no frame."""

MEASURES = (
    "are_mm mre_mm are_inner_mm mre_inner_mm width_mm length_mm height_mm depth_mm area_mm2 "
    "volume_mm3 center_x_mm center_y_mm peak_x_mm peak_y_mm width_sigma_mm length_sigma_mm "
    "height_sigma_mm depth_sigma_mm area_sigma_mm2 volume_sigma_mm3 "
    "width_sigma_level_mm length_sigma_level_mm height_sigma_level_mm depth_sigma_level_mm "
    "area_sigma_level_mm2 volume_sigma_level_mm3 "
    "width_sigma_setup_mm length_sigma_setup_mm height_sigma_setup_mm depth_sigma_setup_mm "
    "area_sigma_setup_mm2 volume_sigma_setup_mm3 "
    "convexity_mm asymmetry wetting_slope_deg "
    "convexity_sigma_mm asymmetry_sigma wetting_slope_sigma_deg "
    "convexity_sigma_level_mm asymmetry_sigma_level wetting_slope_sigma_level_deg "
    "convexity_sigma_setup_mm asymmetry_sigma_setup wetting_slope_sigma_setup_deg"
).split()
"""Columns of `result` that duplicate `Measures`, so that trends need not unpack every frame."""

TABLES = (
    """CREATE TABLE document (
        kind TEXT NOT NULL,
        frame INTEGER NOT NULL DEFAULT -1,
        sha256 TEXT NOT NULL,
        content BLOB NOT NULL,
        PRIMARY KEY (kind, frame)
    )""",
    """CREATE TABLE change (
        id INTEGER PRIMARY KEY AUTOINCREMENT,
        label TEXT NOT NULL,
        made TEXT NOT NULL,
        undone INTEGER NOT NULL DEFAULT 0 CHECK (undone IN (0, 1))
    )""",
    """CREATE TABLE change_part (
        change INTEGER NOT NULL REFERENCES change (id) ON DELETE CASCADE,
        kind TEXT NOT NULL,
        frame INTEGER NOT NULL,
        before BLOB,
        after BLOB,
        PRIMARY KEY (change, kind, frame)
    )""",
    """CREATE TABLE picture (
        sha256 TEXT PRIMARY KEY,
        name TEXT NOT NULL,
        content BLOB NOT NULL
    )""",
    """CREATE TABLE recording (
        id INTEGER PRIMARY KEY CHECK (id = 1),
        content BLOB NOT NULL
    )""",
    """CREATE TABLE frame (
        number INTEGER PRIMARY KEY CHECK (number >= 0),
        time_s REAL,
        checksum INTEGER
    )""",
    """CREATE TABLE frame_image (
        frame INTEGER PRIMARY KEY REFERENCES frame (number) ON DELETE CASCADE,
        content BLOB NOT NULL
    )""",
    """CREATE TABLE inputs (
        id INTEGER PRIMARY KEY,
        version TEXT NOT NULL,
        setup BLOB NOT NULL,
        settings BLOB NOT NULL, verdict BLOB,
        UNIQUE (version, setup, settings)
    )""",
    f"""CREATE TABLE result (
        id INTEGER PRIMARY KEY,
        frame INTEGER NOT NULL REFERENCES frame (number) ON DELETE CASCADE,
        scheme TEXT NOT NULL,
        inputs INTEGER NOT NULL REFERENCES inputs (id),
        correction TEXT,
        measured TEXT NOT NULL,
        status TEXT NOT NULL,
        correspondence TEXT,
        {", ".join(f"{name} REAL" for name in MEASURES)},
        UNIQUE (frame, scheme)
    )""",
    "CREATE INDEX result_inputs ON result (inputs)",
    """CREATE TABLE detail (
        result INTEGER PRIMARY KEY REFERENCES result (id) ON DELETE CASCADE,
        content BLOB NOT NULL
    )""",
)

MIGRATIONS: dict[int, tuple[str, ...]] = {
    1: tuple(f"ALTER TABLE result ADD COLUMN {name} REAL" for name in MEASURES[20:26]),
    2: tuple(f"ALTER TABLE result ADD COLUMN {name} REAL" for name in MEASURES[26:32]),
    3: ("ALTER TABLE inputs ADD COLUMN verdict BLOB",),
    4: tuple(f"ALTER TABLE result ADD COLUMN {name} REAL" for name in MEASURES[32:44]),
}
"""Version → statements that migrate to the next version."""
