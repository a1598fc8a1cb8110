"""A picture's way as tiles: what changed, and nothing else."""

import numpy as np
import pytest

from rever_env import protocol
from rever_env.protocol import tiles
from rever_env.protocol.tiles import Pixels


def picture(height: int = 32, width: int = 48) -> Pixels:
    pixels: Pixels = (np.arange(3 * height * width) % 251).astype(np.uint8)
    return np.reshape(pixels, (height, width, 3))


def altered(image: Pixels, *places: int) -> Pixels:
    pixels: Pixels = image.copy()
    for place in places:
        pixels.reshape(-1)[place] ^= 0x80
    return pixels


def whole(image: Pixels) -> protocol.Image:
    return protocol.Image(image.shape[0], image.shape[1], image.tobytes())


def sent(last: Pixels, image: Pixels) -> tuple[tuple[int, ...], int]:
    """Tiles and bytes; whoever gets them sees the image."""
    found = tiles.changes(last, image)
    assert found is not None
    numbers, pixels = found
    parts = protocol.Image(image.shape[0], image.shape[1], pixels)
    tiles.validate(parts, numbers)
    assert tiles.complete(parts, numbers, whole(last)) == whole(image)
    return numbers, len(pixels)


def test_changed_tiles_make_the_picture_whole_again() -> None:
    last = picture()
    # Rows of 144 bytes, of which a tile has 48: the corners of the tile in the middle above.
    corners = (48, 95, 15 * 144 + 48, 15 * 144 + 95)
    assert sent(last, altered(last, *corners)) == ((1,), 768)
    assert sent(last, altered(last, *corners, 32 * 144 - 49)) == ((1, 4), 2 * 768)
    for place in range(last.size):
        tile = place // 144 // 16 * 3 + place % 144 // 48
        assert sent(last, altered(last, place)) == ((tile,), 768), place
    assert sent(last, last) == ((), 0)


def test_the_tiles_are_a_box_around_what_changed() -> None:
    last = picture(48, 64)  # of 3 x 4 tiles, rows of 192 bytes
    far_apart = altered(last, 191, 16 * 192 + 96, 17 * 192 + 95)  # in the tiles 3, 6 and 5
    assert sent(last, far_apart) == ((1, 2, 3, 5, 6, 7), 6 * 768)


def test_the_order_of_tiles_is_the_one_of_the_golden_file() -> None:
    last = np.zeros((16, 48, 3), np.uint8)
    image = last.copy()
    image[:, 16:32] = (np.arange(768) % 251).reshape(16, 16, 3)
    found = tiles.changes(last, image)
    assert found == ((1,), bytes(index % 251 for index in range(768)))


@pytest.mark.parametrize(
    ("last", "image"),
    [
        pytest.param(picture(), altered(picture(), 0, 48, 96, 4607), id="more than half is new"),
        pytest.param(picture(), picture(48, 32), id="another size"),
        pytest.param(picture(15), picture(15), id="a side is cut"),
        pytest.param(picture(0, 0), picture(0, 0), id="no picture"),
    ],
)
def test_a_picture_is_whole_where_tiles_would_not_do(last: Pixels, image: Pixels) -> None:
    assert tiles.changes(last, image) is None


def test_half_of_the_tiles_may_change() -> None:
    assert sent(picture(), altered(picture(), 0, 48, 96))[0] == (0, 1, 2)


def test_tiles_of_another_picture_are_refused() -> None:
    with pytest.raises(ValueError, match="expected an image of 48 x 32 pixels as before, got 32 x"):
        tiles.complete(protocol.Image(32, 48, b""), (), whole(picture(48, 32)))
