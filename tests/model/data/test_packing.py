"""Rasters in one flat array."""

import numpy as np
import pytest
import torch

from model.data.packing import pack, pack_patches, unpack, unpack_patches
from tests.model.data.records import raster


@pytest.mark.parametrize(("rows", "columns"), [(7, 5), (1, 1), (40, 63)])
def test_what_is_packed_comes_out_again(rows: int, columns: int) -> None:
    scene = raster(rows, columns)
    packed = pack(scene)
    assert packed.dtype == np.uint8
    assert packed.shape == ((rows + 2) * (columns + 2),)
    np.testing.assert_array_equal(unpack(packed, rows, columns), scene.layers)


def test_the_border_is_empty() -> None:
    scene = raster(6, 4)
    scene.layers[:] = 1
    square = pack(scene).reshape(8, 6)
    assert (square[1:-1, 1:-1] == 7).all()
    assert square.sum() == 7 * 24


def test_patches_come_out_within_a_sixth_of_a_layer_and_unknown_as_zero() -> None:
    rng = np.random.default_rng(0)
    patches = rng.random((3, 3, 20, 20)).astype(np.float32)
    patches[1, :, 5:] = 0.5  # nothing is known there
    packed = pack_patches(patches)
    assert packed.shape == (3, 20, 20)
    assert packed.dtype == np.uint8
    layers = unpack_patches(torch.from_numpy(packed))
    assert layers.shape == patches.shape
    assert (layers[1, :, 5:] == 0).all()
    np.testing.assert_allclose(layers[0], 2 * patches[0] - 1, atol=1 / 3 + 1e-6)
    binary = (patches > 0.5).astype(np.float32)
    np.testing.assert_array_equal(unpack_patches(torch.from_numpy(pack_patches(binary))), 2 * binary - 1)
