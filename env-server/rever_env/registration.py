"""The Gymnasium ids of every task and of environments elsewhere; importing rever_env adds them.

A task's variants have its id: gymnasium.make(ID, variant=NAME).
"""

from typing import Any

import gymnasium

from rever_env import tasks

REMOTE_ID = "rever/Remote-v1"


def register() -> None:
    """Adds what is not there yet; imports no simulator."""
    offered = tasks.load().values()
    ids: dict[str, dict[str, Any]] = {}
    for task in offered:
        # The environment itself truncates a variant with fewer steps than another one.
        steps_max = max(one.steps_max for one in offered if one.gymnasium_id == task.gymnasium_id)
        ids.setdefault(
            task.gymnasium_id,
            {
                "entry_point": "rever_env.gymnasium_env:BridgeEnv",
                "kwargs": {"task": task.name, "variant": task.variant},
                "max_episode_steps": steps_max,
            },
        )
    ids[REMOTE_ID] = {
        "entry_point": "rever_env.remote:RemoteEnv",
        # Its server truncates.
        "vector_entry_point": "rever_env.remote_vector:RemoteVectorEnv",
    }
    for name, arguments in ids.items():
        if name not in gymnasium.registry:
            gymnasium.register(id=name, **arguments)
