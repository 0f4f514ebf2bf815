from tests.export.conftest import calibration, measured, unmeasured, writer

__all__ = ["calibration", "measured", "unmeasured", "writer"]
