"""The world of the four Bridge tasks.

tasks.toml -> tasks -> layout -> world (controller, success, camera, snapshot)
world -> expert -> reasoning -> demonstrations; world -> gymnasium_env
world, robosuite_world, gymnasium_world -> worlds -> session -> server
server -> remote_session -> remote: the same as Gymnasium environments, in another process
"""

import os
import sys
from typing import TYPE_CHECKING

from rever_env import registration

if TYPE_CHECKING:
    from rever_env.remote import RemoteEnv, RemoteVectorEnv

__all__ = ["RemoteEnv", "RemoteVectorEnv"]

# Importing MuJoCo with its default backend needs a display. The worlds make their own contexts.
_HAS_DISPLAY = bool(os.environ.get("DISPLAY"))
_CAN_USE_EGL = os.environ.get("PYOPENGL_PLATFORM", "egl") == "egl"
if sys.platform == "linux" and _CAN_USE_EGL and not _HAS_DISPLAY:
    os.environ.setdefault("MUJOCO_GL", "egl")
# Mesa's software renderer draws in the thread that asks: handing a small picture to threads of its
# own takes as long as drawing it, servers share a machine by processes, and threads do not live on
# in a process that is forked, as Gymnasium's asynchronous vectors are.
os.environ.setdefault("LP_NUM_THREADS", "0")
registration.register()


def __getattr__(name: str) -> object:
    # Loaded when asked for: a server needs no client.
    if name in __all__:
        from rever_env import remote

        return getattr(remote, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
