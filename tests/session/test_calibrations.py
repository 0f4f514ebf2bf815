"""Whether calibrations are those of the set-up: for the pages and for the report."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import labapp
from labapp.session.calibrations import calibrations_in_use
from labapp.session.report import figures, layout, report_pdf
from labapp.session.report.layout import Story
from labapp.session.session import Session

SAMPLE = Path(labapp.__file__).parents[1] / "sample_sessions" / "gtaw"

LENS = {
    "focal_px": [1000.0, 1000.0],
    "center_px": [320.0, 320.0],
    "distortion": [-0.06, 0.0, 0.0, 0.0, 0.0],
}

HOMOGRAPHY = [[0.17, 0.0, -7.0], [0.0, -0.17, 104.0], [0.0, 0.0, 1.0]]


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    """A session whose laser and imaging plane were calibrated, the latter with a lens."""
    with Session.create(tmp_path / "run.labsession") as session:
        session.set_setup((SAMPLE / "setup.toml").read_text("utf-8"))
        session.update_setup({"camera_lens": LENS})
        session.calibrate_laser([4.65, 4.66], [6.22, 6.23], [2.75, 2.76])
        session.calibrate_plane(SAMPLE / "calibration.png", 6.35)
        yield session


def texts_of_report(session: Session, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    texts: list[str] = []
    original = Story.text
    with monkeypatch.context() as patch:
        for module in (figures, layout):
            patch.setattr(module, "DPI", 40)
        patch.setattr(Story, "text", lambda self, text: [texts.append(text), original(self, text)])
        report_pdf(session)
    return texts


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"laser": {"distance_mm": 31.6}}, (False, True)),
        ({"image_calibration": {"homography": HOMOGRAPHY}}, (True, False)),
        ({"camera_lens": {"distortion": [-0.05, 0.0, 0.0, 0.0, 0.0]}}, (True, False)),
        ({"camera_lens": {"center_px": [330.0, 320.0]}}, (True, False)),
        ({"camera_lens": dict.fromkeys(LENS)}, (True, False)),
        ({"electrode": {"height_mm": 4.0}}, (True, True)),
    ],
)
def test_changed_values_are_noticed(
    session: Session,
    keys: dict[str, dict[str, Any]],
    expected: tuple[bool, bool],
    monkeypatch: pytest.MonkeyPatch,
):
    assert calibrations_in_use(session) == (True, True)
    before = texts_of_report(session, monkeypatch)
    session.update_setup(keys)
    assert calibrations_in_use(session) == expected
    said = len(texts_of_report(session, monkeypatch)) - len(before)
    assert said == expected.count(False)
    session.undo()
    assert calibrations_in_use(session) == (True, True)
