"""USB input devices (HID): finding, reading, and reconnection."""

from __future__ import annotations

import logging
import os
import shlex
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, Self

from labapp.bundled import bundled
from labapp.errors import InputError
from labapp.media.events import Event, Kind, OnEvent, ignore_event
from labapp.system import IS_LINUX

LONGEST = 64
"""Most bytes of a report."""

WAIT_MS = 30
"""Timeout for a report before `stop` is checked, ms."""

RETRY_S = 0.5
"""Pause between attempts to open a missing device, s."""

MISSING = "hidapi is needed to read foot switches: pip install 'labapp[gui]'"

AWAY, UNPLUGGED = "it is not connected", "it was unplugged"

RULES = "resources/udev/70-labapp.rules"

RULES_FOLDER = "/etc/udev/rules.d/"

KNOWN: Mapping[tuple[int, int], str] = {
    (0x0C45, 0x7403): "PCsensor FootSwitch",
    (0x0C45, 0x7404): "PCsensor FootSwitch",
    (0x413D, 0x2107): "PCsensor FootSwitch",
    (0x1A86, 0xE026): "PCsensor FootSwitch",
    (0x3553, 0xB001): "PCsensor FootSwitch",
    (0x05F3, 0x00FF): "VEC Infinity foot pedal",
}
"""Foot switches by (vendor, product), to which the udev rules give access."""


class HidError(Exception):
    """A device cannot be used; the message says why and what to do about it."""


@dataclass(frozen=True)
class HidInfo:
    """A device, or one interface of a device with several."""

    path: str
    """Device file: "/dev/hidraw3"."""
    vendor: int
    product: int
    interface: int
    """Numbers by USB."""
    usage: tuple[int, int]
    """(page, usage) of HID: (1, 6) is a keyboard, (1, 8) a 3-D controller."""
    name: str
    """Name for display."""

    @property
    def key(self) -> str:
        """Identifier independent of the port: "0c45:7403:1"."""
        return f"{self.vendor:04x}:{self.product:04x}:{self.interface}"

    @property
    def is_pedal(self) -> bool:
        """Whether it is a known foot switch."""
        return (self.vendor, self.product) in KNOWN

    @property
    def is_3d(self) -> bool:
        """Whether it is a six-axis controller."""
        return self.usage == (1, 8)

    @property
    def is_mouse(self) -> bool:
        """Whether it is a mouse."""
        return self.usage == (1, 2)

    @property
    def is_keyboard(self) -> bool:
        """Whether it sends key numbers rather than button bits."""
        return self.usage == (1, 6)


class HidDevice(Protocol):
    """An open device, with the interface of hidapi."""

    def read(self, n: int, timeout_ms: int = 0) -> list[int]:
        """Wait for a report of up to ``n`` bytes; empty after the timeout; OSError if lost."""
        ...

    def close(self) -> None:
        """Close the device."""
        ...

    def get_report_descriptor(self) -> list[int]:
        """Return the report descriptor (HID 1.11, §6.2.2)."""
        ...


Find = Callable[[], Iterable[HidInfo]]
Open = Callable[[HidInfo], HidDevice]

_mutex = threading.Lock()
"""Serialises calls from several threads, as hidapi has a global last error."""


def find_hid() -> list[HidInfo]:
    """Return the connected devices, known foot switches first.

    Raises
    ------
    HidError
        If hidapi is not installed.
    """
    hidraw = _hidraw()
    with _mutex:
        entries = hidraw.enumerate()
    found = [
        HidInfo(
            path=os.fsdecode(entry["path"]),
            vendor=entry["vendor_id"],
            product=entry["product_id"],
            interface=entry["interface_number"],
            usage=(entry["usage_page"], entry["usage"]),
            name=_name(entry),
        )
        for entry in entries
    ]
    return sorted(found, key=lambda info: not info.is_pedal)


def _name(entry: Mapping[str, Any]) -> str:
    known = KNOWN.get((entry["vendor_id"], entry["product_id"]))
    reported = f"{entry['manufacturer_string'] or ''} {entry['product_string'] or ''}".strip()
    return known or reported or f"{entry['vendor_id']:04x}:{entry['product_id']:04x}"


def open_hid(info: HidInfo) -> HidDevice:
    """Open a device.

    Raises
    ------
    HidError
        If it is not connected or not readable; the message says which rule to install, and how.
    """
    device: HidDevice = _hidraw().device()
    try:
        with _mutex:
            device.open_path(os.fsencode(info.path))  # type: ignore[attr-defined]
    except OSError as error:
        raise HidError(why_closed(info)) from error
    return device


def why_closed(info: HidInfo) -> str:
    """Explain why a device cannot be opened, and what to do."""
    if IS_LINUX and not os.path.exists(info.path):
        return f"{info.name} is not connected"
    if may_be_read(info):
        return f"{info.name} does not answer: plug it in again"
    return (
        f"no permission to read {info.name}. Install the udev rule: {commands(info)}, and plug it "
        "in again"
    )


def may_be_read(info: HidInfo) -> bool:
    """Whether the user has permission to read a device; can be checked on Linux only."""
    return not IS_LINUX or os.access(info.path, os.R_OK | os.W_OK)


def commands(info: HidInfo) -> str:
    """Return shell commands that allow reading a device, by `RULES` or a rule for it alone."""
    rules = bundled(RULES)
    if (info.is_pedal or info.is_3d) and rules.is_file():
        install = f"sudo cp {shlex.quote(str(rules))} {RULES_FOLDER}"
    else:
        rule = (
            f'KERNEL=="hidraw*", ATTRS{{idVendor}}=="{info.vendor:04x}", '
            f'ATTRS{{idProduct}}=="{info.product:04x}", TAG+="uaccess"'
        )
        install = f"echo '{rule}' | sudo tee -a {RULES_FOLDER}{rules.name}"
    return f"{install} && sudo udevadm control --reload"


def has_numbers(descriptor: Iterable[int]) -> bool:
    """Whether a device's reports begin with a report ID.

    Parameters
    ----------
    descriptor
        Its report descriptor (HID 1.11, §6.2.2): items of a byte with tag and size, and data.
    """
    items = iter(descriptor)
    for item in items:
        if item == 0xFE:  # a long item: size, tag, data
            skipped = next(items, 0) + 1
        else:
            if item & 0xFC == 0x84:  # Report ID
                return True
            skipped = (0, 1, 2, 4)[item & 3]
        for _ in range(skipped):
            next(items, None)
    return False


class HidReader:
    """Reader thread of a device, which reconnects after unplugging; base of devices in use.

    The thread starts in ``__init__``, which subclasses must call last.

    Parameters
    ----------
    retry_s
        Pause between searches for a missing device, s; None: `RETRY_S`.
    """

    def __init__(
        self,
        name: str,
        on_event: OnEvent = ignore_event,
        find: Find = find_hid,
        opener: Open = open_hid,
        retry_s: float | None = None,
    ) -> None:
        self.connected = False
        self._name, self._on_event = name, on_event
        self._retry_s = retry_s
        self._find, self._opener = find, opener
        self._reported = ""
        self._gone_s = time.monotonic()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"reader of {name}", daemon=True)
        self._thread.start()

    def matches(self, info: HidInfo) -> bool:
        """Whether this is the device."""
        raise NotImplementedError

    def on_report(self, number: int, report: bytes) -> None:
        """Take a report, in the reader's thread.

        Parameters
        ----------
        number
            Report ID, or 0; −1 when the device is lost: everything is released.
        report
            Its bytes, without the ID.
        """
        raise NotImplementedError

    def stop(self) -> None:
        """Stop reading. May be called twice."""
        self._ending.set()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _run(self) -> None:
        try:
            while not self._ending.is_set():
                try:
                    self._read_on()
                except (HidError, OSError, ValueError) as error:
                    self._on_disconnect(str(error) if isinstance(error, HidError) else UNPLUGGED)
                    self._ending.wait(self._retry_s or RETRY_S)
        except Exception as error:
            logging.getLogger("labapp").exception("reader of %s", self._name)
            self._emit("warning", f"a fault in the program: {error!r}")
        self.connected = False

    def _on_disconnect(self, words: str) -> None:
        """Raise an event with the reason, once for each reason."""
        if self.connected:
            self.connected = False
            self._gone_s = time.monotonic()
            self._deliver(-1, b"")
        if words != self._reported and not (self._reported and words == AWAY):
            self._emit("warning", words)
            self._reported = words

    def _read_on(self) -> None:
        info = next(filter(self.matches, self._find()), None)
        if info is None:
            raise HidError(AWAY)
        device = self._opener(info)
        try:
            numbered = has_numbers(device.get_report_descriptor())
            away_s = time.monotonic() - self._gone_s
            self._emit("note", f"connected after {away_s:.1f} s" if self._reported else "connected")
            self._reported, self.connected = "", True
            while not self._ending.is_set():
                report = bytes(device.read(LONGEST, WAIT_MS))
                if report:
                    self._deliver(report[0] if numbered else 0, report[numbered:])
        finally:
            device.close()

    def _deliver(self, number: int, report: bytes) -> None:
        """Call `on_report`; an error in it raises an event and does not end reading."""
        try:
            self.on_report(number, report)
        except Exception as error:
            if not isinstance(error, InputError):
                logging.getLogger("labapp").exception("%s, report %s", self._name, report.hex())
            self._emit("warning", f"its action failed: {error}")

    def _emit(self, kind: Kind, words: str) -> None:
        self._on_event(Event(self._name, kind, words))


def _hidraw() -> Any:
    """Import the module of hidapi that reads through the operating system's drivers."""
    try:
        if IS_LINUX:
            import hidraw
        else:
            import hid as hidraw
    except ImportError as error:
        raise HidError(MISSING) from error
    return hidraw
