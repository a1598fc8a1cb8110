"""A step's image as the parts of it that changed.

A camera that stands still sees most of its last picture again.
"""

import functools

import numpy as np
from numpy.typing import NDArray

from rever_env.protocol.limits import TILE_SIDE
from rever_env.protocol.observation import Image

_ROW = 3 * TILE_SIDE  # bytes
_TILE = _ROW * TILE_SIDE
Pixels = NDArray[np.uint8]


@functools.lru_cache(maxsize=16)
def _words(height: int, width: int) -> tuple[NDArray[np.uint16], NDArray[np.intp]]:
    """Which tile each word of an image is in, and the words of each tile, (tiles, 96)."""
    rows, across = height // TILE_SIDE, width // TILE_SIDE
    words = np.arange(height * width * 3 // 8).reshape(rows, TILE_SIDE, across, _ROW // 8)
    of_tiles = words.swapaxes(1, 2).reshape(rows * across, -1).astype(np.intp)
    tile_of = np.empty(words.size, np.uint16)
    tile_of[of_tiles] = np.arange(len(of_tiles), dtype=np.uint16)[:, np.newaxis]
    return tile_of, of_tiles


def changes(last: Pixels, image: Pixels) -> tuple[tuple[int, ...], bytes] | None:
    """The tiles in which image differs from last, ascending, and their pixels.

    Both uint8 (height, width, 3), contiguous. None where the whole image is to be sent: another
    size, a side that is no multiple of a tile's, or more than half of it is new.
    """
    height, width, _ = image.shape
    if image.shape != last.shape or height % TILE_SIDE or width % TILE_SIDE or not image.size:
        return None
    tile_of, of_tiles = _words(height, width)
    # By words of 64 bits, and in few calls: right after a control step each one costs as much as
    # what it does.
    words = image.reshape(-1).view(np.uint64)
    differs = np.zeros(len(of_tiles), np.bool_)
    differs[tile_of[(words != last.reshape(-1).view(np.uint64)).nonzero()[0]]] = True
    numbers = differs.nonzero()[0]
    if 2 * len(numbers) > len(of_tiles):
        return None
    return tuple(numbers.tolist()), words[of_tiles[numbers]].tobytes()


def complete(image: Image, tiles: tuple[int, ...], last: Image) -> Image:
    """image with all its pixels, where a valid Stepped had those of these tiles only."""
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
    """Tiles' numbers and bytes that fit the size."""
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
    """The same bytes as (rows of tiles, rows of a tile, columns of tiles, bytes of such a row)."""
    height, width, _ = image.shape
    return image.reshape(height // TILE_SIDE, TILE_SIDE, width // TILE_SIDE, _ROW)
