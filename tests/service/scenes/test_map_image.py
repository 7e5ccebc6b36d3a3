"""The map for watchers."""

import io

import numpy as np
import pytest
from PIL import Image

from model.arrays import Bytes
from model.scenes.raster import reduced
from model.scenes.scene import Raster
from service.scenes.map_image import MAX_PIXELS, scene_map


def layers(rows: int, columns: int) -> Bytes:
    made: Bytes = np.random.default_rng(3).integers(0, 2, (3, rows, columns)).astype(np.uint8)
    return made


def test_pixels_are_layer_bits_and_colours_are_layers() -> None:
    raster = Raster(layers(7, 11), np.array([-3.0, 5.0]), 2.0)
    shown = scene_map(raster, b"digest")
    assert (shown.width, shown.height, shown.digest) == (11, 7, b"digest")
    assert (shown.origin_x, shown.origin_y, shown.pixels_per_meter) == (-3.0, 5.0, 2.0)
    picture = Image.open(io.BytesIO(shown.image))
    assert picture.mode == "P"
    index = np.asarray(picture)
    for layer in range(3):
        np.testing.assert_array_equal(index >> layer & 1, raster.layers[layer])
    colours = np.asarray(picture.convert("RGB")).transpose(2, 0, 1)
    np.testing.assert_array_equal(colours, 255 * raster.layers)


def test_a_large_raster_is_made_coarser_and_stays_where_it_is() -> None:
    large: Bytes = np.zeros((3, 2100, 1030), dtype=np.uint8)
    large[1, 2001, 7] = 1  # a divider one pixel wide
    shown = scene_map(Raster(large, np.array([10.0, 20.0]), 4.0), b"")
    assert shown.width * shown.height <= MAX_PIXELS
    index = np.asarray(Image.open(io.BytesIO(shown.image)))
    [row], [column] = np.nonzero(index == 2)
    x = shown.origin_x + row / shown.pixels_per_meter
    y = shown.origin_y + column / shown.pixels_per_meter
    assert (x, y) == pytest.approx((10.0 + 2001 / 4.0, 20.0 + 7 / 4.0), abs=0.5 / shown.pixels_per_meter)


def test_reduced_layers_keep_what_is_set() -> None:
    given = layers(5, 9)
    smaller, step = reduced(given, 15)
    assert step == 2
    for i, j in np.ndindex(smaller.shape[1:]):
        block = given[:, 2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
        np.testing.assert_array_equal(smaller[:, i, j], block.max(axis=(1, 2)))
    same, one = reduced(given, 45)
    assert (one, same is given) == (1, True)
