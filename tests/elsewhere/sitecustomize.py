"""Run labapp as on another system: features missing there are hidden from its modules.

Python loads this at startup if this folder is on PYTHONPATH, also in child processes.
LABAPP_ELSEWHERE is "win32" or "darwin". Only modules of labapp see the other system, as libraries
are those of the installed one. For "win32" files behave as on Windows, for all modules.
"""

from __future__ import annotations

import builtins
import fcntl
import os
import sys
import warnings
from types import ModuleType
from typing import Any

SYSTEM = os.environ.get("LABAPP_ELSEWHERE", "")

NO_DISPLAY = ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM")

LINUX_ONLY = {
    "modules": {"hidraw", "spwd"},
    "os": {"O_TMPFILE", "memfd_create", "sched_setaffinity", "sched_getaffinity", "splice"},
    "signal": {"sigtimedwait", "sigwaitinfo"},
    "socket": {"AF_NETLINK", "AF_PACKET", "AF_ALG"},
}

POSIX_ONLY = {
    "modules": {"fcntl", "termios", "tty", "pty", "pwd", "grp", "resource", "syslog", "curses"},
    "os": {
        *("O_NOFOLLOW", "O_DIRECTORY", "O_CLOEXEC", "O_NONBLOCK", "O_SYNC", "O_DSYNC", "O_NOCTTY"),
        *("fchmod", "fchown", "chown", "lchown", "fchdir", "chroot", "mkfifo", "mknod", "nice"),
        *("getuid", "geteuid", "getgid", "getpgid", "killpg", "fork", "forkpty", "setsid"),
        *("uname", "statvfs", "fstatvfs", "pread", "pwrite", "readv", "writev", "sendfile"),
        *("posix_spawn", "posix_fallocate", "posix_fadvise", "sync", "fdatasync", "sysconf"),
        *("pathconf", "register_at_fork", "getloadavg", "lockf", "openpty", "wait", "WNOHANG"),
    },
    "signal": {
        *("pthread_sigmask", "pthread_kill", "sigwait", "sigpending", "SIG_BLOCK", "SIG_SETMASK"),
        *("SIGHUP", "SIGKILL", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGCHLD", "SIGPIPE", "SIGSTOP"),
        *("SIGQUIT", "alarm", "setitimer", "siginterrupt", "pause"),
    },
    "socket": {"AF_UNIX", "socketpair_unix", "sendmsg", "SO_REUSEPORT", "CMSG_LEN"},
    "time": {"tzset", "clock_settime", "pthread_getcpuclockid"},
}


class Elsewhere(ModuleType):
    """A Python module as on the other system; attributes are set in the true module."""

    def __init__(self, true: ModuleType, lacking: set[str], other: dict[str, Any]) -> None:
        super().__init__(true.__name__)
        own = object.__getattribute__(self, "__dict__")
        own.update(_true=true, _lacking=lacking, _other=other)

    def __getattribute__(self, name: str) -> Any:
        own = object.__getattribute__(self, "__dict__")
        if name in own["_lacking"]:
            raise AttributeError(f"module {own['_true'].__name__!r} has no {name!r} on {SYSTEM}")
        return own["_other"][name] if name in own["_other"] else getattr(own["_true"], name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(object.__getattribute__(self, "__dict__")["_true"], name, value)


def hide_missing() -> None:
    """Make labapp's modules see the other system from now on."""
    missing = {
        name: LINUX_ONLY.get(name, set())
        | (POSIX_ONLY.get(name, set()) if SYSTEM == "win32" else set())
        for name in {*LINUX_ONLY, *POSIX_ONLY}
    }
    absent = missing.pop("modules")
    replaced: dict[str, dict[str, Any]] = {
        "sys": {"platform": SYSTEM},
        "os": {"environ": {k: v for k, v in os.environ.items() if k not in NO_DISPLAY}},
    }
    if SYSTEM == "win32":
        replaced["os"]["name"] = "nt"
    import signal
    import socket
    import time

    true = {module.__name__: module for module in (os, sys, signal, socket, time)}
    views = {
        name: Elsewhere(module, missing.get(name, set()), replaced.get(name, {}))
        for name, module in true.items()
    }
    original_import = builtins.__import__

    def imported(
        name: str, globals: Any = None, locals: Any = None, fromlist: Any = (), level: int = 0
    ) -> Any:
        if level == 0 and (globals or {}).get("__name__", "").partition(".")[0] == "labapp":
            if name.partition(".")[0] in absent:
                raise ModuleNotFoundError(f"No module named {name!r} on {SYSTEM}", name=name)
            if name in views:
                return views[name]
        return original_import(name, globals, locals, fromlist, level)

    builtins.__import__ = imported


# --- files, as on Windows -----------------------------------------------------------------------

LOCK_PROBE = ".filelock-probe-"
"""Files with which filelock tries the locks of Unix: on Windows it has other code, without them."""

TRUE = {name: getattr(os, name) for name in ("open", "fsync", "rename", "replace", "unlink")}


def _permission_error(path: Any, why: str) -> PermissionError:
    return PermissionError(13, f"refused on Windows, as {why}", os.fsdecode(path))


def _refuse_if_open(*paths: Any) -> None:
    """Raise an error if this process has one of the paths, or a file below it, open."""
    names = [os.path.abspath(os.fsdecode(path)) for path in paths]
    for handle in os.listdir("/proc/self/fd"):
        try:
            target = os.readlink(f"/proc/self/fd/{handle}")
        except OSError:  # the handle of the listing
            continue
        if os.path.basename(target).startswith(LOCK_PROBE):
            continue
        if any(target == name or target.startswith(f"{name}/") for name in names):
            raise _permission_error(target, "it is open")


def _open(path: Any, flags: int, *more: Any, **options: Any) -> int:
    if not isinstance(path, int) and os.path.isdir(path):
        raise _permission_error(path, "it is a folder")
    return int(TRUE["open"](path, flags, *more, **options))


def _fsync(handle: Any) -> None:
    number = handle if isinstance(handle, int) else handle.fileno()
    if fcntl.fcntl(number, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
        raise OSError(9, "refused on Windows, as the handle is not to be written to")
    TRUE["fsync"](number)


def _rename(source: Any, target: Any) -> None:
    if os.path.lexists(target):
        raise FileExistsError(17, "refused on Windows, as it is there", os.fsdecode(target))
    _refuse_if_open(source)
    TRUE["rename"](source, target)


def _replace(source: Any, target: Any) -> None:
    if os.path.isdir(target):
        raise _permission_error(target, "it is a folder")
    _refuse_if_open(source, target)
    TRUE["replace"](source, target)


def _unlink(path: Any) -> None:
    # filelock sees the true system and removes its open lock, which Windows would not allow.
    if sys._getframe(1).f_globals.get("__name__", "").partition(".")[0] != "filelock":
        _refuse_if_open(path)
    TRUE["unlink"](path)


def behave_like_windows_with_files() -> None:
    """Reject operations on files which Windows rejects."""
    import shutil
    import tempfile

    tempfile.TemporaryFile = tempfile.NamedTemporaryFile  # type: ignore[assignment]
    shutil._use_fd_functions = False  # type: ignore[attr-defined]  # they open folders
    for name, function in {
        "open": _open,
        "fsync": _fsync,
        "rename": _rename,
        "replace": _replace,
        "unlink": _unlink,
        "remove": _unlink,
    }.items():
        setattr(os, name, function)


if SYSTEM:
    hide_missing()
    # Without an encoding, text is read in a different one there.
    warnings.filterwarnings("ignore", category=EncodingWarning)
    warnings.filterwarnings("error", category=EncodingWarning, module=r"labapp(\.|$)")
    if SYSTEM == "win32":
        behave_like_windows_with_files()
