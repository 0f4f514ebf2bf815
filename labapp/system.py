"""What differs between Linux, macOS and Windows: no other module asks which of them it runs on."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

IS_WINDOWS = sys.platform == "win32"
IS_MACOS = sys.platform == "darwin"
IS_LINUX = sys.platform.startswith("linux")


def has_display(environment: Mapping[str, str]) -> bool:
    """Whether there is a screen for windows; Windows and macOS name none in the environment."""
    names = ("DISPLAY", "WAYLAND_DISPLAY")
    return IS_WINDOWS or IS_MACOS or any(environment.get(name) for name in names)


def own_command() -> list[str]:
    """Words of the command that starts labapp again, as this one was: frozen, or by Python."""
    frozen = getattr(sys, "frozen", False)
    return [sys.executable] if frozen else [sys.executable, "-m", "labapp"]


def sync_folder(path: Path) -> None:
    """Have the disk hold the names that a folder has now; Windows sees to that by itself.

    Raises
    ------
    OSError
        If the disk cannot.
    """
    if IS_WINDOWS:  # opens no folders
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Block Ctrl-C and SIGTERM while processes are started; this one receives them afterwards.

    A process that is only half set up reports errors about what it lacks. Those that are started
    ignore Ctrl-C from then on, and heed SIGTERM when they call `ignore_interrupts`. Windows has no
    such mask: there that call does it.
    """
    if IS_WINDOWS:
        yield
        return
    former = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)


def ignore_interrupts() -> None:
    """Ignore Ctrl-C from now on, but heed SIGTERM; in the main thread (`interrupts_blocked`)."""
    if IS_WINDOWS:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    else:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})


def lower_priority(nice: int) -> None:
    """Raise the niceness of this process; without effect on Windows."""
    if not IS_WINDOWS:
        os.nice(nice)


def library(name: str, version: int) -> str:
    """File name of a shared library of a version: "libm.so.6" of ("m", 6) on Linux."""
    if IS_WINDOWS:
        return f"lib{name}-{version}.dll"
    return f"lib{name}.{version}.dylib" if IS_MACOS else f"lib{name}.so.{version}"


def quoted(text: str) -> str:
    """A word of a command, as it is typed in the system's shell."""
    return subprocess.list2cmdline([text]) if IS_WINDOWS else shlex.quote(text)
