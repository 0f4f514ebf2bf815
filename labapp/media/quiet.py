"""Suppression of OpenCV's messages on the terminal."""

from __future__ import annotations

import functools

import cv2


@functools.cache
def quiet_opencv() -> None:
    """Suppress OpenCV's messages; readers report decoding errors."""
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
