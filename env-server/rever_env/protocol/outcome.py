"""EpisodeOutcome: the result of an episode, for observers."""

from dataclasses import dataclass

from rever_env.protocol import limits, value
from rever_env.protocol.statistics import Statistics
from rever_env.protocol.value import U32


@dataclass(frozen=True)
class EpisodeOutcome:
    """Published once for each completed episode; an episode with a fault has no outcome."""

    run: str
    task: str
    variant: str
    layout: U32 | None
    seed: int
    episode: U32
    strategy: str
    candidates: U32
    temperature: float
    policy: str
    verifier: str | None
    statistics: Statistics
    steps: U32
    score_mean: float | None
    simulator: str

    def validate(self) -> None:
        value.name("run", self.run)
        value.name("task", self.task)
        value.name("variant", self.variant)
        value.range("seed", self.seed, 0, limits.SEED_END - 1)
        value.name("strategy", self.strategy)
        value.finite("temperature", (self.temperature,))
        value.name("policy", self.policy)
        if self.verifier is not None:
            value.name("verifier", self.verifier)
        if self.score_mean is not None:
            value.finite("score_mean", (self.score_mean,))
        value.text("simulator", self.simulator)
