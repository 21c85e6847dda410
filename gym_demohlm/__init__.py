"""Gymnasium environments of G1 loco-manipulation tasks; importing it registers each task as ``DemoHLM/<Task>-v0``."""

import ctypes.util as _ctypes_util
import os as _os
import sys as _sys

# MuJoCo chooses its graphics at import: without a display, one that draws into memory, where there is one.
if _sys.platform == "linux" and not _os.environ.get("DISPLAY") and "MUJOCO_GL" not in _os.environ:
    for _library, _backend in (("EGL", "egl"), ("OSMesa", "osmesa")):
        if _ctypes_util.find_library(_library):
            _os.environ["MUJOCO_GL"] = _backend
            break

from gym_demohlm.registry import all_tasks as _all_tasks

_all_tasks()
