"""Robot manipulation environments for Gymnasium: four Bridge tasks in MuJoCo, and remote servers.

    import gymnasium

    environment = gymnasium.make("rever_env:rever/StackCube-v1")
    observation, info = environment.reset(seed=1)  # image, state, instruction
    action = environment.action_space.sample()  # metres, radians, gripper
    observation, reward, terminated, truncated, info = environment.step(action)

Gymnasium ids:
    rever/SpoonOnTowel-v1, rever/CarrotOnPlate-v1, rever/StackCube-v1, rever/EggplantInBasket-v1:
        BridgeEnv, which documents spaces, reward, end of episodes, info and errors.
    rever/Remote-v1 with connect="tcp/HOST:PORT": RemoteEnv, an environment of a server that was
        started with `python -m rever_env serve --listen tcp/HOST:PORT`. RemoteVectorEnv steps many.

Modules, in the order of the data flow:
tasks.toml -> tasks -> layout -> world (controller, success, camera, snapshot)
world -> expert -> reasoning -> demonstrations; world -> gymnasium_env
world, robosuite_world, gymnasium_world -> worlds -> session -> server
server -> remote_network -> remote_session -> remote -> remote_vector
gymnasium_env, remote -> lerobot
"""

import importlib
import os
import sys
from typing import TYPE_CHECKING

from rever_env import registration

if TYPE_CHECKING:
    from rever_env.gymnasium_env import BridgeEnv
    from rever_env.remote import RemoteEnv
    from rever_env.remote_network import RemoteFault, RemoteRefused
    from rever_env.remote_vector import RemoteVectorEnv, RemoteVectorFault

__all__ = [
    "BridgeEnv",
    "RemoteEnv",
    "RemoteFault",
    "RemoteRefused",
    "RemoteVectorEnv",
    "RemoteVectorFault",
]
# Imported on first access: a server needs no client, and a client no simulator.
_MODULES = {
    "BridgeEnv": "gymnasium_env",
    "RemoteEnv": "remote",
    "RemoteFault": "remote_network",
    "RemoteRefused": "remote_network",
    "RemoteVectorEnv": "remote_vector",
    "RemoteVectorFault": "remote_vector",
}

# Importing MuJoCo with its default backend needs a display. The worlds create their own contexts.
_HAS_DISPLAY = bool(os.environ.get("DISPLAY"))
_CAN_USE_EGL = os.environ.get("PYOPENGL_PLATFORM", "egl") == "egl"
if sys.platform == "linux" and _CAN_USE_EGL and not _HAS_DISPLAY:
    os.environ.setdefault("MUJOCO_GL", "egl")
# No worker threads in Mesa's software renderer: handing a small image to them takes as long as
# rendering it, servers use the cores by processes, and threads do not survive a fork, which
# Gymnasium's asynchronous vectors need.
os.environ.setdefault("LP_NUM_THREADS", "0")
registration.register()


def __getattr__(name: str) -> object:
    if name in _MODULES:
        return getattr(importlib.import_module(f"rever_env.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
