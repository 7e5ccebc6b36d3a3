"""Caches of pairs: what is in them, and that only whole and fitting ones are used."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from model.data import cache, cache_builder, synthetic
from model.data.cache import Cache
from model.data.cache_builder import BuildProgress, build_cache, duration_text, open_cache
from model.data.cache_layout import FORMAT_VERSION, CacheKey
from model.data.protocols import frame_scene
from model.data.scenes import DataError, Pair, SceneRecord
from model.data.synthetic import SyntheticReader
from model.features.scene_features import ground_frame_features, network_features
from model.forecaster import Context, Protocol
from model.networks.config import AnyNetworkConfig, BlindContext, CoverNetConfig, NetworkConfig
from model.scenes.scene import AgentType
from tests.model.data.records import FixedReader, raster, record, track

FRAMES = 5
CONFIG = NetworkConfig(uses_map=False)
RECORDS = record("scene-1", seed=1), record("scene-2", seed=2, vehicles=3)
READER = FixedReader(*RECORDS)
KEY = CacheKey.of(READER, "some", Protocol.CAUSAL, CONFIG, FRAMES)


def _build(
    folder: Path,
    reader: FixedReader = READER,
    protocol: Protocol = Protocol.CAUSAL,
    config: AnyNetworkConfig = CONFIG,
) -> None:
    build_cache(reader, "some", protocol, config, FRAMES, folder)


@pytest.mark.parametrize("protocol", list(Protocol))
def test_arrays_are_those_of_the_features(tmp_path: Path, protocol: Protocol) -> None:
    _build(tmp_path / "cache", protocol=protocol)
    cache = Cache.open(tmp_path / "cache")
    assert len(cache) == sum(len(one.pairs) for one in RECORDS)
    assert cache.manifest.scenes == ("scene-1", "scene-2")
    row = 0
    for number, whole in enumerate(RECORDS):
        for pair in whole.pairs:
            scene, tracks = frame_scene(whole, pair.frame, protocol, FRAMES)
            target = np.flatnonzero(tracks == pair.track)
            wanted = ground_frame_features(scene, target, AgentType.VEHICLE, CONFIG.features, Context.FULL)
            np.testing.assert_array_equal(cache.history[row], wanted["history"][0].numpy())
            np.testing.assert_array_equal(cache.first[row], wanted["first"][0].numpy())
            np.testing.assert_array_equal(cache.velocity[row], wanted["velocity"][0].numpy())
            np.testing.assert_array_equal(cache.edge_mask[row], wanted["edge_mask"][0].numpy())
            for kind in CONFIG.neighbor_types:
                expected = wanted[f"neighbors.{kind.value}"][0].numpy()
                np.testing.assert_allclose(cache.neighbors[kind][row], expected, rtol=1e-5, atol=1e-5)
            one = whole.tracks[pair.track]
            now = one.frames.tolist().index(pair.frame)
            np.testing.assert_array_equal(cache.position[row], one.position[now])
            assert cache.heading[row] == pytest.approx(one.heading[now])
            relative = one.position[now + 1 : now + 13] - one.position[now]
            np.testing.assert_allclose(cache.future[row], relative, rtol=1e-6)
            assert (cache.scene[row], cache.track[row], cache.frame[row]) == (number, pair.track, pair.frame)
            assert cache.token[row].decode() == pair.token
            row += 1
    for number, whole in enumerate(RECORDS):
        again = cache.raster(number)
        np.testing.assert_array_equal(again.layers, whole.raster.layers)
        np.testing.assert_array_equal(again.origin, whole.raster.origin)
        assert again.pixels_per_meter == whole.raster.pixels_per_meter


def test_turn_is_the_total_change_of_heading(tmp_path: Path) -> None:
    angle = np.linspace(3.0, 3.0 + np.pi, 17)
    circle = 10 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    weave = 0.3 * np.sin(np.arange(17) * np.pi / 2)  # zero at both ends
    tracks = [
        track("round", circle, angle - np.pi / 2),
        track("round the other way", circle, -angle),
        track("weaving", circle, weave),
    ]
    whole = SceneRecord("scene-1", tracks, [Pair(i, 4) for i in range(3)], raster())
    _build(tmp_path / "cache", FixedReader(whole))
    np.testing.assert_allclose(Cache.open(tmp_path / "cache").turn, [np.pi, np.pi, 0.0], atol=1e-6)


def test_data_without_tokens_and_a_network_without_neighbours(tmp_path: Path) -> None:
    config = NetworkConfig(neighbor_types=(), uses_map=False)
    _build(tmp_path / "cache", FixedReader(record(token=False)), config=config)
    cache = Cache.open(tmp_path / "cache")
    assert (cache.token == b"").all()
    assert not cache.neighbors
    assert not cache.edge_mask.any()


def test_a_cache_of_boxes(tmp_path: Path) -> None:
    config = CoverNetConfig()
    _build(tmp_path / "cache", config=config)
    cache = Cache.open(tmp_path / "cache", CacheKey.of(READER, "some", Protocol.CAUSAL, config, FRAMES))
    assert cache.neighbor_boxes is not None
    assert (tmp_path / "cache/surroundings.npy").is_file()  # as in caches from before the name changed
    assert not cache.neighbors
    assert not list((tmp_path / "cache").glob("neighbors.*"))
    pairs = [(whole, pair) for whole in RECORDS for pair in whole.pairs]
    for row, (whole, pair) in enumerate(pairs):
        scene, tracks = frame_scene(whole, pair.frame, Protocol.CAUSAL, FRAMES)
        target = np.flatnonzero(tracks == pair.track)
        wanted = network_features(scene, target, AgentType.VEHICLE, config.features, Context.FULL)
        np.testing.assert_array_equal(cache.neighbor_boxes[row], wanted["neighbor_boxes"][0].numpy())
        np.testing.assert_array_equal(cache.history[row], wanted["history"][0].numpy())
    assert (cache.neighbor_boxes[..., 3] > 0).any()


def test_caches_of_histories_hold_no_boxes_and_are_found_as_before_there_were_any(tmp_path: Path) -> None:
    _build(tmp_path / "histories")
    assert Cache.open(tmp_path / "histories").neighbor_boxes is None
    manifest = tmp_path / "histories/manifest.json"
    content = json.loads(manifest.read_text())
    content["key"].pop("drawn")
    manifest.write_text(json.dumps(content))
    Cache.open(tmp_path / "histories", KEY)


def test_progress_is_told_of_each_scene(tmp_path: Path) -> None:
    told: list[SceneRecord] = []
    build_cache(READER, "some", Protocol.CAUSAL, CONFIG, FRAMES, tmp_path / "a/b/cache", told.append)
    assert told == list(RECORDS)
    assert [file.name for file in (tmp_path / "a/b").iterdir()] == ["cache"]


def test_nobody_writes_to_the_files(tmp_path: Path) -> None:
    _build(tmp_path / "cache")
    Cache.open(tmp_path / "cache").history[:] = 7.0
    assert not (Cache.open(tmp_path / "cache").history == 7.0).any()


def test_methods_share_a_cache(tmp_path: Path) -> None:
    _build(tmp_path / "cache")
    other = NetworkConfig(modes=7, blind=BlindContext.NULL)
    Cache.open(tmp_path / "cache", CacheKey.of(READER, "some", Protocol.CAUSAL, other, FRAMES))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"protocol": Protocol.PAPER}, "protocol is causal, not paper"),
        ({"split": "train"}, "split is some, not train"),
        ({"history_frames": 9}, "history_frames is 5, not 9"),
        ({"reader": "NuscenesReader"}, "reader is FixedReader, not NuscenesReader"),
        ({"neighbor_types": ()}, "neighbor_types is"),
        ({"drawn": True}, "drawn is False, not True"),
        ({"data": "elsewhere"}, "data is made up, not elsewhere"),
    ],
)
def test_a_cache_of_something_else_is_refused(tmp_path: Path, change: dict[str, object], told: str) -> None:
    _build(tmp_path / "cache")
    with pytest.raises(DataError, match=told):
        Cache.open(tmp_path / "cache", KEY.model_copy(update=change))


def _manifest(change: dict[str, object]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        file = folder / "manifest.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | change))

    return apply


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (lambda folder: (folder / "manifest.json").unlink(), "manifest.json: there is no such file"),
        (lambda folder: (folder / "manifest.json").write_text("{"), "manifest.json: cannot be read"),
        (lambda folder: (folder / "manifest.json").write_text("[1]"), r"manifest.json: "),
        (_manifest({"format_version": 99}), "format version 99, not 3; the cache has to be rebuilt"),
        (_manifest({"pairs": 0}), "manifest.json: pairs"),
        (_manifest({"pairs": 3}), r"\.npy: holds .* not .*3"),
        (_manifest({"more": 3}), "manifest.json: more"),
        (lambda folder: (folder / "future.npy").unlink(), "future.npy: missing or damaged"),
        (lambda folder: (folder / "future.npy").write_bytes(b"x"), "future.npy: missing or damaged"),
        (lambda folder: np.save(folder / "first.npy", np.zeros(61)), "first.npy: holds"),
        (lambda folder: (folder / "rasters.u8").unlink(), "rasters.u8: missing or damaged"),
        (lambda folder: (folder / "rasters.u8").write_bytes(b"x"), "rasters.u8: has 1 bytes"),
    ],
)
def test_a_damaged_cache_is_refused_and_the_file_named(
    tmp_path: Path, damage: Callable[[Path], object], told: str
) -> None:
    _build(tmp_path / "cache")
    damage(tmp_path / "cache")
    with pytest.raises(DataError, match=told):
        Cache.open(tmp_path / "cache")


def test_a_new_cache_takes_the_place_of_the_old_one(tmp_path: Path) -> None:
    _build(tmp_path / "cache")
    _build(tmp_path / "cache", FixedReader(RECORDS[1]))
    assert Cache.open(tmp_path / "cache").manifest.scenes == ("scene-2",)
    assert [file.name for file in tmp_path.iterdir()] == ["cache"]


def test_what_fails_half_way_leaves_the_old_cache_and_nothing_else(tmp_path: Path) -> None:
    _build(tmp_path / "cache")
    with pytest.raises(DataError, match=r"scene-9\.txt"):
        _build(tmp_path / "cache", FixedReader(RECORDS[1], fails=True))
    assert len(Cache.open(tmp_path / "cache").manifest.scenes) == 2
    assert [file.name for file in tmp_path.iterdir()] == ["cache"]


def test_a_folder_that_is_no_cache_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(DataError, match="left alone"):
        _build(tmp_path)
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


def test_a_split_without_pairs(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="'none' has no pairs"):
        build_cache(READER, "none", Protocol.CAUSAL, CONFIG, FRAMES, tmp_path / "cache")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("pair", "told"),
    [
        (Pair(0, 0), "a0 at frame 0 is a pair but has no history"),
        (Pair(0, 12), "a0 at frame 12 is a pair but has no whole future"),
        (Pair(0, 24), "a0 at frame 24 is a pair but not annotated"),
        (Pair(1, 5), "a1 at frame 5 is a pair but not annotated"),
        (Pair(1, 3), "a1 at frame 3 is a pair but has no whole future"),
        (Pair(4, 6), "a4 at frame 6 is a pair but is a pedestrian"),
    ],
)
def test_pairs_that_cannot_be_trained_on_are_refused(tmp_path: Path, pair: Pair, told: str) -> None:
    with pytest.raises(DataError, match=told):
        _build(tmp_path / "cache", FixedReader(replace(RECORDS[0], pairs=[pair])))


def test_a_raster_that_would_be_coarsened_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="scene-1: a raster of 6 pixels per metre is too fine"):
        _build(tmp_path / "cache", FixedReader(replace(RECORDS[0], raster=raster(scale=6.0))))


def _open(folder: Path, messages: list[str], history_frames: int = FRAMES) -> Cache:
    return open_cache(
        folder, READER, "made", "some", Protocol.CAUSAL, CONFIG, history_frames, messages.append
    )


def test_a_cache_is_built_once_for_each_setting(tmp_path: Path) -> None:
    messages: list[str] = []
    _open(tmp_path, messages)
    _open(tmp_path, messages)
    begun, finished = messages
    assert begun == (
        "The cache of some does not exist yet. It is built now, once for all runs with these settings."
    )
    assert re.fullmatch(r"some: cache of \d+ pairs from \d+ scenes built in \d+ s", finished)
    assert _open(tmp_path, messages, history_frames=9).history.shape[1] == 9
    assert len(messages) == 4
    assert _open(tmp_path, messages).history.shape[1] == FRAMES
    assert len(messages) == 4


def test_a_damaged_cache_is_built_again_and_the_reason_told(tmp_path: Path) -> None:
    messages: list[str] = []
    _open(tmp_path, messages)
    (manifest,) = tmp_path.glob("*/manifest.json")
    manifest.write_text("{")
    messages.clear()
    _open(tmp_path, messages)
    assert re.match(r"The cache of some cannot be used \(.*manifest\.json: cannot be read: ", messages[0])


def test_the_progress_tells_how_far_it_is_and_how_long_it_takes() -> None:
    messages: list[str] = []
    seconds = iter([0.0, 2.0, 6.0, 12.0, 21.5, 30.0, 31.0])
    progress = BuildProgress(5, "train", messages.append, clock=lambda: next(seconds))
    for _ in range(5):  # after 2, 6, 12, 21.5 and 30 s
        progress(RECORDS[0])
    progress.finish(70)
    assert messages == [
        "train: 2 of 5 scenes, about 9 s left",
        "train: 4 of 5 scenes, about 5 s left",
        "train: cache of 70 pairs from 5 scenes built in 31 s",
    ]


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (99, "99 s"), (100, "2 min"), (5900, "98 min"), (12600, "3.5 h")]
)
def test_durations_are_written_for_people(seconds: float, text: str) -> None:
    assert duration_text(seconds) == text


def test_a_cache_with_other_settings_in_its_place_is_rebuilt(tmp_path: Path) -> None:
    messages: list[str] = []
    _open(tmp_path, messages)
    (folder,) = tmp_path.iterdir()
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["key"]["data"] = "elsewhere"
    (folder / "manifest.json").write_text(json.dumps(manifest))
    assert _open(tmp_path, messages).manifest.key == KEY
    assert len(messages) == 4
    assert "other settings: data is elsewhere, not made up" in messages[2]


def test_a_cache_of_another_format_version_is_rebuilt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages: list[str] = []
    _open(tmp_path, messages)
    (folder,) = tmp_path.iterdir()
    for module in (cache, cache_builder):
        monkeypatch.setattr(module, "FORMAT_VERSION", FORMAT_VERSION + 1)
    with pytest.raises(
        DataError, match=f"format version {FORMAT_VERSION}, not {FORMAT_VERSION + 1}; .*rebuilt"
    ):
        Cache.open(folder, KEY)
    assert _open(tmp_path, messages).manifest.format_version == FORMAT_VERSION + 1
    assert len(messages) == 4
    assert f"format version {FORMAT_VERSION}, not {FORMAT_VERSION + 1}" in messages[2]
    _open(tmp_path, messages)
    assert len(messages) == 4


def test_made_up_scenes_of_another_version_are_other_data(monkeypatch: pytest.MonkeyPatch) -> None:
    before = SyntheticReader(Path("1")).place
    monkeypatch.setattr(synthetic, "VERSION", synthetic.VERSION + 1)
    assert SyntheticReader(Path("1")).place != before
