"""Types of command-line arguments: each parses a value or says what was expected."""

import argparse
import json
from typing import Any

from rever_env import endpoint as endpoints
from rever_env.protocol import Keys, limits


def count(text: str) -> int:
    """A positive whole number."""
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"expected a positive whole number, got {text}")
    return int(text)


def json_object(text: str) -> dict[str, Any]:
    """A JSON object."""
    try:
        value = json.loads(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"expected a JSON object, got {text}: {error}") from error
    if not isinstance(value, dict):
        raise argparse.ArgumentTypeError(f"expected a JSON object, got {text}")
    return value


def endpoint(text: str) -> str:
    """A zenoh endpoint; HOST:PORT means tcp/HOST:PORT."""
    try:
        return endpoints.checked(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def fleet(text: str) -> str:
    """A name that is valid in zenoh keys."""
    try:
        Keys(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def session_count(text: str) -> int:
    """A number of sessions that the protocol allows."""
    if not text.isdecimal() or not 1 <= int(text) <= limits.SESSIONS_MAX:
        raise argparse.ArgumentTypeError(f"expected 1 to {limits.SESSIONS_MAX}, got {text}")
    return int(text)
