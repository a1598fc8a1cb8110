"""The Gymnasium ids of every task and of environments elsewhere; importing rever_env adds them."""

from typing import Any

import gymnasium

from rever_env import tasks

REMOTE_ID = "rever/Remote-v1"


def register() -> None:
    """Adds what is not there yet; imports no simulator."""
    ids: dict[str, dict[str, Any]] = {
        task.gymnasium_id: {
            "entry_point": "rever_env.gymnasium_env:BridgeEnv",
            "kwargs": {"task": task.name},
            "max_episode_steps": task.steps_max,
        }
        for task in tasks.load().values()
    }
    ids[REMOTE_ID] = {
        "entry_point": "rever_env.remote:RemoteEnv",
        # Its server truncates.
        "vector_entry_point": "rever_env.remote:RemoteVectorEnv",
    }
    for name, arguments in ids.items():
        if name not in gymnasium.registry:
            gymnasium.register(id=name, **arguments)
