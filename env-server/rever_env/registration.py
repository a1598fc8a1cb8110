"""Registers the Gymnasium ids of the Bridge tasks and of remote environments.

Importing rever_env registers them. A variant has the id of its task:
gymnasium.make(ID, variant=NAME).
"""

from typing import Any

import gymnasium

from rever_env import tasks

REMOTE_ID = "rever/Remote-v1"


def register() -> None:
    """Registers the ids that are not registered yet; imports no simulator."""
    offered = tasks.load().values()
    ids: dict[str, dict[str, Any]] = {}
    for task in offered:
        # The environment itself truncates episodes of a variant that has fewer steps.
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
        # No max_episode_steps: the server truncates.
        "vector_entry_point": "rever_env.remote_vector:RemoteVectorEnv",
    }
    for name, arguments in ids.items():
        if name not in gymnasium.registry:
            gymnasium.register(id=name, **arguments)
