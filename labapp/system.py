"""Differences between Linux, macOS and Windows; no other module tests the operating system."""

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
    """Whether there is a display; on Windows and macOS always, as no variable names it there."""
    names = ("DISPLAY", "WAYLAND_DISPLAY")
    return IS_WINDOWS or IS_MACOS or any(environment.get(name) for name in names)


def own_command() -> list[str]:
    """Return the command that starts labapp in the same way, frozen or by Python, as words."""
    frozen = getattr(sys, "frozen", False)
    return [sys.executable] if frozen else [sys.executable, "-m", "labapp"]


def sync_folder(path: Path) -> None:
    """Flush a folder's entries to disk (fsync); not needed on Windows.

    Raises
    ------
    OSError
        If that fails.
    """
    if IS_WINDOWS:  # cannot open folders
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Block Ctrl-C and SIGTERM while processes are started; they are delivered afterwards.

    A process interrupted during its start-up would print tracebacks. The started processes inherit
    the mask: they ignore Ctrl-C, and react to SIGTERM after they call `ignore_interrupts`. Windows
    has no signal mask; there `ignore_interrupts` alone has this effect.
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
    """Ignore Ctrl-C, but not SIGTERM; to be called in the main thread (`interrupts_blocked`)."""
    if IS_WINDOWS:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    else:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})


def lower_priority(nice: int) -> None:
    """Raise the niceness of this process; no effect on Windows."""
    if not IS_WINDOWS:
        os.nice(nice)


def library(name: str, version: int) -> str:
    """Return the file name of a shared library: "libm.so.6" for ("m", 6) on Linux."""
    if IS_WINDOWS:
        return f"lib{name}-{version}.dll"
    return f"lib{name}.{version}.dylib" if IS_MACOS else f"lib{name}.so.{version}"


def quoted(text: str) -> str:
    """Quote a word of a command for the system's shell."""
    return subprocess.list2cmdline([text]) if IS_WINDOWS else shlex.quote(text)
