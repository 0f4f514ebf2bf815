"""Foot switches for tests: recorded reports, and a device that fails when it is unplugged."""

from __future__ import annotations

import queue
from collections.abc import Iterable

from labapp.media.devices.hid import HidError, HidInfo

INFINITY = HidInfo("/dev/hidraw4", 0x05F3, 0x00FF, 0, (12, 3), "VEC Infinity foot pedal")
PCSENSOR = HidInfo("/dev/hidraw5", 0x3553, 0xB001, 0, (1, 6), "PCsensor FootSwitch")
MOUSE_3D = HidInfo("/dev/hidraw6", 0x256F, 0xC635, 0, (1, 8), "SpaceMouse Compact")

# Report descriptor of a boot keyboard (HID 1.11, appendix B.1).
KEYBOARD = bytes.fromhex(
    "05010906a101050719e029e71500250175019508810295017508810195057501050819012905910295017503"
    "9101950675081500256505071900296581 00c0".replace(" ", "")
)
# Report descriptor of the Infinity: no report number (three buttons, padding).
THREE = bytes.fromhex("050c0903a101050919012903150025017501950381029501750d8101c0")
# Report descriptor of a 3-D controller: axes in report 1, buttons in report 3.
AXES = bytes.fromhex("05010908a1018501095109308102c0")


class Device:
    """A device that sends given reports, and fails when it is unplugged."""

    def __init__(self, descriptor: bytes = THREE) -> None:
        self.descriptor = descriptor
        self.reports: queue.Queue[bytes] = queue.Queue()
        self.plugged = True
        self.opened = 0

    def open(self, info: HidInfo) -> Device:
        if not self.plugged:
            raise HidError(f"{info.name} is not connected")
        self.opened += 1
        return self

    def read(self, n: int, timeout_ms: int = 0) -> list[int]:
        if not self.plugged:
            raise OSError("read error")
        try:
            return list(self.reports.get(timeout=timeout_ms / 1000)[:n])
        except queue.Empty:
            return []

    def send(self, *reports: str) -> None:
        for report in reports:
            self.reports.put(bytes.fromhex(report))

    def get_report_descriptor(self) -> list[int]:
        return list(self.descriptor)

    def close(self) -> None:
        pass


class Bench:
    """Several connected devices; each reader of a device gets all its reports.

    Parameters
    ----------
    devices
        Info → device.
    """

    def __init__(self, devices: dict[HidInfo, Device]) -> None:
        self.devices = devices
        self.readers: list[tuple[HidInfo, Device]] = []
        self.closed: set[HidInfo] = set()

    def find(self) -> Iterable[HidInfo]:
        return [info for info, device in self.devices.items() if device.plugged]

    def open(self, info: HidInfo) -> Device:
        if info in self.closed:
            raise HidError(f"{info.name} may not be read")
        source = self.devices[info]
        reader = Reader(source)
        reader.open(info)
        self.readers.append((info, reader))
        return reader

    def press(self, info: HidInfo, *reports: str) -> None:
        for other, reader in self.readers:
            if other == info:
                reader.send(*reports)


class Reader(Device):
    """A reader of a device."""

    def __init__(self, source: Device) -> None:
        super().__init__(source.descriptor)
        self._source = source

    @property
    def plugged(self) -> bool:
        return self._source.plugged

    @plugged.setter
    def plugged(self, _: bool) -> None: ...
