"""Batches of a cache's pairs on a device, with the features of ``model.features.scene_features``."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from model.arrays import Bools
from model.data.augmentation import rotate
from model.data.cache import Cache
from model.data.cache_layout import draws, in_agent_frame, neighbors_name
from model.data.patches import PatchCutter, agent_frame_patches
from model.data.scenes import DataError
from model.features.agent_features import PATCHES
from model.forecaster import Features
from model.geometry import rotate as rotate_vectors
from model.networks.config import AnyNetworkConfig
from model.scenes.scene import AgentType


class Batches:
    """Features and futures of a cache's pairs, gathered without a loop over them."""

    def __init__(
        self,
        cache: Cache,
        device: torch.device,
        config: AnyNetworkConfig | None = None,
        packed_maps: bool = False,
    ) -> None:
        """
        Args:
            cache: the pairs.
            device: device of the batches; a GPU gets a copy of the whole cache, except for map patches of the
                agents' frames.
            config: configuration of a network that may see less than the cache holds; None: everything.
            packed_maps: show map patches of the agent's frame as the cache holds them: rounded, and packed,
                three layers a byte. Perturbations then move a twelfth of the memory, and the caller has to
                call ``packing.unpack_patches``. False: cut them from the rasters, as serving does.

        Raises:
            DataError: the cache does not hold the features of the network.
        """
        key = cache.manifest.key
        known = key.neighbor_types
        wanted = known if config is None else config.neighbor_types
        if wanted and wanted != known:
            raise DataError(f"the cache was made for neighbours {list(known)}, not {list(wanted)}")
        if wanted and config is not None and key.drawn != draws(config):
            held = "boxes" if key.drawn else "summed histories"
            raise DataError(f"the cache holds neighbours as {held}, which this network does not take")
        if config is not None and key.agent_frame != in_agent_frame(config):
            held = "the agents' own frames" if key.agent_frame else "the ground frame"
            raise DataError(f"the cache holds features in {held}, which this network does not take")
        self.variants = key.variants
        arrays = {
            "origin": cache.position,
            "velocity": cache.velocity,
            "history": cache.history,
            "first": cache.first,
        }
        self._cache = cache
        self._packed: dict[str, Tensor] = {}
        self._patches: list[str] = []
        if key.agent_frame:
            arrays |= {"heading": cache.heading, "speed": cache.speed}
            del arrays["velocity"]
            if wanted:
                arrays["neighbors"] = cache.agents
            sees = {"map": config is None or config.uses_map, "far_map": config is None or config.far_map}
            if packed_maps:
                packed = {"map": cache.near_patch, "far_map": cache.far_patch}
                self._packed = {
                    name: torch.from_numpy(patches)
                    for name, patches in packed.items()
                    if sees[name] and patches is not None
                }
            else:
                self._patches = [name for name in PATCHES if sees[name]]
        elif wanted and cache.neighbor_boxes is not None:
            arrays["neighbor_boxes"] = cache.neighbor_boxes
        elif wanted:
            arrays |= {neighbors_name(kind): cache.neighbors[kind] for kind in wanted}
            arrays["edge_mask"] = cache.edge_mask
        # The arrays are small: in memory, a batch costs no page faults
        self._arrays = {name: torch.from_numpy(np.array(array)).to(device) for name, array in arrays.items()}
        self._future = torch.from_numpy(np.array(cache.future)).to(device)
        self._turned = torch.from_numpy(np.array(cache.turn[:: 1 + key.variants]))
        recorded = slice(None, None, 1 + key.variants)
        future, heading = cache.future[recorded], cache.heading[recorded]
        paths = rotate_vectors(future.astype(np.float64), -heading[:, None])
        self._paths = torch.from_numpy(paths.astype(np.float32))
        self._leaving = torch.from_numpy(_leaving(cache))
        looks = config is None or config.looks_at_map(AgentType.VEHICLE)
        self._cut = PatchCutter(cache, device) if looks and not key.agent_frame else None
        self._device = device

    def __len__(self) -> int:
        """Return P, the number of pairs."""
        return len(self._future) // (1 + self.variants)

    @property
    def turned(self) -> Tensor:
        """[P], rad, how far each pair's heading turns from its oldest to its farthest frame; on the CPU."""
        return self._turned

    @property
    def leaving(self) -> Tensor:
        """[P] bool, pairs that stood for as long as they were seen and leave within 6 s; on the CPU."""
        return self._leaving

    @property
    def paths(self) -> Tensor:
        """[P, 12, 2] float32, m, each future in its agent's frame now, x ahead, y to the left; on the CPU."""
        return self._paths

    def batch(self, indices: Tensor, turns: Tensor | None = None) -> tuple[Features, Tensor]:
        """Return features and futures of pairs, rotated if wanted, as ``features`` does of rows.

        Args:
            indices: [n] int64, each in [0, P), on any device. For a pair with variants one row is drawn.
            turns: [n] rad, counter-clockwise, on any device; None: not at all.
        """
        if self.variants:
            variant = torch.randint(1, 1 + self.variants, indices.shape, device=indices.device)
            recorded = torch.rand(indices.shape, device=indices.device) < RECORDED_SHARE
            indices = indices * (1 + self.variants) + torch.where(recorded, 0, variant)
        features, future = self.features(indices)
        return (features, future) if turns is None else rotate(features, future, turns.to(self._device))

    def features(self, indices: Tensor) -> tuple[Features, Tensor]:
        """Return features and futures of rows of the cache: each pair is followed by its variants.

        Args:
            indices: [n] int64, on any device.

        Returns:
            The features of ``model.features.scene_features.network_features`` with full context, patches
            included, and the future [n, 12, 2] float32, m, relative to the position now, ground frame; on the
            device.
        """
        indices = indices.to(self._device)
        features = {name: array.index_select(0, indices) for name, array in self._arrays.items()}
        if self._cut is not None:
            features["map"] = self._cut(indices)
        for name, packed in self._packed.items():
            # The file is read on demand, so indexing is on the CPU
            features[name] = packed[indices.cpu()].to(self._device)
        if self._patches:
            patches = agent_frame_patches(self._cache, indices.cpu().numpy(), self._patches)
            features |= {name: each.to(self._device) for name, each in patches.items()}
        return features, self._future.index_select(0, indices)


STOOD_M = 0.5
"""m; an agent that moved less for as long as it was seen stood. This includes more agents than the rule of
the metrics (``model.metrics.standing``): those seen for less than 2 s, or from far away, may stand, too."""
LEFT_M = 2.0
"""m; an agent that is farther away after 6 s has left."""
RECORDED_SHARE = 0.4
"""Share of the pairs with variants that a batch shows as recorded."""


def _leaving(cache: Cache) -> Bools:
    """Return which pairs stood for as long as they were seen, and are elsewhere after 6 s: [P].

    The position after 6 s decides, because the prediction challenge has no pair that stands to the end: those
    still there after 3 s are about to leave. Agents seen in one frame only do not count: they may be driving.
    """
    rows = slice(None, None, 1 + cache.manifest.key.variants)
    before, end = cache.observed_positions()[rows], cache.future[rows, -1]
    farthest = np.nanmax(np.hypot(before[..., 0], before[..., 1]), axis=1)
    stood = (cache.first[rows] < before.shape[1] - 1) & (farthest < STOOD_M)
    return np.asarray(stood & (np.hypot(end[:, 0], end[:, 1]) > LEFT_M))


class JoinedPairs:
    """The concatenated pairs of several sources; a ``BatchSource``.

    Args:
        sources: at least one source; their features have the same names.
    """

    def __init__(self, sources: Sequence[Batches]) -> None:
        self._sources = tuple(sources)
        self._starts = np.cumsum([0, *(len(one) for one in sources)]).tolist()
        self._leaving = torch.cat([one.leaving for one in sources])

    def __len__(self) -> int:
        """Return P, over all sources."""
        return int(self._starts[-1])

    @property
    def turned(self) -> Tensor:
        """``Batches.turned`` of all sources: [P], rad."""
        return torch.cat([one.turned for one in self._sources])

    @property
    def leaving(self) -> Tensor:
        """``Batches.leaving`` of all sources: [P] bool."""
        return self._leaving

    @property
    def paths(self) -> Tensor:
        """[P, 12, 2], as in ``Batches``."""
        return torch.cat([one.paths for one in self._sources])

    def batch(self, indices: Tensor, turns: Tensor | None = None) -> tuple[Features, Tensor]:
        """Return features and futures as ``Batches.batch`` does, in the order of the indices."""
        parts, places = [], []
        for source, start in zip(self._sources, self._starts, strict=False):
            place = ((indices >= start) & (indices < start + len(source))).nonzero()[:, 0]
            if len(place):
                parts.append(source.batch(indices[place] - start, None if turns is None else turns[place]))
                places.append(place)
        order = torch.cat(places).argsort().to(parts[0][1].device)
        names = parts[0][0].keys()
        features = {name: torch.cat([one[name] for one, _ in parts])[order] for name in names}
        return features, torch.cat([future for _, future in parts])[order]
