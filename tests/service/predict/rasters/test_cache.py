"""Kept rasters stay within their budget, whatever is put and used."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from model.scenes.scene import Raster
from service.predict.rasters.cache import KeptRaster, RasterCache

BUDGET = 3 * 100


def kept(pixels: int) -> KeptRaster:
    return KeptRaster(Raster(np.zeros((3, 1, pixels), dtype=np.uint8), np.zeros(2), 1.0), 0.0)


def test_the_least_recently_used_are_dropped() -> None:
    cache = RasterCache(BUDGET)
    assert [cache.put(name, kept(40)) for name in (b"a", b"b")] == [0, 0]
    assert cache.get(b"a") is not None
    assert cache.put(b"c", kept(40)) == 1
    assert cache.get(b"b") is None
    assert cache.get(b"a") is not None
    assert cache.put(b"d", kept(100)) == 2
    assert (len(cache), cache.size) == (1, BUDGET)


def test_one_beyond_the_budget_drops_nothing() -> None:
    cache = RasterCache(BUDGET)
    cache.put(b"a", kept(40))
    assert cache.put(b"b", kept(101)) == 0
    assert cache.get(b"b") is None
    assert cache.get(b"a") is not None


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(1, 120), st.booleans()), max_size=60))
def test_the_size_is_that_of_the_rasters(steps: list[tuple[int, int, bool]]) -> None:
    cache, model = RasterCache(BUDGET), dict[bytes, int]()
    for name, pixels, use in steps:
        digest = bytes([name])
        if use:
            assert (cache.get(digest) is not None) == (digest in model)
            if digest in model:
                model[digest] = model.pop(digest)
        else:
            if digest not in model and pixels <= 100:
                model[digest] = 3 * pixels
            while sum(model.values()) > BUDGET:
                model.pop(next(iter(model)))
            cache.put(digest, kept(pixels))
        assert (len(cache), cache.size) == (len(model), sum(model.values()))
        assert cache.size <= BUDGET
