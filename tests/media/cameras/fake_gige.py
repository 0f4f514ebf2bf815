"""Aravis's own fake GigE Vision camera, until its input ends.

fake_gige.py ADDRESS SERIAL LOST, the last being the part of its packets that do not arrive.
What arv-fake-gv-camera does, without the GTK that its package brings.
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
sys.stdin.read()  # until whoever started it is gone
