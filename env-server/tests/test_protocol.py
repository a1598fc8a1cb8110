"""The protocol against the golden bytes that the Rust crate wrote."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from rever_env import protocol
from rever_env.protocol import Keys

GOLDEN = Path(__file__).resolve().parents[2] / "protocol" / "golden"
REFUSED: dict[str, dict[str, str]] = json.loads((GOLDEN / "refused" / "index.json").read_text())
OTHER_FORMS: dict[str, str] = json.loads((GOLDEN / "other_forms" / "index.json").read_text())
CODECS: dict[str, protocol.Codec[Any]] = {
    "description": protocol.DESCRIPTION,
    "heartbeat": protocol.HEARTBEAT,
    "open": protocol.OPEN,
    "opening": protocol.OPENING,
    "outcome": protocol.OUTCOME,
    "reply": protocol.REPLY,
    "request": protocol.REQUEST,
    "verifier_update": protocol.VERIFIER_UPDATE,
}
SPOON = "widowx_spoon_on_towel"
OBSERVATION = protocol.Observation(
    image=protocol.Image(2, 3, bytes(index * 14 for index in range(18))),
    state=(0.25, -0.125, 0.5, 0.0, -1.5, 3.0, 0.0, 1.0),
    instruction="put the spoon on the towel",
    expert_action=None,
)
STATE_OF = (
    protocol.Dimension("x", -2.0, 2.0, False),
    protocol.Dimension("height", -0.0, None, False),
)
ACTION_OF = (
    protocol.Dimension("x", -0.5, 0.5, False),
    protocol.Dimension("gripper", -1.0, 1.0, True),
)
ACTION = (0.015625, -0.0078125, 0.0, 0.0, 0.0, 0.25, -1.0)
STATISTICS = protocol.Statistics(False, False, True, False, True, False, False, False, False)
TRANSITION = protocol.Transition(
    dataclasses.replace(OBSERVATION, expert_action=ACTION), STATISTICS, 0.0, False, True
)
OBSERVATION_OF_TILES = dataclasses.replace(
    OBSERVATION, image=protocol.Image(16, 48, bytes(index % 251 for index in range(768)))
)
EXAMPLES: dict[str, Any] = {
    "description": protocol.Description(
        protocol=protocol.PROTOCOL_VERSION,
        server="0123456789abcdef",
        simulator="rever_env",
        simulator_version="0.0.0 mujoco 3.8.0",
        tasks=(
            protocol.TaskDescription(
                SPOON, "default", 1, "put the spoon on the towel", 60, 5.0, 24, STATE_OF, ACTION_OF
            ),
            protocol.TaskDescription(
                "widowx_put_eggplant_in_basket",
                "default",
                1,
                "put eggplant into yellow basket",
                120,
                None,
                24,
                STATE_OF,
                ACTION_OF,
            ),
        ),
        image_side_max=1024,
        sessions=3,
        sessions_max=16,
        slots_max=16,
    ),
    "heartbeat": protocol.Heartbeat("0123456789abcdef", 3, 70_000, 5_000_000_000),
    "open": protocol.Open(protocol.PROTOCOL_VERSION, SPOON, "default", 128, 128, True, "agent"),
    "opening_opened": protocol.Opened("fedcba9876543210"),
    "opening_refused": protocol.OpenRefused("all 16 sessions are in use"),
    "request_reset": protocol.Reset(1, SPOON, "default", 23, 7),
    "request_reset_random": protocol.Reset(300, SPOON, "default", None, (1 << 53) - 1),
    "request_step": protocol.Step(2, ACTION),
    "request_save": protocol.Save(3, 0),
    "request_restore": protocol.Restore(70_000, 15),
    "request_close": protocol.Close(5_000_000_000),
    "reply_observed": protocol.Observed(1, OBSERVATION),
    "reply_stepped": protocol.Stepped(2, TRANSITION, None, 4250),
    "reply_saved": protocol.Saved(3),
    "reply_restored": protocol.Restored(4, OBSERVATION),
    "reply_closed": protocol.Closed(5),
    "reply_refused": protocol.Refused(6, "slot 3 holds no state"),
    "reply_faulted": protocol.Faulted(
        7, protocol.FaultKind.PHYSICS_DIVERGED, "expected finite speeds up to 100, got 250"
    ),
    "reply_stepped_tiles": protocol.Stepped(
        8,
        dataclasses.replace(TRANSITION, observation=OBSERVATION_OF_TILES),
        (1,),
        70_000,
    ),
    "outcome": protocol.EpisodeOutcome(
        run="evaluation-7",
        task=SPOON,
        variant="default",
        layout=None,
        seed=3_000_000_000,
        episode=12,
        strategy="verifier",
        candidates=5,
        temperature=0.75,
        policy="00ff" * 16,
        verifier="ff00" * 16,
        statistics=STATISTICS,
        steps=60,
        score_mean=0.625,
        simulator="rever_env 0.0.0 mujoco 3.8.0",
    ),
    "verifier_update": protocol.VerifierUpdate(
        "default", "0a" * 32, "00ff" * 16, bytes(range(256))
    ),
}


def codec_of(name: str) -> protocol.Codec[Any]:
    """The codec for an example's name, which begins with its message's."""
    return CODECS[name] if name in CODECS else CODECS[name.split("_")[0]]


def _seeing(**fields: Any) -> protocol.Stepped:
    observation = dataclasses.replace(OBSERVATION, **fields)
    transition = dataclasses.replace(TRANSITION, observation=observation)
    return protocol.Stepped(2, transition, None, 0)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (_seeing(state=(0.0, float("nan"))), "state: expected finite numbers, got nan at index 1"),
        (_seeing(state=(float("inf"), -float("inf"))), "state: expected finite numbers, got inf"),
        (_seeing(expert_action=(float("inf"),)), "expert_action: expected finite numbers"),
        (_seeing(expert_action=()), "expert_action: expected 1 to 128 numbers, got 0"),
        (_seeing(state=(0.0,) * 4097), "state: expected 0 to 4096 numbers, got 4097"),
        (_seeing(instruction="x" * 1025), "instruction: expected at most 1024 bytes, got 1025"),
        (
            _seeing(image=protocol.Image(1025, 1, bytes(3075))),
            "image height: expected 1 to 1024, got 1025",
        ),
        (
            _seeing(image=protocol.Image(1, 1025, bytes(3075))),
            "image width: expected 1 to 1024, got 1025",
        ),
        (
            dataclasses.replace(
                EXAMPLES["reply_stepped"],
                transition=dataclasses.replace(TRANSITION, reward=float("nan")),
            ),
            "reward: expected finite numbers, got nan",
        ),
        (
            dataclasses.replace(
                EXAMPLES["reply_stepped"],
                transition=dataclasses.replace(TRANSITION, reward=-3.5e38),
            ),
            "reward: expected 32-bit numbers, got -3.5e[+]38 at index 0",
        ),
    ],
)
def test_an_invalid_reply_is_not_written(message: protocol.Stepped, words: str) -> None:
    with pytest.raises(protocol.CodecError, match=words):
        protocol.REPLY.encode(message)


def test_there_is_an_example_for_each_golden_file() -> None:
    assert {file.stem for file in GOLDEN.glob("*.msgpack")} == EXAMPLES.keys()
    assert {file.stem for file in GOLDEN.glob("refused/*.msgpack")} == REFUSED.keys()
    assert {file.stem for file in GOLDEN.glob("other_forms/*.msgpack")} == OTHER_FORMS.keys()


@pytest.mark.parametrize("name", EXAMPLES)
def test_golden_bytes_are_written_and_read(name: str) -> None:
    golden = (GOLDEN / f"{name}.msgpack").read_bytes()
    codec = codec_of(name)
    assert codec.encode(EXAMPLES[name]) == golden
    assert codec.decode(golden) == EXAMPLES[name]


@pytest.mark.parametrize("name", EXAMPLES)
def test_part_of_a_message_and_more_than_it_are_refused(name: str) -> None:
    golden = (GOLDEN / f"{name}.msgpack").read_bytes()
    codec = codec_of(name)
    for length in range(len(golden)):
        with pytest.raises(protocol.Malformed):
            codec.decode(golden[:length])
    with pytest.raises(protocol.CodecError):
        codec.decode(golden + b"\xc0")


@pytest.mark.parametrize("name", REFUSED)
def test_malformed_bytes_are_refused_in_the_same_words(name: str) -> None:
    data = (GOLDEN / "refused" / f"{name}.msgpack").read_bytes()
    with pytest.raises(protocol.CodecError) as refusal:
        CODECS[REFUSED[name]["message"]].decode(data)
    assert REFUSED[name]["words"] in str(refusal.value)


@pytest.mark.parametrize("name", OTHER_FORMS)
def test_other_forms_of_a_message_are_read_as_the_message(name: str) -> None:
    data = (GOLDEN / "other_forms" / f"{name}.msgpack").read_bytes()
    example = OTHER_FORMS[name]
    assert codec_of(example).decode(data) == EXAMPLES[example]


@pytest.mark.parametrize("name", [name for name in EXAMPLES if name.startswith("request")])
def test_flipped_bytes_are_refused_or_read_as_a_valid_message(name: str) -> None:
    golden = (GOLDEN / f"{name}.msgpack").read_bytes()
    for position in range(len(golden)):
        for byte in range(0, 256, 5):
            data = bytearray(golden)
            data[position] = byte
            try:
                message = protocol.REQUEST.decode(bytes(data))
            except protocol.CodecError:
                continue
            assert protocol.REQUEST.decode(protocol.REQUEST.encode(message)) == message


@pytest.mark.parametrize(
    ("tasks", "letters"), [(15, 31), (16, 32), (255, 255), (256, 256), (290, 600)]
)
def test_lists_and_texts_of_every_header_are_read(tasks: int, letters: int) -> None:
    description = EXAMPLES["description"]
    task = dataclasses.replace(description.tasks[0], instruction="a" * letters)
    long = dataclasses.replace(description, tasks=(task,) * tasks)
    assert protocol.DESCRIPTION.decode(protocol.DESCRIPTION.encode(long)) == long


def test_an_invalid_message_is_not_written() -> None:
    with pytest.raises(protocol.Invalid, match="expected finite numbers, got nan at index 0"):
        protocol.REQUEST.encode(protocol.Step(1, (float("nan"),) * 7))
    with pytest.raises(protocol.Invalid, match="holder: expected 1 to 128 bytes, got 129"):
        protocol.OPEN.encode(dataclasses.replace(EXAMPLES["open"], holder="a" * 129))


def test_an_invalid_request_tells_its_number() -> None:
    data = (GOLDEN / "refused" / "nan.msgpack").read_bytes()
    with pytest.raises(protocol.Invalid) as refusal:
        protocol.REQUEST.decode(data)
    assert refusal.value.message.sequence == 2


def test_keys_lie_under_version_and_fleet() -> None:
    keys = Keys("home")
    assert keys.server("s1") == "rever/3/home/server/s1"
    assert keys.describe("s1") == "rever/3/home/server/s1/describe"
    assert keys.open("s1") == "rever/3/home/server/s1/open"
    assert keys.heartbeat("s1") == "rever/3/home/server/s1/heartbeat"
    assert keys.session("a") == "rever/3/home/session/a"
    assert keys.request("a") == "rever/3/home/session/a/request"
    assert keys.reply("a") == "rever/3/home/session/a/reply"
    assert keys.outcome("run.1") == "rever/3/home/outcome/run.1"
    assert keys.verifier("best_of-2") == "rever/3/home/verifier/best_of-2"


@pytest.mark.parametrize("name", ["", "*", "**", "a/b", "a b", "$*", "a?b", "ä", "a" * 65, "a\n"])
def test_a_name_with_wildcards_or_slashes_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"invalid fleet name"):
        Keys(name)


def test_a_peers_text_is_harmless_in_a_terminal() -> None:
    assert protocol.printable("gone\x1b[31m\r\n\x9b2J é") == "gone\ufffd[31m\ufffd\ufffd\ufffd2J é"
