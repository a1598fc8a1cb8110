"""Entry point of LeRobot's EnvHub, which imports this file and calls make_env.

rever_env.lerobot documents the arguments, spaces, reward and info.
"""

from rever_env.lerobot import make_env

__all__ = ["make_env"]
