"""Batches of a cache's pairs on a device, as ``model.inputs`` would make them."""

import numpy as np
import torch
from torch import Tensor

from model.data.cache import Cache
from model.data.cache_layout import draws, neighbors_name
from model.data.patches import PatchCutter
from model.data.rotation import rotate
from model.data.scenes import DataError
from model.forecaster import Features
from model.geometry import rotate as rotate_vectors
from model.networks.config import AnyNetworkConfig
from model.scene import AgentType


class Batches:
    """Features and truths of any pairs, without a loop over them."""

    def __init__(self, cache: Cache, device: torch.device, config: AnyNetworkConfig | None = None) -> None:
        """
        Args:
            cache: the pairs.
            device: where batches are made and stay; on a GPU all of the cache is copied there.
            config: what the network looks at, for a network that sees less than is there; None: all.

        Raises:
            DataError: the cache was made for other neighbours than the network's.
        """
        key = cache.manifest.key
        known = key.neighbor_types
        wanted = known if config is None else config.neighbor_types
        if wanted and wanted != known:
            raise DataError(f"the cache was made for neighbours {list(known)}, not {list(wanted)}")
        if wanted and config is not None and key.drawn != draws(config):
            held = "boxes" if key.drawn else "summed histories"
            raise DataError(f"the cache holds neighbours as {held}, which this network does not take")
        arrays = {
            "origin": cache.position,
            "velocity": cache.velocity,
            "history": cache.history,
            "first": cache.first,
        }
        if wanted and cache.surroundings is not None:
            arrays["surroundings"] = cache.surroundings
        elif wanted:
            arrays |= {neighbors_name(kind): cache.neighbors[kind] for kind in wanted}
            arrays["edge_mask"] = cache.edge_mask
        # The arrays are small: in memory, a batch costs no page faults
        self._arrays = {name: torch.from_numpy(np.array(array)).to(device) for name, array in arrays.items()}
        self._future = torch.from_numpy(np.array(cache.future)).to(device)
        self._turned = torch.from_numpy(np.array(cache.turn))
        paths = rotate_vectors(cache.future.astype(np.float64), -cache.heading[:, None])
        self._paths = torch.from_numpy(paths.astype(np.float32))
        looks = config is None or config.looks_at_map(AgentType.VEHICLE)
        self._cut = PatchCutter(cache, device) if looks else None
        self._device = device

    def __len__(self) -> int:
        """P, how many pairs there are."""
        return len(self._future)

    @property
    def turned(self) -> Tensor:
        """[P], rad, how far each pair's heading turns from its oldest to its farthest frame; on the CPU."""
        return self._turned

    @property
    def paths(self) -> Tensor:
        """[P, 12, 2] float32, m, each future in its agent's frame now, x ahead, y to the left; on the CPU."""
        return self._paths

    def batch(self, indices: Tensor, turns: Tensor | None = None) -> tuple[Features, Tensor]:
        """``features``, with the surroundings of each pair turned.

        Args:
            indices: [n] int64, each in [0, P), on any device.
            turns: [n] rad, counter-clockwise, on any device; None: not at all.
        """
        features, future = self.features(indices)
        return (features, future) if turns is None else rotate(features, future, turns.to(self._device))

    def features(self, indices: Tensor) -> tuple[Features, Tensor]:
        """Features and futures of pairs.

        Args:
            indices: [n] int64, each in [0, P), on any device.

        Returns:
            The features of ``model.inputs.network_features`` with full context, patches included, and the
            future [n, 12, 2] float32, m, relative to the position now, ground frame; on the device.
        """
        indices = indices.to(self._device)
        features = {name: array.index_select(0, indices) for name, array in self._arrays.items()}
        if self._cut is not None:
            features["map"] = self._cut(indices)
        return features, self._future.index_select(0, indices)
