"""Location of the files shipped with labapp: beside the package or inside it."""

from __future__ import annotations

from pathlib import Path

import pytest

from labapp import bundled as module
from labapp.bundled import bundled

ROOT = Path(__file__).parents[1]


def test_bundled_files_of_a_checkout_are_beside_the_package() -> None:
    assert bundled("resources/udev") == ROOT / "resources" / "udev"
    assert bundled("sample_sessions") == ROOT / "sample_sessions"


def test_bundled_files_of_a_wheel_are_inside_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "labapp"
    (package / "resources").mkdir(parents=True)
    monkeypatch.setattr(module, "files", lambda _: package)
    assert bundled("resources") == package / "resources"
