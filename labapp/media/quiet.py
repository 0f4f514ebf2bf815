"""Keep OpenCV's and FFmpeg's own messages off the user's terminal; ours say what is wrong."""

from __future__ import annotations

import functools
import os

import cv2


@functools.cache
def quiet_opencv() -> None:
    """Silence OpenCV and FFmpeg, and have FFmpeg drop packets that were cut off.

    FFmpeg's part is read from the environment when the first video is opened; what the user has
    set there stands. Without ``discardcorrupt`` the last frame of a truncated MJPG video is half
    a picture on grey.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", "fflags;discardcorrupt")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
