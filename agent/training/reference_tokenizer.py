"""A stand-in for Llama's tokenizer: same format, special ids and size (32,000), other words.

We may not ship Llama's vocabulary. A comparison depends only on the file's format (a space is
prepended, spaces become "▁", unknown text falls back to bytes, `<s>` begins every text) and on id
29871, the single space. `--tokenizer FILE` uses the real one.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

SIZE = 32000
BEGIN, END, PAD, SPACE = 1, 2, 32000, 29871
SPECIAL = {0: "<unk>", BEGIN: "<s>", END: "</s>"}
# Words get a token of their own, all other text one token for each character.
WORDS = (
    "A chat between a curious user and an artificial intelligence assistant. The assistant gives"
    " helpful, detailed, and polite answers to the user's questions. USER: What action should the"
    " robot take to put spoon carrot towel plate stack green cube on yellow eggplant basket?"
    " ASSISTANT: In: Out: TASK: PLAN: VISIBLE OBJECTS: SUBTASK REASONING: SUBTASK: MOVE REASONING:"
    " MOVE: GRIPPER POSITION: ACTION: Put move gripper above left right down reach grasp is not"
)


def description() -> dict[str, Any]:
    """The contents of tokenizer.json."""
    tokens = [SPECIAL[index] for index in sorted(SPECIAL)]
    tokens += [f"<0x{byte:02X}>" for byte in range(256)]
    merges: list[str] = []
    known = dict.fromkeys(tokens)
    characters = [chr(code) for code in range(33, 127)]
    for character in characters:
        known.setdefault(character)
    for word in dict.fromkeys(WORDS.split()):
        text = "▁"
        for character in word:
            if text + character not in known:
                known[text + character] = None
                merges.append(f"{text} {character}")
            text += character
    vocabulary = {text: index for index, text in enumerate(known)}
    for index in range(len(vocabulary), SIZE):
        vocabulary["▁" if index == SPACE else f"<reserved{index}>"] = index
    special = [{"id": index, "content": text} for index, text in SPECIAL.items()]
    special.append({"id": PAD, "content": "<PAD>"})
    flags = {"single_word": False, "lstrip": False, "rstrip": False, "normalized": False}
    pieces = [{"SpecialToken": {"id": "<s>", "type_id": 0}}]
    return {
        "version": "1.0",
        "truncation": None,
        "padding": None,
        "added_tokens": [{**token, **flags, "special": True} for token in special],
        "normalizer": {
            "type": "Sequence",
            "normalizers": [
                {"type": "Prepend", "prepend": "▁"},
                {"type": "Replace", "pattern": {"String": " "}, "content": "▁"},
            ],
        },
        "pre_tokenizer": None,
        "post_processor": {
            "type": "TemplateProcessing",
            "single": [*pieces, {"Sequence": {"id": "A", "type_id": 0}}],
            "pair": [
                *pieces,
                {"Sequence": {"id": "A", "type_id": 0}},
                {"Sequence": {"id": "B", "type_id": 1}},
            ],
            "special_tokens": {"<s>": {"id": "<s>", "ids": [BEGIN], "tokens": ["<s>"]}},
        },
        "decoder": {
            "type": "Sequence",
            "decoders": [
                {"type": "Replace", "pattern": {"String": "▁"}, "content": " "},
                {"type": "ByteFallback"},
                {"type": "Fuse"},
                {"type": "Strip", "content": " ", "start": 1, "stop": 0},
            ],
        },
        "model": {
            "type": "BPE",
            "dropout": None,
            "unk_token": "<unk>",
            "continuing_subword_prefix": None,
            "end_of_word_suffix": None,
            "fuse_unk": True,
            "byte_fallback": True,
            "ignore_merges": False,
            "vocab": vocabulary,
            "merges": merges,
        },
    }


def write(path: Path, source: Path | None) -> None:
    """Writes tokenizer.json: a copy of `source`, or the stand-in."""
    if source is not None:
        path.write_bytes(source.read_bytes())
        return
    text = json.dumps(description(), ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")
