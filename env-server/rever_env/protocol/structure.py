"""The structure of raw MessagePack bytes, checked before anything is decoded from them."""

from rever_env.protocol.limits import DEPTH_MAX, ELEMENTS_MAX


class StructureError(ValueError):
    """The bytes are not one value of the allowed types in their shortest form."""


def check(data: bytes) -> None:
    """Accepts exactly one value: maps with text keys, arrays, text, bytes, unsigned integers,

    32-bit floats, booleans and nil, each in its shortest form, nested and counted within limits.
    """
    end = _value(data, 0, 1)
    if end != len(data):
        raise StructureError(f"expected the end after byte {end}, got {len(data) - end} more bytes")


def _value(data: bytes, start: int, depth: int) -> int:
    """Checks the value at start; returns where it ends."""
    if depth > DEPTH_MAX:
        raise StructureError(f"maps and arrays are nested deeper than {DEPTH_MAX}")
    if start >= len(data):
        raise _ended(data)
    marker = data[start]
    after = start + 1
    if marker <= 0x7F or marker >= 0xE0 or marker in (0xC0, 0xC2, 0xC3):
        return after
    if marker <= 0x8F:
        return _map(data, after, marker & 0x0F, depth)
    if marker <= 0x9F:
        return _array(data, after, marker & 0x0F, depth)
    if marker <= 0xBF:
        return _skip(data, after, marker & 0x1F)
    if marker == 0xCA:
        return _skip(data, after, 4)
    if 0xCC <= marker <= 0xCF:
        width = 1 << (marker - 0xCC)
        least = (0x80, 0x100, 0x1_0000, 0x1_0000_0000)[marker - 0xCC]
        return _number(data, after, width, least)[1]
    if 0xC4 <= marker <= 0xC6:
        length, after = _number(data, after, 1 << (marker - 0xC4), (0, 256, 65536)[marker - 0xC4])
        return _skip(data, after, length)
    if 0xD9 <= marker <= 0xDB:
        length, after = _number(data, after, 1 << (marker - 0xD9), (32, 256, 65536)[marker - 0xD9])
        return _skip(data, after, length)
    if marker in (0xDC, 0xDD):
        length, after = _number(data, after, 2 << (marker - 0xDC), (16, 65536)[marker - 0xDC])
        return _array(data, after, length, depth)
    if marker in (0xDE, 0xDF):
        length, after = _number(data, after, 2 << (marker - 0xDE), (16, 65536)[marker - 0xDE])
        return _map(data, after, length, depth)
    raise StructureError(_forbidden(marker, start))


def _array(data: bytes, position: int, length: int, depth: int) -> int:
    _check_elements(length)
    for _ in range(length):
        position = _value(data, position, depth + 1)
    return position


def _map(data: bytes, position: int, length: int, depth: int) -> int:
    _check_elements(length)
    for _ in range(length):
        if position < len(data) and not (
            0xA0 <= data[position] <= 0xBF or 0xD9 <= data[position] <= 0xDB
        ):
            raise StructureError(
                f"expected text as a map's key, got another type at byte {position}"
            )
        position = _value(data, position, depth + 1)
        position = _value(data, position, depth + 1)
    return position


def _number(data: bytes, position: int, width: int, least: int) -> tuple[int, int]:
    """The big-endian number behind a marker and where it ends."""
    end = _skip(data, position, width)
    number = int.from_bytes(data[position:end], "big")
    if number < least:
        raise StructureError(
            f"expected the shortest form of a value, got a longer one at byte {position - 1}"
        )
    return number, end


def _skip(data: bytes, position: int, length: int) -> int:
    if length > len(data) - position:
        raise _ended(data)
    return position + length


def _check_elements(length: int) -> None:
    if length > ELEMENTS_MAX:
        raise StructureError(f"expected at most {ELEMENTS_MAX} elements, got {length}")


def _ended(data: bytes) -> StructureError:
    return StructureError(f"expected more bytes, got the end after byte {len(data)}")


def _forbidden(marker: int, start: int) -> str:
    if marker == 0xCB:
        return f"expected 32-bit floats, got a 64-bit float at byte {start}"
    if 0xD0 <= marker <= 0xD3:
        return f"expected unsigned integers, got a signed one at byte {start}"
    return f"expected no reserved or extension type, got {marker:#04x} at byte {start}"
