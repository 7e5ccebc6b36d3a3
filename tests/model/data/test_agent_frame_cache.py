"""Caches and batches in the agents' frames, with variants and over several sources."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from model.data.batches import Batches, JoinedPairs
from model.data.cache import Cache
from model.data.cache_builder import build_cache, open_cache
from model.data.packing import unpack_patches
from model.data.protocols import frame_scene
from model.data.scenes import DataError, Pair, SceneRecord, Track
from model.features.agent_features import agent_frame_features
from model.features.spec import Frame
from model.forecaster import Context, Protocol
from model.networks.config import NetworkConfig
from model.scenes.scene import AgentType
from tests.model.data.records import FixedReader, record

CONFIG = NetworkConfig(frame=Frame.AGENT, far_map=True)
NO_CONTEXT = NetworkConfig(frame=Frame.AGENT, neighbor_types=(), uses_map=False)
VARIANTS = 2
ROWS = 1 + VARIANTS
CPU = torch.device("cpu")
RECORDS = (record("scene-1", seed=1), record("scene-2", seed=2, vehicles=3))


def made(folder: Path, variants: int = VARIANTS, records: Sequence[SceneRecord] = RECORDS) -> Cache:
    build_cache(
        FixedReader(*records), "some", Protocol.CAUSAL, CONFIG, 5, folder / "cache", variants=variants
    )
    return Cache.open(folder / "cache")


def test_the_first_row_of_a_pair_is_what_serving_makes_of_it(tmp_path: Path) -> None:
    cache = made(tmp_path)
    batches = Batches(cache, CPU, CONFIG)
    assert len(batches) == sum(len(one.pairs) for one in RECORDS)
    assert len(cache) == ROWS * len(batches)
    pairs = [(whole, pair) for whole in RECORDS for pair in whole.pairs]
    for number in range(0, len(pairs), 7):
        whole, pair = pairs[number]
        scene, tracks = frame_scene(whole, pair.frame, Protocol.CAUSAL, 5)
        target = np.flatnonzero(tracks == pair.track)
        wanted = agent_frame_features(scene, target, CONFIG.features, Context.FULL)
        got, _ = batches.features(torch.tensor([ROWS * number]))
        assert got.keys() == wanted.keys()
        for name, values in wanted.items():
            np.testing.assert_allclose(got[name], values, atol=1e-6, err_msg=name)


def test_every_row_of_a_pair_ends_where_the_agent_went(tmp_path: Path) -> None:
    cache = made(tmp_path)
    rows = 0
    for whole in RECORDS:
        for pair in whole.pairs:
            one = whole.tracks[pair.track]
            now = int(np.searchsorted(one.frames, pair.frame))
            for row in range(rows, rows + ROWS):
                assert (cache.track[row], cache.frame[row]) == (pair.track, pair.frame)
                went = cache.position[row] + cache.future[row]
                np.testing.assert_allclose(went, one.position[now + 1 : now + 13], atol=1e-3)
            noisy = np.abs(cache.position[rows + 1 : rows + ROWS] - one.position[now]).max()
            assert noisy < 2
            rows += ROWS
    assert np.ptp(cache.position.reshape(-1, ROWS, 2), axis=1).max() > 0.01


def test_a_batch_draws_among_the_rows_of_its_pairs(tmp_path: Path) -> None:
    batches = Batches(made(tmp_path), CPU, CONFIG)
    torch.manual_seed(0)
    seen = {batches.batch(torch.tensor([3]))[0]["origin"].numpy().tobytes() for _ in range(30)}
    rows = {
        batches.features(torch.tensor([3 * ROWS + k]))[0]["origin"].numpy().tobytes() for k in range(ROWS)
    }
    assert seen == rows
    torch.manual_seed(5)
    one, _ = batches.batch(torch.arange(8))
    torch.manual_seed(5)
    again, _ = batches.batch(torch.arange(8))
    assert torch.equal(one["origin"], again["origin"])


def test_who_stood_and_leaves_is_known_from_the_whole_pair(tmp_path: Path) -> None:
    """Tracks asked about at frame 4 that are seen since a frame, stand until another, and then drive."""
    made_up = [(0, 99), (0, 14), (0, 6), (3, 99), (3, 6), (0, 2)]
    tracks = []
    for number, (seen, until) in enumerate(made_up):
        frames = np.arange(seen, 17)
        x = 2.0 * np.maximum(frames - until, 0)
        position = np.stack([x, np.full(len(frames), 10.0 * number)], axis=1)
        tracks.append(Track(str(number), AgentType.VEHICLE, frames, position, np.zeros(len(frames))))
    pairs = [Pair(number, 4) for number in range(len(tracks))]
    one = replace(RECORDS[0], tracks=tracks, pairs=pairs)
    for variants in (0, VARIANTS):
        batches = Batches(made(tmp_path / str(variants), variants, (one,)), CPU, CONFIG)
        assert batches.leaving.tolist() == [False, True, True, False, True, False]


def test_sources_are_joined_in_the_order_that_is_asked(tmp_path: Path) -> None:
    first = Batches(made(tmp_path / "a", variants=0, records=RECORDS[:1]), CPU, CONFIG, packed_maps=True)
    second = Batches(made(tmp_path / "b", variants=0, records=RECORDS[1:]), CPU, CONFIG, packed_maps=True)
    joined = JoinedPairs([first, second])
    count = len(first)
    assert len(joined) == count + len(second)
    indices = torch.tensor([count + 1, 0, count, 2])
    features, future = joined.batch(indices)
    for row, (source, index) in enumerate([(second, 1), (first, 0), (second, 0), (first, 2)]):
        own, its_future = source.features(torch.tensor([index]))
        for name, values in own.items():
            assert torch.equal(features[name][row], values[0]), name
        assert torch.equal(future[row], its_future[0])
    assert torch.equal(joined.turned, torch.cat([first.turned, second.turned]))
    assert joined.paths.shape == (len(joined), 12, 2)
    assert joined.leaving.shape == (len(joined),)


def test_packed_maps_are_rounded(tmp_path: Path) -> None:
    cache = made(tmp_path, variants=0)
    packed, whole = (Batches(cache, CPU, CONFIG, packed_maps=one) for one in (True, False))
    some = torch.arange(4)
    for name in ("map", "far_map"):
        left, exact = packed.features(some)[0][name], whole.features(some)[0][name]
        assert left.dtype is torch.uint8
        assert exact.is_contiguous(memory_format=torch.channels_last)
        np.testing.assert_allclose(unpack_patches(left), exact, atol=1 / 3 + 1e-3)


def test_a_network_without_context_takes_less_of_the_same_cache(tmp_path: Path) -> None:
    features, _ = Batches(made(tmp_path), CPU, NO_CONTEXT).batch(torch.arange(3))
    assert features.keys() == {"origin", "heading", "speed", "history", "first"}
    said: list[str] = []
    reader = FixedReader(*RECORDS)
    for config in (CONFIG, NO_CONTEXT):
        open_cache(tmp_path / "shared", reader, "made", "some", Protocol.CAUSAL, config, 5, said.append, 1)
    assert len(said) == 2  # begun and finished, once


def test_a_network_of_the_other_frame_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="agents' own frames"):
        Batches(made(tmp_path), CPU, NetworkConfig())
