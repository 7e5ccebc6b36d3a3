"""Rasters in one flat array."""

import numpy as np
import pytest

from model.data.packing import pack, unpack
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
