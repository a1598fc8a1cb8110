"""A newly trained verifier on its way to the agents."""

from dataclasses import dataclass

from rever_env.protocol import value


@dataclass(frozen=True)
class VerifierUpdate:
    """weights: a safetensors file; digest: its SHA-256; policy: whose hidden states it reads."""

    name: str
    digest: str
    policy: str
    weights: bytes

    def validate(self) -> None:
        value.name("name", self.name)
        value.name("digest", self.digest)
        value.name("policy", self.policy)
