"""The world of the four Bridge tasks.

tasks.toml -> tasks -> placement -> world (controller, success, camera, snapshot)
world -> expert -> reasoning -> demonstrations; world -> gymnasium_env
world, robosuite_world, gymnasium_world -> worlds -> session -> server
server -> remote_session -> remote: the same as Gymnasium environments, in another process
"""

from typing import TYPE_CHECKING

from rever_env import registration

if TYPE_CHECKING:
    from rever_env.remote import RemoteEnv, RemoteVectorEnv

__all__ = ["RemoteEnv", "RemoteVectorEnv"]

registration.register()


def __getattr__(name: str) -> object:
    # Loaded when asked for: a server needs no client.
    if name in __all__:
        from rever_env import remote

        return getattr(remote, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
