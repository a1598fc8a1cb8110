"""LeRobot's EnvHub looks for this file and calls make_env; see rever_env.lerobot."""

from rever_env.lerobot import make_env

__all__ = ["make_env"]
