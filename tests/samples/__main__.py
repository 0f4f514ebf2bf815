"""Write the sample recordings, and the printable target where a file for it is named."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from labapp.simulation.calibration.target import target_svg
from labapp.simulation.recording import TARGET
from tests.samples.lines import line_samples
from tests.samples.runs import samples


def main(arguments: Sequence[str] | None = None) -> None:
    """Write each sample to its own folder."""
    every = {sample.name: sample for sample in (*samples(), *line_samples())}
    parser = argparse.ArgumentParser(prog="python -m tests.samples", description=__doc__)
    parser.add_argument("folder", type=Path, help="where the folders of the samples go")
    parser.add_argument("--only", choices=every, metavar="NAME", help="write this sample alone")
    parser.add_argument(
        "--target", type=Path, metavar="SVG", help="also write the printable target"
    )
    chosen = parser.parse_args(arguments)
    for name in [chosen.only] if chosen.only else every:
        every[name].write(chosen.folder / name)
    if chosen.target is not None:
        chosen.target.parent.mkdir(parents=True, exist_ok=True)
        chosen.target.write_text(target_svg(TARGET), encoding="utf-8")


if __name__ == "__main__":
    main()
