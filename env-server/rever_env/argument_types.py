"""Types of command-line arguments, which refuse a value in words."""

import argparse
import json
from typing import Any

from rever_env import endpoint as endpoints
from rever_env.protocol import Keys, limits


def count(text: str) -> int:
    """A whole number from 1."""
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1, got {text}")
    return int(text)


def json_object(text: str) -> dict[str, Any]:
    """An object in JSON."""
    try:
        value = json.loads(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"expected a JSON object, got {text}: {error}") from error
    if not isinstance(value, dict):
        raise argparse.ArgumentTypeError(f"expected a JSON object, got {text}")
    return value


def endpoint(text: str) -> str:
    """An endpoint of zenoh; HOST:PORT is tcp/HOST:PORT."""
    try:
        return endpoints.checked(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def fleet(text: str) -> str:
    """A name that may stand in keys."""
    try:
        Keys(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def session_count(text: str) -> int:
    """As many sessions as the protocol has room for."""
    if not text.isdecimal() or not 1 <= int(text) <= limits.SESSIONS_MAX:
        raise argparse.ArgumentTypeError(f"expected 1 to {limits.SESSIONS_MAX}, got {text}")
    return int(text)
