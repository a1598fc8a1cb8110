"""Instructions of any language arrive unchanged, in shared memory too."""

import copy
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv

from rever_env.instruction import Instruction
from rever_env.protocol import limits

TEXTS = ["lay the spoon down", "", "把勺子放在毛巾上", "größer als zuvor " * 40]


class Speaking(gymnasium.Env[Any, Any]):
    """Says another text at every step."""

    observation_space = spaces.Dict({"instruction": Instruction()})
    action_space: spaces.Space[Any] = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._said = 0
        return self._next(), {}

    def step(self, action: Any) -> Any:
        return self._next(), 0.0, False, False, {}

    def _next(self) -> Any:
        self._said += 1
        return {"instruction": TEXTS[(self._said - 1) % len(TEXTS)]}


@pytest.mark.parametrize("is_copied", [True, False])
def test_every_text_is_read_anew_from_shared_memory(is_copied: bool) -> None:
    vector: Any = AsyncVectorEnv([Speaking, Speaking], copy=is_copied)
    try:
        observation, _ = vector.reset(seed=0)
        seen = [tuple(observation["instruction"])]
        for _ in TEXTS[1:]:
            observation, *_ = vector.step(np.zeros(2, np.int64))
            seen.append(tuple(observation["instruction"]))
        assert seen == [(text, text) for text in TEXTS]
    finally:
        vector.close()


def test_the_space_has_every_text_that_the_protocol_carries() -> None:
    space = Instruction(seed=0)
    check_env(Speaking(), skip_render_check=True)
    for text in [*TEXTS, space.sample(), "a" * limits.TEXT_BYTES_MAX, "\ud800"]:
        assert text in space
    for other in ["a" * (limits.TEXT_BYTES_MAX + 1), "把" * 342, 3, None]:
        assert other not in space
    assert space == Instruction() == copy.deepcopy(space) == pickle.loads(pickle.dumps(space))
