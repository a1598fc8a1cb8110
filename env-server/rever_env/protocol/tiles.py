"""A step's image as the tiles that changed since the last one.

With a fixed camera most pixels stay the same from step to step.
"""

import functools

import numpy as np
from numpy.typing import NDArray

from rever_env.protocol.limits import TILE_SIDE
from rever_env.protocol.observation import Image

_ROW = 3 * TILE_SIDE  # bytes
_WORDS = _ROW // 8
_TILE = _ROW * TILE_SIDE
Pixels = NDArray[np.uint8]


def changes(last: Pixels, image: Pixels) -> tuple[tuple[int, ...], bytes] | None:
    """The tiles of the box around all changes, in ascending order, and their pixels.

    image, last: uint8 (height, width, 3). None if the whole image must be sent: another size, a
    side that is no multiple of a tile's side, or a box of more than half of the image.
    """
    height, width, _ = image.shape
    if image.shape != last.shape or height % TILE_SIDE or width % TILE_SIDE or not image.size:
        return None
    # Compare words of 64 bits in few numpy calls: right after a control step the overhead of a call
    # is as large as its work. A box has few unchanged tiles and is faster to find than single ones.
    words, before = image.reshape(height, -1).view(np.uint64), last.reshape(height, -1)
    differs = words != before.view(np.uint64)
    flags = differs.tobytes()
    first = flags.find(1)
    if first < 0:
        return (), b""
    columns = np.logical_or.reduce(differs).tobytes()
    across, high = width // TILE_SIDE, TILE_SIDE * len(columns)  # of a row of tiles
    top, bottom = first // high, flags.rfind(1) // high + 1
    left, right = columns.find(1) // _WORDS, columns.rfind(1) // _WORDS + 1
    if 2 * (bottom - top) * (right - left) * TILE_SIDE > across * height:
        return None
    box = _tiles(image)[top:bottom, :, left:right]
    return _numbers(across, top, bottom, left, right), box.swapaxes(1, 2).tobytes()


@functools.lru_cache(maxsize=1024)
def _numbers(across: int, top: int, bottom: int, left: int, right: int) -> tuple[int, ...]:
    return tuple(
        row * across + column for row in range(top, bottom) for column in range(left, right)
    )


def complete(image: Image, tiles: tuple[int, ...], last: Image) -> Image:
    """The whole image: `last` with these tiles replaced. ValueError if they do not fit."""
    expected, got = (last.height, last.width), (image.height, image.width)
    if got != expected:
        raise ValueError(
            f"changed_tiles: expected an image of {expected[0]} x {expected[1]} pixels as before, "
            f"got {got[0]} x {got[1]}"
        )
    whole = np.frombuffer(bytearray(last.pixels), np.uint8).reshape(last.height, last.width, 3)
    row, column = np.divmod(np.array(tiles, np.int64), last.width // TILE_SIDE)
    new = np.frombuffer(image.pixels, np.uint8).reshape(-1, TILE_SIDE, _ROW)
    _tiles(whole)[row, :, column] = new
    return Image(last.height, last.width, whole.tobytes())


def validate(image: Image, tiles: tuple[int, ...]) -> None:
    """ValueError if the numbers or the bytes of the tiles do not fit the image."""
    image.validate_sides()
    count = (image.height // TILE_SIDE) * (image.width // TILE_SIDE)
    if image.height % TILE_SIDE or image.width % TILE_SIDE or not count:
        raise ValueError(
            f"changed_tiles: expected sides that are multiples of {TILE_SIDE}, "
            f"got {image.height} x {image.width}"
        )
    before = -1
    for tile in tiles:
        if tile >= count:
            raise ValueError(f"changed_tiles: expected 0 to {count - 1}, got {tile}")
    for tile in tiles:
        if tile <= before:
            raise ValueError(
                f"changed_tiles: expected ascending numbers, got {before} before {tile}"
            )
        before = tile
    expected = _TILE * len(tiles)
    if len(image.pixels) != expected:
        raise ValueError(
            f"image: expected {expected} bytes for {len(tiles)} tiles, got {len(image.pixels)}"
        )


def _tiles(image: Pixels) -> Pixels:
    """A view as (rows of tiles, rows of a tile, columns of tiles, bytes of a row of a tile)."""
    height, width, _ = image.shape
    return image.reshape(height // TILE_SIDE, TILE_SIDE, width // TILE_SIDE, _ROW)
