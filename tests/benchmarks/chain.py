"""How fast and how well a video is measured frame from frame: `labapp benchmark`.

Run as ``python tests/benchmarks/chain.py [--frames N] [--cache FOLDER] [--workers N]``. Dots are
also looked for by trackpy, OpenCV and scikit-image; the first and the last are in the dependency
group ``benchmark``, and what is not installed is said.
"""

from __future__ import annotations

import typer

from labapp.cli.benchmark import benchmark

if __name__ == "__main__":
    typer.run(benchmark)
