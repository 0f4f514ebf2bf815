"""The log file, with the details of errors. Logging never raises."""

from __future__ import annotations

import faulthandler
import logging
import logging.handlers
from contextlib import suppress
from pathlib import Path

import platformdirs

NAME = "labapp"
MAX_BYTES, KEPT = 1_000_000, 3


def log_file() -> Path:
    """Return the path of the log file."""
    return Path(platformdirs.user_log_dir(NAME, appauthor=False)) / "labapp.log"


def crash_file() -> Path:
    """Return the path of the file with reports of crashes."""
    return log_file().with_name("crash.log")


def start_log() -> logging.Logger:
    """Return the program's logger, which writes to `log_file` if that is writable."""
    logging.raiseExceptions = False
    logger = logging.getLogger(NAME)
    logger.propagate = False
    if all(handler.get_name() != NAME for handler in logger.handlers):
        handler = _handler()
        handler.set_name(NAME)
        logger.addHandler(handler)
    if logging.lastResort is not None:  # notices of `core.compiled` also go to stderr
        logger.getChild("notices").addHandler(logging.lastResort)
    return logger


def report_crashes() -> None:
    """Write what each thread was doing to `crash_file` if a library crashes the program."""
    if faulthandler.is_enabled():
        return
    with suppress(OSError, RuntimeError):  # as in `_handler`
        crash_file().parent.mkdir(parents=True, exist_ok=True)
        faulthandler.enable(crash_file().open("a", encoding="utf-8"))  # kept open by the handler


def _handler() -> logging.Handler:
    try:
        log_file().parent.mkdir(parents=True, exist_ok=True)
        handler = logging.handlers.RotatingFileHandler(
            log_file(), maxBytes=MAX_BYTES, backupCount=KEPT, encoding="utf-8", delay=True
        )
    except (OSError, RuntimeError):  # RuntimeError: no home folder
        return logging.NullHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    return handler
