"""Files that come with labapp and are not code: samples, scenarios, the target, the guide."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path


def bundled(name: str) -> Path:
    """Place of a file or folder that comes with labapp, whether it is there or not.

    The folders ``resources``, ``sample_sessions`` and ``docs/guide`` are beside the package in a
    checkout; a wheel has them inside it (``pyproject.toml``).

    Parameters
    ----------
    name
        From the top of the repository: "resources/simulations".
    """
    package = Path(str(files("labapp")))
    inside = package / name
    return inside if inside.exists() else package.parent / name
