"""Silence OpenCV's own messages on the terminal; ours report what is wrong."""

from __future__ import annotations

import functools

import cv2


@functools.cache
def quiet_opencv() -> None:
    """Silence OpenCV; what it cannot decode is reported by its reader."""
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
