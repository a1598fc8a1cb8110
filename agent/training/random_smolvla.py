"""Writes a small SmolVLA of the LeRobot package with random weights, to try serve_lerobot.py.

    python agent/training/random_smolvla.py DIR

SmolVLA reads the configuration and the processor of its vision-language model from a folder or from
the Hub; DIR/vlm has small ones, so that nothing is downloaded. Its actions mean nothing.

Needs lerobot[smolvla] 0.4.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE
from tokenizers import Tokenizer, decoders, models, pre_tokenizers
from transformers import (
    PreTrainedTokenizerFast,
    SmolVLMConfig,
    SmolVLMImageProcessor,
    SmolVLMProcessor,
    SmolVLMVideoProcessor,
)

SIDE = 128
PATCH = 16
# Patches are merged to a quarter in each direction.
SCALE = 4
STATE_NUMBERS = 8
DIMENSIONS = 7
CHUNK = 8
SPECIAL = {
    "image_token": "<image>",
    "fake_image_token": "<fake_token_around_image>",
    "global_image_token": "<global-img>",
    "end_of_utterance_token": "<end_of_utterance>",
    "video_token": "<video>",
}
# Deviations of the actions: metres, radians, gripper. The policy's output has deviation 1.
DEVIATIONS = [0.01, 0.01, 0.01, 0.02, 0.02, 0.05, 1.0]


def write_vlm(folder: Path) -> None:
    """Configuration, tokenizer and image processor of a small SmolVLM."""
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    names = ["<pad>", "<s>", "</s>", *alphabet]
    inner = Tokenizer(models.BPE({name: index for index, name in enumerate(names)}, []))
    inner.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    inner.decoder = decoders.ByteLevel()
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=inner,
        pad_token="<pad>",
        bos_token="<s>",
        eos_token="</s>",
        extra_special_tokens=SPECIAL,
    )
    vision = {
        "hidden_size": 48,
        "intermediate_size": 96,
        "num_hidden_layers": 2,
        "num_attention_heads": 3,
        "image_size": SIDE,
        "patch_size": PATCH,
    }
    text = {
        "model_type": "llama",
        "vocab_size": len(tokenizer),
        "hidden_size": 64,
        "intermediate_size": 128,
        "num_hidden_layers": 4,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "head_dim": 16,
        "pad_token_id": tokenizer.pad_token_id,
    }
    image_token = tokenizer.convert_tokens_to_ids(SPECIAL["image_token"])
    config = SmolVLMConfig(
        vision_config=vision,
        text_config=text,
        scale_factor=SCALE,
        image_token_id=image_token,
        pad_token_id=tokenizer.pad_token_id,
    )
    config.save_pretrained(folder)
    processor = SmolVLMProcessor(
        SmolVLMImageProcessor(size={"longest_edge": SIDE}),
        tokenizer,
        SmolVLMVideoProcessor(),
        image_seq_len=(SIDE // PATCH // SCALE) ** 2,
    )
    processor.save_pretrained(folder)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("out", type=Path, metavar="DIR", help="folder of the policy")
    parser.add_argument("--seed", type=int, default=0, help="of the weights (default: 0)")
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    # The path is part of the policy's configuration.
    vlm = arguments.out.resolve() / "vlm"
    write_vlm(vlm)
    config = SmolVLAConfig(
        input_features={
            OBS_STATE: PolicyFeature(FeatureType.STATE, (STATE_NUMBERS,)),
            f"{OBS_IMAGES}.camera": PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE)),
        },
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (DIMENSIONS,))},
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        resize_imgs_with_padding=(SIDE, SIDE),
        vlm_model_name=str(vlm),
        num_vlm_layers=4,
        device="cpu",
        push_to_hub=False,
    )
    policy = SmolVLAPolicy(config)
    statistics = {
        OBS_STATE: {"mean": torch.zeros(STATE_NUMBERS), "std": torch.ones(STATE_NUMBERS)},
        ACTION: {"mean": torch.zeros(DIMENSIONS), "std": torch.tensor(DEVIATIONS)},
    }
    before, after = make_pre_post_processors(config, dataset_stats=statistics)
    for part in (policy, before, after):
        part.save_pretrained(arguments.out)
    weights = sum(parameter.numel() for parameter in policy.parameters())
    print(f"{arguments.out}: SmolVLA, {weights / 1e6:.2f} M random weights")


if __name__ == "__main__":
    main()
