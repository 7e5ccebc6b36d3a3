"""Building of caches (``model.data.cache``) from recorded scenes.

A cache is written beside its place and moved there once it is complete. ``open_cache`` builds it only if
there is none for the same settings, of the current ``cache_layout.FORMAT_VERSION``.
"""

import hashlib
import shutil
import time
import uuid
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from model.arrays import Floats, Ints
from model.data.cache import Cache
from model.data.cache_layout import (
    FILE_NAMES,
    FORMAT_VERSION,
    MANIFEST_FILE,
    RASTERS_FILE,
    SCENE_LAYOUT,
    Arrays,
    CacheKey,
    Layout,
    Manifest,
    pair_layout,
)
from model.data.checks import FUTURE_STEPS, check_pairs, check_raster
from model.data.packing import pack, pack_patches
from model.data.protocols import SceneFrames
from model.data.scenes import DataError, Reader, SceneRecord
from model.data.sensing import SensedFrames
from model.features.agent_features import OUTSIDE, PATCHES, agent_frame_features
from model.features.scene_features import network_features
from model.features.spec import Frame
from model.forecaster import Context, Protocol
from model.geometry import wrap_angle
from model.networks.config import AnyNetworkConfig, NetworkConfig
from model.scenes.raster import cut_patches
from model.scenes.scene import AgentType, Raster

_FIRST_MESSAGE, _MESSAGES = 5.0, 15.0
"""s until the first message on the progress, and between those that follow."""


def open_cache(
    folder: Path,
    reader: Reader,
    kind: str,
    split: str,
    protocol: Protocol,
    config: AnyNetworkConfig,
    history_frames: int,
    on_message: Callable[[str], None],
    variants: int = 0,
) -> Cache:
    """Return the cache of a split; build it first if it is missing or stale.

    Args:
        folder: folder of the caches, which runs share.
        reader: reader of the data.
        kind: kind of the data, for the cache's name.
        split: one of the reader's splits.
        protocol: protocol of the inputs.
        config: configuration of the network, which determines how neighbours are held.
        history_frames: F, frames of history, now included.
        on_message: called with a text if the cache is built: why, how far it is, and how long it takes.
        variants: V, noisy reports of each pair (agent frame only).

    Raises:
        DataError: the data is bad, or there are no pairs.
    """
    key = CacheKey.of(reader, split, protocol, config, history_frames, variants)
    kinds = "".join(one.value[0] for one in key.neighbor_types) or "none"
    # The place of the data is in the name, so that data sets do not replace each other's caches
    data = hashlib.sha256(key.data.encode()).hexdigest()[:8]
    form = f"-agent{variants}" if key.agent_frame else "-drawn" * key.drawn
    place = folder / f"{kind}-{data}-{split}-{protocol.value}-{history_frames}-{kinds}{form}"
    try:
        return Cache.open(place, key)
    except DataError as error:
        why = f"cannot be used ({error})" if place.exists() else "does not exist yet"
        on_message(f"The cache of {split} {why}. It is built now, once for all runs with these settings.")
    told = BuildProgress(reader.scene_count(split), split, on_message)
    build_cache(reader, split, protocol, config, history_frames, place, told, variants)
    cache = Cache.open(place, key)
    told.finish(len(cache) // (1 + variants))
    return cache


class BuildProgress:
    """Messages on how far a cache is: after the first scenes, and then now and then."""

    def __init__(
        self,
        scenes: int,
        split: str,
        on_message: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """
        Args:
            scenes: number of the split's scenes.
            split: name of the split.
            on_message: called with each text.
            clock: the time, s.
        """
        self._scenes = scenes
        self._split = split
        self._on_message = on_message
        self._clock = clock
        self._begun = clock()
        self._next = self._begun + _FIRST_MESSAGE
        self._done = 0

    def __call__(self, record: SceneRecord) -> None:
        """Count a scene."""
        self._done += 1
        now = self._clock()
        if now < self._next or self._done >= self._scenes:
            return
        self._next = now + _MESSAGES
        left = (now - self._begun) * (self._scenes - self._done) / self._done
        self._on_message(
            f"{self._split}: {self._done} of {self._scenes} scenes, about {duration_text(left)} left"
        )

    def finish(self, pairs: int) -> None:
        """Say that the cache is complete, and how many pairs it has."""
        spent = duration_text(self._clock() - self._begun)
        self._on_message(f"{self._split}: cache of {pairs} pairs from {self._done} scenes built in {spent}")


def duration_text(seconds: float) -> str:
    """Return a duration for people, e.g. "40 s", "12 min" or "3.5 h"."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 99.5 else f"{minutes / 60:.1f} h"


def build_cache(
    reader: Reader,
    split: str,
    protocol: Protocol,
    config: AnyNetworkConfig,
    history_frames: int,
    folder: Path,
    progress: Callable[[SceneRecord], None] | None = None,
    variants: int = 0,
) -> None:
    """Write the cache of a split; an existing one is replaced once the new one is complete.

    Args:
        reader: reader of the scenes.
        split: one of the reader's splits.
        protocol: protocol of the inputs.
        config: configuration of the network, which determines how neighbours are held.
        history_frames: F, frames of history, now included.
        folder: folder of the cache; created, with its parents, if it does not exist.
        progress: called after each scene.
        variants: V, noisy reports of each pair beside the recorded states (agent frame only).

    Raises:
        DataError: the data is bad, there are no pairs, or the folder holds something else.
    """
    if folder.exists() and not (folder / MANIFEST_FILE).is_file():
        raise DataError(f"{folder}: exists and is no cache; it is left alone")
    key = CacheKey.of(reader, split, protocol, config, history_frames, variants)
    # Patches are cut from the rasters: for each batch, or, in the agent's frame, here for all variants
    config = config.model_copy(update={"uses_map": False})
    with _replacing(folder) as new:
        pairs: list[Arrays] = []
        scenes: list[Arrays] = []
        names: list[str] = []
        written = 0
        with (new / RASTERS_FILE).open("wb") as rasters:
            for record in reader.scenes(split):
                check_pairs(record.name, record.tracks, record.pairs)
                check_raster(record.name, record.raster)
                make = _agent_frame_arrays if key.agent_frame else _pair_arrays
                pairs.append(make(record, len(names), protocol, config, history_frames, variants))
                scenes.append(_scene_arrays(record.raster, written))
                names.append(record.name)
                written += rasters.write(pack(record.raster).data)
                if progress is not None:
                    progress(record)
        if not pairs:
            raise DataError(f"the split {split!r} has no pairs")
        _save(new, pairs, pair_layout(key))
        _save(new, scenes, SCENE_LAYOUT)
        manifest = Manifest(
            format_version=FORMAT_VERSION,
            key=key,
            pairs=sum(len(part["frame"]) for part in pairs),
            scenes=tuple(names),
            raster_bytes=written,
        )
        (new / MANIFEST_FILE).write_text(manifest.model_dump_json(indent=2) + "\n", encoding="utf-8")


def _agent_frame_arrays(
    record: SceneRecord,
    scene: int,
    protocol: Protocol,
    config: AnyNetworkConfig,
    history_frames: int,
    variants: int,
) -> Arrays:
    """Return the rows of a scene's pairs in the agents' frames; those of a pair are consecutive."""
    network = NetworkConfig(frame=Frame.AGENT, uses_map=False)
    recorded = SceneFrames(record, protocol, history_frames)
    sensed = SensedFrames(record, history_frames, seed=zlib.crc32(record.name.encode()))
    identity = _identity(record, scene)
    rows = 1 + variants
    parts: list[Arrays] = []
    for now, wanted in _by_frame(identity):
        reports = []
        for variant in range(rows):
            seen, tracks = sensed.at(now, variant) if variant else recorded.at(now)
            targets = np.searchsorted(tracks, wanted)
            report = agent_frame_features(seen, targets, network.features, Context.FULL)
            reports.append({name: tensor.numpy() for name, tensor in report.items()})
        part: Arrays = {  # [pairs · rows, …]
            name: np.stack([one[name] for one in reports], axis=1).reshape(-1, *reports[0][name].shape[1:])
            for name in reports[0]
        }
        part["position"], part["agents"] = part.pop("origin"), part.pop("neighbors")
        for name, feature in (("near_patch", "map"), ("far_patch", "far_map")):
            geometry = PATCHES[feature]
            patches = cut_patches(record.raster, part["position"], part["heading"], geometry, OUTSIDE)
            part[name] = pack_patches(patches)
        parts.append(part)
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    future, turn = _paths(record, history_frames)
    recorded_now = np.array(
        [record.tracks[pair.track].positions(np.array(pair.frame)) for pair in record.pairs]
    )
    arrays["future"] = np.repeat(future + recorded_now[:, None], rows, axis=0) - arrays["position"][:, None]
    of_pairs = identity | {"turn": turn}
    arrays |= {name: np.repeat(values, rows, axis=0) for name, values in of_pairs.items()}
    count = len(arrays["position"])
    return arrays | {"velocity": np.zeros((count, 2)), "edge_mask": np.zeros(count)}


def _pair_arrays(
    record: SceneRecord,
    scene: int,
    protocol: Protocol,
    config: AnyNetworkConfig,
    history_frames: int,
    variants: int,
) -> Arrays:
    """Return the rows of a scene's pairs in the ground frame, one a pair."""
    scenes = SceneFrames(record, protocol, history_frames)
    identity = _identity(record, scene)
    parts: list[Arrays] = []
    for now, wanted in _by_frame(identity):
        seen, tracks = scenes.at(now)
        targets = np.searchsorted(tracks, wanted)
        features = network_features(seen, targets, AgentType.VEHICLE, config.features, Context.FULL)
        part: Arrays = {name: tensor.numpy() for name, tensor in features.items()}
        part["position"] = part.pop("origin")
        part["heading"] = seen.states.heading[targets, -1]
        part.setdefault("edge_mask", np.zeros(len(targets)))
        parts.append(part)
    future, turn = _paths(record, history_frames)
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return arrays | identity | {"future": future, "turn": turn}


def _by_frame(identity: Arrays) -> Iterator[tuple[int, Ints]]:
    """Yield each frame that has pairs, and the tracks of its pairs; pairs are sorted by frame, too."""
    frame, track = identity["frame"], identity["track"]
    for now in np.unique(frame):
        yield int(now), track[frame == now]


def _identity(record: SceneRecord, scene: int) -> Arrays:
    """Return what tells a scene's pairs apart: scene, track, frame and token, [P] each."""
    return {
        "scene": np.full(len(record.pairs), scene),
        "track": np.array([pair.track for pair in record.pairs], dtype=np.int64),
        "frame": np.array([pair.frame for pair in record.pairs], dtype=np.int64),
        "token": np.array([pair.token.encode("ascii") for pair in record.pairs], dtype=np.bytes_),
    }


def _paths(record: SceneRecord, history_frames: int) -> tuple[Floats, Floats]:
    """Return the pairs' future [P, 12, 2], m, relative to now, and turn [P], rad."""
    future = np.empty((len(record.pairs), FUTURE_STEPS, 2))
    turn = np.empty(len(record.pairs))
    for row, pair in enumerate(record.pairs):
        track = record.tracks[pair.track]
        now = int(np.searchsorted(track.frames, pair.frame))
        start = int(np.searchsorted(track.frames, pair.frame - history_frames + 1))
        end = now + FUTURE_STEPS + 1
        future[row] = track.position[now + 1 : end] - track.position[now]
        turn[row] = abs(wrap_angle(np.diff(track.heading[start:end])).sum())
    return future, turn


def _scene_arrays(raster: Raster, start: int) -> Arrays:
    return {
        "raster_start": np.array([start]),
        "raster_shape": np.array([raster.layers.shape[1:]]),
        "raster_origin": raster.origin[None],
        "raster_pixels_per_meter": np.array([raster.pixels_per_meter]),
    }


def _save(folder: Path, parts: list[Arrays], layout: Layout) -> None:
    for name, (dtype, _) in layout.items():
        joined = np.concatenate([part[name] for part in parts])
        # Strings keep the length of the longest one
        file = folder / f"{FILE_NAMES.get(name, name)}.npy"
        np.save(file, joined if dtype is np.bytes_ else joined.astype(dtype))


@contextmanager
def _replacing(folder: Path) -> Iterator[Path]:
    """Yield a new folder that replaces ``folder`` on success and is removed otherwise."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    mark = uuid.uuid4().hex[:12]
    new, old = (folder.with_name(f".{folder.name}.{mark}.{what}") for what in ("new", "old"))
    new.mkdir()
    try:
        yield new
        if folder.exists():
            folder.rename(old)
        new.rename(folder)
    finally:
        for leftover in (new, old):
            shutil.rmtree(leftover, ignore_errors=True)
