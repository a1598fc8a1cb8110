"""VerifierUpdate: a newly trained verifier, published for agents."""

from dataclasses import dataclass

from rever_env.protocol import value


@dataclass(frozen=True)
class VerifierUpdate:
    """weights: a safetensors file. digest: its SHA-256. policy: the digest of its policy."""

    name: str
    digest: str
    policy: str
    weights: bytes

    def validate(self) -> None:
        value.name("name", self.name)
        value.name("digest", self.digest)
        value.name("policy", self.policy)
