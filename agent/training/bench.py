"""The PyTorch side of `rever bench decision --compare`, which starts this program.

python agent/training/bench.py POLICY OBSERVATIONS

Reads one JSON request per line and answers with the milliseconds that it took. The request has the
tokens, so that both sides do the same steps; the sampling of each token is timed as well. Nothing
is parsed or scored.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor
from torch import _dynamo as dynamo
from torch.nn import functional

import checkpoint
from network import Network, rotary_table, rotate

# Cache positions reserved for a completion.
TOKENS_MAX = 48

Cache = tuple[Tensor, Tensor]  # keys and values: (layers, batch, heads, positions, head)


def main() -> None:
    policy = checkpoint.read(Path(sys.argv[1]))
    torch.set_grad_enabled(False)
    images, prompts = [], []
    with safe_open(sys.argv[2], "pt") as file:
        metadata = file.metadata()
        for index in range(int(metadata["observations"])):
            images.append(file.get_tensor(f"{index}.image")[None])
            prompt = policy.tokenizer.prompt(metadata[f"{index}.instruction"])
            prompts.append(torch.tensor([prompt]))
    # Each number of candidates is compiled separately, for the best speed.
    dynamo.config.recompile_limit = 64
    # Attention over the whole cache with a mask, instead of a slice, needs only one compilation.
    # A compiled step has one shape: caches have room for the longest prompt and a completion.
    patches = policy.network.config.vision.patches
    positions = patches + max(prompt.shape[1] for prompt in prompts) + TOKENS_MAX
    eager = Decoding(policy.network, positions, lambda function: function, fixed=False)
    compiled = Decoding(
        policy.network, positions, partial(torch.compile, dynamic=False), fixed=True
    )
    settings, broken = {}, []
    for name, decoding in (("eager", eager), ("compiled", compiled)):
        try:
            decoding.decide(images[0], prompts[0], torch.zeros(2, 2, dtype=torch.long))
            settings[name] = decoding
        except Exception as error:  # compilers and their tool chains raise errors of many types
            broken.append(f"{name}: {str(error).strip().splitlines()[0]}")
    answer(
        version=torch.__version__,
        threads=torch.get_num_threads(),
        settings=list(settings),
        broken=broken,
    )
    for line in sys.stdin:
        request = json.loads(line)
        index, tokens = request["observation"], torch.tensor(padded(request["tokens"]))
        start = time.perf_counter()
        settings[request["setting"]].decide(images[index], prompts[index], tokens)
        answer(ms=1e3 * (time.perf_counter() - start))


def answer(**values: object) -> None:
    print(json.dumps(values), flush=True)


def padded(rows: list[list[int]]) -> list[list[int]]:
    """Pads candidates that ended early, malformed ones: PyTorch's batch runs to the longest."""
    longest = max(len(row) for row in rows)
    return [row + [row[-1]] * (longest - len(row)) for row in rows]


class Decoding:
    """One prefill shared by all candidates, then one token of each at a time."""

    def __init__(
        self,
        network: Network,
        positions: int,
        compile_: Callable[[Callable[..., Tensor]], Callable[..., Tensor]],
        *,
        fixed: bool,
    ) -> None:
        self.network = network
        self.positions = positions
        self.fixed = fixed
        self.embed = compile_(network.embed)
        self.advance = compile_(self._advance)
        config = network.config.text
        self.rotary = rotary_table(positions, config, torch.device("cpu"))

    def decide(self, image: Tensor, prompt: Tensor, tokens: Tensor) -> None:
        """image (1, height, width, 3), prompt (1, ids), tokens (candidates, steps)."""
        embedded = self.embed(image, prompt)
        length = embedded.shape[1]
        keys, values = self.empty(1)
        logits = self.advance(embedded, torch.arange(length), keys, values)
        candidates = len(tokens)
        keys, values = (each.repeat(1, candidates, 1, 1, 1) for each in (keys, values))
        logits = logits.expand(candidates, -1)
        for step in range(tokens.shape[1]):
            torch.multinomial(torch.softmax(logits, dim=-1), 1)
            words = self.network.language_model.model.embed_tokens(tokens[:, step])[:, None]
            logits = self.advance(words, torch.tensor([length + step]), keys, values)
        torch.multinomial(torch.softmax(logits, dim=-1), 1)

    def empty(self, batch: int) -> Cache:
        config = self.network.config.text
        heads, layers = config.num_key_value_heads, config.num_hidden_layers
        shape = (layers, batch, heads, self.positions, config.head_size)
        return torch.zeros(shape), torch.zeros(shape)

    def _advance(self, x: Tensor, positions: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        """(batch, new, hidden) at `positions` -> (batch, vocabulary) of the last; fills caches."""
        decoder = self.network.language_model.model
        config = decoder.config
        cosine, sine = (table[positions] for table in self.rotary)
        batch, new, width = x.shape
        shape = (batch, new, -1, config.head_size)
        seen = self.positions if self.fixed else int(positions[-1]) + 1
        mask = torch.arange(seen)[None] <= positions[:, None]  # (new, seen)
        groups = config.num_attention_heads // config.num_key_value_heads
        for index, layer in enumerate(decoder.layers):
            attention = layer.self_attn
            normed = layer.input_layernorm(x)
            # (batch, new, heads * head) -> (batch, heads, new, head)
            query = rotate(attention.q_proj(normed).view(shape).transpose(1, 2), cosine, sine)
            key = rotate(attention.k_proj(normed).view(shape).transpose(1, 2), cosine, sine)
            keys[index].index_copy_(2, positions, key)
            values[index].index_copy_(
                2, positions, attention.v_proj(normed).view(shape).transpose(1, 2)
            )
            mixed = functional.scaled_dot_product_attention(
                query,
                keys[index][:, :, :seen].repeat_interleave(groups, dim=1),
                values[index][:, :, :seen].repeat_interleave(groups, dim=1),
                attn_mask=mask,
            )
            x = x + attention.o_proj(mixed.transpose(1, 2).reshape(batch, new, width))
            x = x + layer.mlp(layer.post_attention_layernorm(x))
        hidden: Tensor = decoder.norm(x[:, -1])
        logits: Tensor = self.network.language_model.lm_head(hidden)
        return logits


if __name__ == "__main__":
    main()
