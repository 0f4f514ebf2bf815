"""A sample: a simulated recording with its setup and a README, in its own folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from labapp.simulation.recording import DOT_COLUMNS, TARGET, TRUTH_COLUMNS, Recording

FILES = f"""\
| file | what |
| --- | --- |
| `{{file}}` | the frames, {{width}} × {{height}} grey, {{codec}} |
| `calibration.png` | the imaging plane with its marks: unit {TARGET.unit_mm:g} mm, middle of the \
X′ bar at {TARGET.x_middle_mm:g} mm (5.5 units), of the Z′ bar at {TARGET.z_middle_mm:g} mm \
(2.5 units): `labapp calibrate plane calibration.png --unit-mm {TARGET.unit_mm:g}` |
| `setup.toml` | rig and image calibration, exact |
| `truth.csv` | size of the pool in each frame |
| `dots_truth.csv` | each lit ray in each frame: where its dot is, whether it shows, where it met \
the pool |
"""
"""The files of every sample; `file` and `codec` are those of the recording."""


@dataclass(frozen=True, kw_only=True)
class Sample(Recording):
    """A recording that is stored as a sample.

    Parameters
    ----------
    name
        Name of the folder.
    codec
        Description of the recording's file format.
    about
        Text of the README; ``{files}`` is replaced by the table of files.
    """

    name: str
    codec: str
    about: str

    truth_columns: ClassVar[tuple[str, ...]] = TRUTH_COLUMNS[:11]
    dot_columns: ClassVar[tuple[str, ...]] = DOT_COLUMNS[:9]

    def setup(self) -> str:
        """Return the text of the setup file."""
        rig, view = self.rig, self.view
        x, y, z = map(float, rig.imaging_plane.origin_mm)
        return f"""\
# The set-up of the sample run; every number is exact.
[laser]
projection_angle_deg = {rig.laser.projection_angle_deg}
distance_mm = {rig.laser.distance_mm}

[pattern]
rows = {rig.pattern.rows}
columns = {rig.pattern.columns}
inter_beam_angle_deg = {rig.pattern.inter_beam_angle_deg}

[electrode]
height_mm = {rig.electrode.height_mm}

[imaging_plane]
distance_mm = {-y}
s_mm = {-x}
h_mm = {z}
width_mm = {rig.imaging_plane.width_mm}
height_mm = {rig.imaging_plane.height_mm}

[image_calibration]
origin_px = {list(view.origin_px)}
x_axis_px = {list(view.x_axis_px)}
x_axis_mm = {view.x_axis_mm}
z_axis_px = {list(view.z_axis_px)}
z_axis_mm = {view.z_axis_mm}
"""

    def readme(self) -> str:
        """Return the text of the README."""
        name = self.file if Path(self.file).suffix else f"{self.file}/"
        files = FILES.format(
            file=name, codec=self.codec, width=self.view.width_px, height=self.view.height_px
        )
        return self.about.format(files=files.rstrip())

    def write(self, folder: Path) -> None:
        """Write recording, calibration picture, setup file, truth and README into ``folder``.

        Raises
        ------
        OSError
            If the folder or a file in it cannot be written.
        """
        self.write_run(folder, self.setup())
        (folder / "README.md").write_text(self.readme(), encoding="utf-8")
