"""`labapp calibrate`: calibration of laser and imaging plane, and a check with known mirrors."""

from labapp.cli.calibrate import bench, fold, laser, pattern, plane
from labapp.cli.shared import command_group

app = command_group()
app.command("laser")(laser.calibrate_laser)
app.command("plane")(plane.calibrate_plane)
app.command("bench")(bench.calibrate_bench)
app.command("pattern")(pattern.calibrate_pattern)
app.command("fold")(fold.calibrate_fold)
