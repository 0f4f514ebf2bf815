"""Python in a separate process, for code that may hang or fill the memory."""

from __future__ import annotations

import subprocess
import sys
import textwrap

from tests.waiting import PATIENCE_S

SHOW_PEAK = """
with open("/proc/self/status") as file:
    peak = next(line for line in file if line.startswith("VmHWM:"))
print("peak", int(peak.split()[1]) // 1024)
"""


def run_python(script: str, *arguments: object) -> str:
    """Run a script, which must end in time and without an error; return its output."""
    process = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script), *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
        env={"PYTHONPATH": ":".join(sys.path)},
    )
    assert (process.returncode, process.stderr) == (0, "")
    return process.stdout


def peak_mb(script: str, *arguments: object) -> int:
    """Peak memory of a script, MB."""
    printed = run_python(textwrap.dedent(script) + SHOW_PEAK, *arguments)
    return int(printed.split()[-1])
