"""OpenGL without a screen: which kind works on this machine."""

import functools
import os
import subprocess
import sys
from importlib import import_module
from typing import Any

from tcmrl_data.foundation.errors import RenderingError

KINDS = ("egl", "osmesa")
"""What MuJoCo can draw with where there is no screen: the graphics driver, or Mesa on the processor."""

TRIAL_SECONDS = 60.0

REMEDY = "install libegl1 and libgl1-mesa-dri, or libosmesa6, or draw on another machine"

TRIAL = """
import sys
from importlib import import_module
import mujoco
context = import_module("mujoco." + sys.argv[1]).GLContext(64, 64)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100).free()
context.free()
"""


def make_context(width: int, height: int) -> Any:
    """An OpenGL context of MuJoCo, current on this thread; the caller frees it.

    Args:
        width: of pictures in pixels.
        height: of pictures in pixels.

    Raises:
        RenderingError: this machine has no OpenGL that works without a screen.
    """
    kind = find_open_gl()
    if kind is None:
        raise RenderingError(
            f"no OpenGL works here without a screen (EGL, OSMesa), so that MuJoCo cannot draw; {REMEDY}"
        )
    context = import_module(f"mujoco.{kind}").GLContext(width, height)
    context.make_current()
    return context


def check_chosen_kind() -> None:
    """Refuses a kind that `MUJOCO_GL` names and that does not work, before MuJoCo fails at its import.

    Raises:
        RenderingError: the kind does not work on this machine.
    """
    named = os.environ.get("MUJOCO_GL", "")
    if named.lower() in KINDS and find_open_gl() is None:
        raise RenderingError(f"MUJOCO_GL={named} does not work here, so that MuJoCo cannot draw; {REMEDY}")


@functools.cache
def find_open_gl() -> str | None:
    """The first kind of OpenGL that works here, None if none does; `MUJOCO_GL` may name the only one to try.

    Every kind is tried in a process of its own, since a process is bound to the first one that it loads, and
    a broken driver may end it. Other values of `MUJOCO_GL`, such as `disabled`, do not matter.
    """
    named = os.environ.get("MUJOCO_GL", "").lower()
    return next((kind for kind in ((named,) if named in KINDS else KINDS) if _works(kind)), None)


def _works(kind: str) -> bool:
    try:
        trial = subprocess.run(
            [sys.executable, "-c", TRIAL, kind],
            env=os.environ | {"MUJOCO_GL": kind},
            capture_output=True,
            check=False,
            timeout=TRIAL_SECONDS,
        )
    except subprocess.TimeoutExpired:
        return False
    return trial.returncode == 0
