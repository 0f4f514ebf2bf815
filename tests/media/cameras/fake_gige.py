"""Run the fake GigE Vision camera of Aravis until the standard input ends.

Usage: fake_gige.py ADDRESS SERIAL LOST, where LOST is the ratio of lost packets.
It replaces arv-fake-gv-camera, whose package depends on GTK.
"""

from __future__ import annotations

import ctypes
import sys

arv = ctypes.CDLL("libaravis-0.8.so.0")
arv.arv_gv_fake_camera_new.restype = ctypes.c_void_p
arv.arv_gv_fake_camera_new.argtypes = (ctypes.c_char_p, ctypes.c_char_p)
arv.arv_gv_fake_camera_is_running.argtypes = (ctypes.c_void_p,)
camera = arv.arv_gv_fake_camera_new(sys.argv[1].encode(), sys.argv[2].encode())
gobject = ctypes.CDLL("libgobject-2.0.so.0")
gobject.g_object_set(
    ctypes.c_void_p(camera), b"gvsp-lost-ratio", ctypes.c_double(float(sys.argv[3])), None
)
print("running" if arv.arv_gv_fake_camera_is_running(camera) else "failed", flush=True)
sys.stdin.read()  # until the parent process ends
