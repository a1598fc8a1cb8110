"""Strict encoding and decoding of messages: unknown fields and trailing bytes are errors.

A message is a frozen dataclass with a method validate; its annotations define the wire types. int:
unsigned, 64 bits unless annotated; float: 32 bits. Entries of a map are written in the order of the
dataclass and read in any order.
"""

import array
import dataclasses
import enum
import math
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, Generic, Protocol, TypeVar, Union

import msgpack

from rever_env.protocol import limits

Reader = Callable[[object], Any]
Writer = Callable[[Any], object]


class CodecError(ValueError):
    """A message cannot be encoded or decoded."""


class TooLarge(CodecError):
    """The message exceeds its size limit; nothing was decoded."""


class Malformed(CodecError):
    """The bytes are not a message of this kind."""


class Invalid(CodecError):
    """A value of the message is out of bounds. message: the decoded message, if there is one."""

    def __init__(self, reason: str, message: Any = None) -> None:
        super().__init__(reason)
        self.message = message


@dataclasses.dataclass(frozen=True)
class Bits:
    """Annotation of an int: its width on the wire."""

    count: int


class Message(Protocol):
    """Any message."""

    def validate(self) -> None:
        """Raises a ValueError that names the field, the expected and the actual value."""


M = TypeVar("M", bound=Message)


class Codec(Generic[M]):
    """Encodes and decodes one kind of message, or one of several variants by their names."""

    def __init__(
        self,
        name: str,
        bytes_max: int,
        content: type[M] | Mapping[str, type[M]],
        recognise: Callable[[object], None] | None = None,
    ) -> None:
        self.name = name
        self.bytes_max = bytes_max
        self._recognise = recognise
        self._reader: Reader
        self._writer: Writer
        if isinstance(content, type):
            self._reader, self._writer = _dataclass(content)
        else:
            self._reader, self._writer = _variants(content)

    def encode(self, message: M) -> bytes:
        """The bytes of a message; Invalid for an invalid one, TooLarge beyond the size limit."""
        self._validate(message)
        data: bytes = msgpack.packb(self._writer(message), use_single_float=True)
        self.check_size(len(data))
        return data

    def decode(self, data: bytes) -> M:
        """The message in exactly these bytes; CodecError for any other bytes."""
        self.check_size(len(data))
        try:
            value = msgpack.unpackb(
                data,
                object_pairs_hook=_once,
                max_array_len=limits.ELEMENTS_MAX,
                max_map_len=limits.ELEMENTS_MAX,
            )
        except msgpack.ExtraData as error:
            raise Malformed(
                f"{self.name} cannot be read: expected the end after byte "
                f"{len(data) - len(error.extra)}, got {len(error.extra)} more bytes"
            ) from None
        except UnicodeDecodeError as error:
            raise Malformed(f"{self.name} cannot be read: text is not utf-8: {error}") from None
        except ValueError as error:
            raise Malformed(f"{self.name} cannot be read: {error}") from None
        if self._recognise is not None:
            try:
                self._recognise(value)
            except ValueError as error:
                raise Invalid(f"{self.name} is invalid: {error}") from None
        try:
            message: M = self._reader(value)
        except ValueError as error:
            raise Malformed(f"{self.name} cannot be read: {error}") from None
        self._validate(message)
        return message

    def check_size(self, count: int) -> None:
        """TooLarge if a message of so many bytes exceeds the limit."""
        if count > self.bytes_max:
            raise TooLarge(f"{self.name} has {count} bytes, limit {self.bytes_max}")

    def _validate(self, message: M) -> None:
        try:
            message.validate()
        except ValueError as error:
            raise Invalid(f"{self.name} is invalid: {error}", message) from None


def _once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    entries = dict(pairs)
    if len(entries) != len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"duplicate field `{twice}`")
    return entries


def _variants(content: Mapping[str, type[Any]]) -> tuple[Reader, Writer]:
    readers = {name: _dataclass(variant)[0] for name, variant in content.items()}
    writers = {variant: (name, _dataclass(variant)[1]) for name, variant in content.items()}

    def read(value: object) -> Any:
        if not isinstance(value, dict) or len(value) != 1:
            raise ValueError(f"expected a map of one message, got {_kind(value)}")
        ((name, fields),) = value.items()
        reader = readers.get(name)
        if reader is None:
            raise ValueError(f"unknown variant `{name}`, expected {_choice(list(readers))}")
        return reader(fields)

    def write(message: Any) -> object:
        name, writer = writers[type(message)]
        return {name: writer(message)}

    return read, write


def _dataclass(kind: type[Any]) -> tuple[Reader, Writer]:
    hints = typing.get_type_hints(kind, include_extras=True)
    names = [field.name for field in dataclasses.fields(kind)]
    fields = [(name, *_field(hints[name])) for name in names]
    expected = set(names)
    rewritten = [(name, writer) for name, _, writer in fields if writer is not _as_it_is]

    def read(value: object) -> Any:
        if not isinstance(value, dict):
            raise ValueError(f"invalid type: {_kind(value)}, expected a map")
        if value.keys() != expected:
            for name in value:
                if name not in expected:
                    raise ValueError(f"unknown field `{name}`, expected {_choice(names)}")
            missing = next(name for name in names if name not in value)
            raise ValueError(f"missing field `{missing}`")
        return kind(*[reader(value[name]) for name, reader, _ in fields])

    def write(message: Any) -> object:
        values = vars(message)  # in the order of the fields, because __init__ has set them
        if not rewritten:
            return values
        return values | {name: writer(values[name]) for name, writer in rewritten}

    return read, write


def _as_it_is(value: object) -> object:
    """The value as msgpack encodes it for the protocol."""
    return value


def _field(hint: Any) -> tuple[Reader, Writer]:
    annotations: tuple[object, ...] = ()
    if typing.get_origin(hint) is typing.Annotated:
        annotations = hint.__metadata__
        hint = typing.get_args(hint)[0]
    origin = typing.get_origin(hint)
    if origin in (Union, types.UnionType):
        # Annotated[X, ...] | None keeps its annotation inside.
        (present,) = (part for part in typing.get_args(hint) if part is not type(None))
        reader, writer = _field(present)
        return (
            lambda value: None if value is None else reader(value),
            writer
            if writer is _as_it_is
            else lambda value: None if value is None else writer(value),
        )
    if origin is tuple and typing.get_args(hint)[0] is float:
        return _floats, _as_it_is
    if origin is tuple:
        reader, writer = _field(typing.get_args(hint)[0])
        return _tuple(reader), writer if writer is _as_it_is else _each(writer)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return _dataclass(hint)
    if hint is int:
        bits = next((part.count for part in annotations if isinstance(part, Bits)), 64)
        return _integer(bits), _as_it_is
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return _enumeration(hint), lambda value: value.value
    return (_float if hint is float else _exactly(hint)), _as_it_is


def _integer(bits: int) -> Reader:
    end = 1 << bits

    def read(value: object) -> int:
        if type(value) is not int:
            raise ValueError(f"invalid type: {_kind(value)}, expected u{bits}")
        if not 0 <= value < end:
            raise ValueError(f"invalid value: integer `{value}`, expected u{bits}")
        return value

    return read


def _floats(value: object) -> tuple[float, ...]:
    if type(value) is not list:
        raise ValueError(f"invalid type: {_kind(value)}, expected a sequence")
    for element in value:
        if type(element) is not float:
            raise ValueError(f"invalid type: {_kind(element)}, expected f32")
    # The reader does not tell doubles from floats: a number that needs more than 32 bits was one.
    for number, single in zip(value, array.array("f", value), strict=True):
        if number != single and not math.isnan(number):
            raise ValueError(f"expected 32-bit floats, got {number}")
    return tuple(value)


def _float(value: object) -> float:
    return _floats([value])[0]


def _tuple(reader: Reader) -> Reader:
    def read(value: object) -> tuple[Any, ...]:
        if type(value) is not list:
            raise ValueError(f"invalid type: {_kind(value)}, expected a sequence")
        return tuple(reader(element) for element in value)

    return read


def _each(writer: Writer) -> Writer:
    return lambda value: [writer(element) for element in value]


def _enumeration(kind: type[enum.Enum]) -> Reader:
    members = {member.value: member for member in kind}

    def read(value: object) -> enum.Enum:
        if not isinstance(value, str) or value not in members:
            raise ValueError(f"unknown variant `{value}`, expected {_choice(list(members))}")
        return members[value]

    return read


def _exactly(kind: type[Any]) -> Reader:
    expected = {bool: "a boolean", str: "a string", bytes: "bytes"}[kind]

    def read(value: object) -> Any:
        if type(value) is not kind:
            raise ValueError(f"invalid type: {_kind(value)}, expected {expected}")
        return value

    return read


def _choice(names: list[str]) -> str:
    quoted = [f"`{name}`" for name in names]
    if len(quoted) <= 2:
        return " or ".join(quoted)
    return "one of " + ", ".join(quoted)


def _kind(value: object) -> str:
    if value is None:
        return "nil"
    names = {bool: "boolean", int: "integer", float: "float", str: "string", bytes: "bytes"}
    names.update({list: "sequence", dict: "map"})
    return names.get(type(value), type(value).__name__)
