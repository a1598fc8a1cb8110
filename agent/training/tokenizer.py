"""The generator's tokenizer: phrases, coordinates, 256 action bins, bytes for all other text.

Ids: 0 `<unk>`, 1 `<s>`, 2 `</s>`, 256 bytes, 3 x 128 coordinates, the phrases, reserved ids up to
a multiple of 64, and last the action bins as in OpenVLA: bin d (1..256) has id V - d, V being the
number of tokens. The phrases are added tokens: the longest match wins.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tokenizers

UNKNOWN, BEGIN, END = 0, 1, 2
ACTION_BINS = 256
COORDINATE_LEVELS = 128
COORDINATE_STEP_PIXELS = 2
# The text before and after a coordinate in a list: first, middle, last.
COORDINATE_FORMS = ((" [", ""), (", ", ""), (", ", "]"))
FIRST_COORDINATE_ID = 3 + 256
VOCABULARY_MULTIPLE = 64

PROMPT_TEMPLATE = "In: What action should the robot take to {instruction}?\nOut:"


class Tokenizer:
    """Text to ids and back, and the ids of coordinates and action bins."""

    def __init__(self, description: dict[str, Any]) -> None:
        self.description = description
        self.inner = tokenizers.Tokenizer.from_str(json.dumps(description))
        self.size = self.inner.get_vocab_size()

    @classmethod
    def build(cls, phrases: Sequence[str], instructions: Sequence[str]) -> Tokenizer:
        """Phrases: the fixed segments of the reasoning. Instructions are in lower case."""
        before, after = PROMPT_TEMPLATE.split("{instruction}")
        added = list(dict.fromkeys([before, after, *instructions, *phrases]))
        tokens = ["<unk>", "<s>", "</s>", *(f"<0x{byte:02X}>" for byte in range(256))]
        coordinates = [
            f"{left}{level * COORDINATE_STEP_PIXELS}{right}"
            for left, right in COORDINATE_FORMS
            for level in range(COORDINATE_LEVELS)
        ]
        tokens += coordinates + added
        reserved = -len(tokens) % VOCABULARY_MULTIPLE
        tokens += [f"<reserved{index}>" for index in range(reserved)]
        tokens += [f"<action{digit}>" for digit in range(ACTION_BINS, 0, -1)]
        if len(set(tokens)) != len(tokens):
            raise ValueError("phrases of the tokenizer: expected distinct texts, got a duplicate")
        return cls(describe(tokens, coordinates + added))

    @classmethod
    def load(cls, path: Path) -> Tokenizer:
        return cls(json.loads(path.read_text(encoding="utf-8")))

    def save(self, path: Path) -> None:
        text = json.dumps(self.description, indent=1, ensure_ascii=False)
        path.write_text(text + "\n", encoding="utf-8")

    def encode(self, text: str) -> list[int]:
        ids: list[int] = self.inner.encode(text, add_special_tokens=False).ids
        return ids

    def decode(self, ids: Sequence[int]) -> str:
        text: str = self.inner.decode(list(ids), skip_special_tokens=False)
        return text

    def prompt(self, instruction: str) -> list[int]:
        """The first token and the prompt; the image patches follow the first token."""
        return [BEGIN, *self.encode(PROMPT_TEMPLATE.format(instruction=instruction.lower()))]

    def action_id(self, digit: int) -> int:
        if not 1 <= digit <= ACTION_BINS:
            raise ValueError(f"action bin: expected 1 to {ACTION_BINS}, got {digit}")
        return self.size - digit


def describe(tokens: list[str], added: list[str]) -> dict[str, Any]:
    """tokenizer.json of a byte-fallback model without merges; the phrases are added tokens."""
    ids = {token: index for index, token in enumerate(tokens)}
    special = ["<unk>", "<s>", "</s>"]
    return {
        "version": "1.0",
        "truncation": None,
        "padding": None,
        "added_tokens": [
            {
                "id": ids[token],
                "content": token,
                "single_word": False,
                "lstrip": False,
                "rstrip": False,
                "normalized": False,
                "special": token in special,
            }
            for token in sorted([*special, *added], key=lambda token: ids[token])
        ],
        "normalizer": None,
        "pre_tokenizer": None,
        "post_processor": None,
        "decoder": {"type": "Sequence", "decoders": [{"type": "ByteFallback"}, {"type": "Fuse"}]},
        "model": {
            "type": "BPE",
            "dropout": None,
            "unk_token": "<unk>",
            "continuing_subword_prefix": None,
            "end_of_word_suffix": None,
            "fuse_unk": False,
            "byte_fallback": True,
            "ignore_merges": False,
            "vocab": ids,
            "merges": [],
        },
    }
