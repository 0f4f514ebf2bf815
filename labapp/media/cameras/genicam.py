"""Bindings of Aravis and GLib, the libraries for GenICam cameras, by ctypes.

PyGObject is not used, as it would have to be built for every Python (docs/adr/0014). The libraries
are loaded on first use; everything here may be called from any thread.
"""

from __future__ import annotations

import ctypes
import functools
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint64, c_void_p
from typing import Any

from labapp.media.cameras.base import CameraError
from labapp.system import IS_LINUX, library

LIBRARY = library("aravis-0.8", 0)

INSTALL = "GigE Vision and USB3 Vision cameras need Aravis: " + (
    "sudo apt install --no-install-recommends libaravis-0.8-0"
    if IS_LINUX
    else f"{LIBRARY} is not found"
)

VOID, CAMERA, STREAM, BUFFER, ERROR = None, c_void_p, c_void_p, c_void_p, c_void_p

SIGNATURES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_update_device_list": (VOID, ()),
    "arv_get_n_devices": (c_uint, ()),
    "arv_get_device_id": (c_char_p, (c_uint,)),
    "arv_get_device_vendor": (c_char_p, (c_uint,)),
    "arv_get_device_model": (c_char_p, (c_uint,)),
    "arv_get_device_protocol": (c_char_p, (c_uint,)),
    "arv_camera_get_device": (c_void_p, (CAMERA,)),
    "arv_camera_is_gv_device": (c_int, (CAMERA,)),
    "arv_gv_device_is_controller": (c_int, (c_void_p,)),
    "arv_buffer_new_allocate": (BUFFER, (c_size_t,)),
    "arv_buffer_get_status": (c_int, (BUFFER,)),
    "arv_buffer_get_data": (c_void_p, (BUFFER, POINTER(c_size_t))),
    "arv_buffer_get_image_width": (c_int, (BUFFER,)),
    "arv_buffer_get_image_height": (c_int, (BUFFER,)),
    "arv_buffer_get_frame_id": (c_uint64, (BUFFER,)),
    "arv_buffer_get_timestamp": (c_uint64, (BUFFER,)),
    "arv_buffer_get_system_timestamp": (c_uint64, (BUFFER,)),
    "arv_stream_push_buffer": (VOID, (STREAM, BUFFER)),
    "arv_stream_timeout_pop_buffer": (BUFFER, (STREAM, c_uint64)),
}
"""Functions that do not fail: return type and argument types."""

NUMBER, TEXT, YES, BOUNDS, WHOLES = (
    (c_double, ()),
    (c_char_p, ()),
    (c_int, ()),
    (VOID, (POINTER(c_double),) * 2),
    (VOID, (POINTER(c_int),) * 2),
)
OF_CAMERA: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "get_exposure_time": NUMBER,
    "get_exposure_time_bounds": BOUNDS,
    "set_exposure_time": (VOID, (c_double,)),
    "is_exposure_time_available": YES,
    "is_exposure_auto_available": YES,
    "set_exposure_time_auto": (VOID, (c_int,)),
    "get_gain": NUMBER,
    "get_gain_bounds": BOUNDS,
    "set_gain": (VOID, (c_double,)),
    "is_gain_available": YES,
    "is_gain_auto_available": YES,
    "set_gain_auto": (VOID, (c_int,)),
    "get_frame_rate": NUMBER,
    "get_frame_rate_bounds": BOUNDS,
    "set_frame_rate": (VOID, (c_double,)),
    "is_frame_rate_available": YES,
    "get_sensor_size": WHOLES,
    "get_width_bounds": WHOLES,
    "get_height_bounds": WHOLES,
    "get_region": (VOID, (POINTER(c_int),) * 4),
    "set_region": (VOID, (c_int,) * 4),
    "get_pixel_format_as_string": TEXT,
    "set_pixel_format_from_string": (VOID, (c_char_p,)),
    "get_string": (c_char_p, (c_char_p,)),
    "is_feature_available": (c_int, (c_char_p,)),
    "is_software_trigger_supported": YES,
    "dup_available_trigger_sources": (c_void_p, (POINTER(c_uint),)),
    "set_trigger": (VOID, (c_char_p,)),
    "clear_triggers": (VOID, ()),
    "software_trigger": (VOID, ()),
    "set_acquisition_mode": (VOID, (c_int,)),
    "start_acquisition": (VOID, ()),
    "stop_acquisition": (VOID, ()),
    "get_payload": (c_uint, ()),
    "create_stream": (STREAM, (c_void_p, c_void_p)),
}
"""Functions arv_camera_…, with the camera as first and a GError as last argument in addition."""

ControlLost = ctypes.CFUNCTYPE(None, c_void_p, c_void_p)


class _Fault(ctypes.Structure):
    """GLib's GError."""

    _fields_ = (("domain", ctypes.c_uint32), ("code", c_int), ("message", c_char_p))


class Aravis:
    """The loaded library.

    Raises
    ------
    CameraError
        If it is not installed.
    """

    def __init__(self) -> None:
        try:
            self.arv = ctypes.CDLL(LIBRARY)
            self._gobject = ctypes.CDLL(library("gobject-2.0", 0))
            self._glib = ctypes.CDLL(library("glib-2.0", 0))
        except OSError as error:
            raise CameraError(INSTALL) from error
        for name, (result, arguments) in SIGNATURES.items():
            self._declare(name, result, arguments)
        for name, (result, arguments) in OF_CAMERA.items():
            self._declare(f"arv_camera_{name}", result, (CAMERA, *arguments, ERROR))
        self._declare("arv_camera_new", CAMERA, (c_char_p, ERROR))
        self._gobject.g_object_unref.argtypes = (c_void_p,)
        self._gobject.g_object_unref.restype = None
        self._glib.g_error_free.argtypes = (c_void_p,)
        self._glib.g_error_free.restype = None
        self._glib.g_free.argtypes = (c_void_p,)
        self._glib.g_free.restype = None
        connect = self._gobject.g_signal_connect_data
        connect.argtypes = (c_void_p, c_char_p, ControlLost, c_void_p, c_void_p, c_int)
        connect.restype = ctypes.c_ulong
        self._gobject.g_signal_handler_disconnect.argtypes = (c_void_p, ctypes.c_ulong)
        self._gobject.g_signal_handler_disconnect.restype = None

    def _declare(self, name: str, result: Any, arguments: tuple[Any, ...]) -> None:
        function = getattr(self.arv, name)
        function.restype, function.argtypes = result, arguments

    def open(self, device: str) -> int:
        """Open a camera by its id; to be released by `release`."""
        return int(self._asked("arv_camera_new", device.encode()))

    def ask(self, camera: int, name: str, *given: Any) -> Any:
        """Call arv_camera_NAME.

        Raises
        ------
        CameraError
            With Aravis's message.
        """
        return self._asked(f"arv_camera_{name}", camera, *given)

    def pair(self, camera: int, name: str) -> tuple[Any, Any]:
        """Call arv_camera_NAME, which returns two numbers."""
        kind = c_double if OF_CAMERA[name] is BOUNDS else c_int
        first, second = kind(), kind()
        self.ask(camera, name, byref(first), byref(second))
        return first.value, second.value

    def texts(self, camera: int, name: str) -> list[bytes]:
        """Call arv_camera_NAME, which returns texts; empty if the camera lacks the feature."""
        count = c_uint()
        try:
            found = self.ask(camera, name, byref(count))
        except CameraError:
            return []
        texts = ctypes.cast(found, POINTER(c_char_p))
        names = [texts[k] or b"" for k in range(count.value)]
        self._glib.g_free(found)
        return names

    def release(self, thing: int) -> None:
        """Release a camera, a stream or a buffer."""
        self._gobject.g_object_unref(thing)

    def when_lost(self, camera: int, call: Any) -> int:
        """Connect a `ControlLost` callback to the loss of a camera; returns an id for `unhook`."""
        device = self.arv.arv_camera_get_device(camera)
        return int(
            self._gobject.g_signal_connect_data(device, b"control-lost", call, None, None, 0)
        )

    def unhook(self, camera: int, number: int) -> None:
        """Disconnect the callback of `when_lost`."""
        device = self.arv.arv_camera_get_device(camera)
        self._gobject.g_signal_handler_disconnect(device, number)

    def _asked(self, name: str, *given: Any) -> Any:
        fault: Any = POINTER(_Fault)()
        answer = getattr(self.arv, name)(*given, byref(fault))
        if bool(fault):  # not NULL
            words = fault.contents.message.decode(errors="replace")
            self._glib.g_error_free(fault)
            raise CameraError(words)
        return answer


@functools.cache
def aravis() -> Aravis:
    """Return the library, loaded on first use; see `Aravis`."""
    return Aravis()
