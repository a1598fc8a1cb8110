"""Writes agent/remote-policy/golden with the peers' own packages: openpi-client, vla-eval, json_numpy.

Usage: python tests/golden_frames.py FOLDER
"""

import sys
from pathlib import Path

import json_numpy
import numpy as np
from openpi_client import msgpack_numpy
from vla_eval.protocol.image_codec import encode_image
from vla_eval.protocol.messages import Message, MessageType, pack_message
from vla_eval.protocol.numpy_codec import set_image_format

SECONDS = 1700000000.25
PIXELS = np.arange(18, dtype=np.uint8).reshape(2, 3, 3) * 14
STATE = np.array([0.25, -0.5, 0.125, 0, 0, 1.5, 0, 1], dtype=np.float32)
CHUNK = np.array([[0.5, 0, 0, 0, 0, 0.25, 1], [-0.5, 0, 0, 0, 0, 0, -1]])
INSTRUCTION = "stack the cubes"


def openpi() -> dict[str, bytes]:
    """An observation, the metadata, and results with arrays of several types."""
    observation = {
        "observation/image": PIXELS,
        "observation/state": STATE,
        "prompt": INSTRUCTION,
    }
    result = {
        "actions": CHUNK,
        "state": STATE,
        "policy_timing": {"infer_ms": np.float64(12.5)},
        "server_timing": {"infer_ms": 13.5, "prev_total_ms": 20.25},
    }
    half = {"actions": CHUNK[0].astype(np.float16)}
    big = {"actions": CHUNK.astype(">f4")}
    frames = {"observation": observation, "metadata": {}, "result": result}
    frames |= {"result_half": half, "result_big_endian": big}
    return {
        f"openpi_{name}": msgpack_numpy.packb(frame) for name, frame in frames.items()
    }


def vla_eval() -> dict[str, bytes]:
    """Every kind of message; an observation in each form of its image."""

    def pack(kind: MessageType, payload: dict, sequence: int) -> bytes:
        return pack_message(Message(kind, payload, sequence, SECONDS))

    hello = {"harness_version": "0.8.0", "protocol_version": 1}
    server = {"model_server": "Server", "capabilities": {}, **hello}
    task = {"name": "stack", "suite": "rever", "episode_idx": 3}
    observation = {
        "images": {"primary": PIXELS},
        "task_description": INSTRUCTION,
        "states": STATE,
    }
    frames = {
        "hello_client": pack(MessageType.HELLO, hello, 1),
        "hello_server": pack(MessageType.HELLO, server, 1),
        "episode_start": pack(MessageType.EPISODE_START, {"task": task}, 2),
        "action": pack(MessageType.ACTION, {"actions": CHUNK[0].astype(np.float32)}, 3),
        "error": pack(
            MessageType.ERROR, {"error": "observation_failed: KeyError: 'images'"}, 3
        ),
        "episode_end": pack(MessageType.EPISODE_END, {"metrics": {"success": True}}, 4),
    }
    for form, name in [("png", "png"), ("jpeg", "jpeg"), ("raw", "array")]:
        set_image_format(form)
        frames[f"observation_{name}"] = pack(MessageType.OBSERVATION, observation, 3)
    raw = {**observation, "images": {"primary": encode_image(PIXELS, "raw")}}
    frames["observation_raw"] = pack(MessageType.OBSERVATION, raw, 3)
    return {f"vla_eval_{name}": frame for name, frame in frames.items()}


def act() -> dict[str, bytes]:
    """OpenVLA's request and reply, encoded once and twice."""
    request = json_numpy.dumps(
        {"image": PIXELS, "instruction": INSTRUCTION, "unnorm_key": "b"}
    )
    reply = json_numpy.dumps(CHUNK[0])
    frames = {
        "request": request,
        "request_encoded": json_numpy.dumps({"encoded": request}),
        "reply": reply,
        "reply_encoded": json_numpy.dumps(reply),
        "reply_list": json_numpy.dumps(CHUNK[0].tolist()),
        "error": json_numpy.dumps("error"),
    }
    return {f"act_{name}": f"{text}\n".encode() for name, text in frames.items()}


def main() -> None:
    """Writes one file per frame."""
    folder = Path(sys.argv[1])
    for suffix, frames in [(".msgpack", openpi() | vla_eval()), (".json", act())]:
        for name, frame in frames.items():
            (folder / (name + suffix)).write_bytes(frame)


if __name__ == "__main__":
    main()
