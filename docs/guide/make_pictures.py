"""Make the guide's pictures anew: those of `tests/tour` that its pages show, in few colours.

Needs a display, or `xvfb-run -a -s "-screen 0 1366x768x24" .venv/bin/python THIS`.
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

GUIDE = Path(__file__).parent
PICTURES = GUIDE / "pictures"


def main() -> None:
    """Take the tour and keep what is linked, under its name without the number."""
    pages = "".join(page.read_text("utf-8") for page in GUIDE.glob("*.md"))
    wanted = set(re.findall(r"\(pictures/(\S+)\.png\)", pages))
    PICTURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as out:
        tour = [sys.executable, "-m", "tests.tour", "--out", out]
        subprocess.run(tour, cwd=GUIDE.parents[1], check=True)
        for old in PICTURES.glob("*.png"):
            old.unlink()
        for name in sorted(wanted):
            (taken,) = Path(out).glob(f"[0-9][0-9][0-9]-{name}.png")
            picture = Image.open(taken).convert("RGB")
            # The few bright points among much grey must keep their colours.
            few = picture.quantize(
                256, Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE
            )
            few.save(PICTURES / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
