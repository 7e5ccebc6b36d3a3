"""The map as a feature: one patch for each agent, in its own frame."""

from collections.abc import Mapping

import numpy as np

from model.arrays import Bytes, Float32s, Ints
from model.scenes.raster import PatchGeometry, cut_patches
from model.scenes.scene import Scene


def map_patches(
    scene: Scene,
    targets: Ints,
    given: Mapping[int, Bytes | Float32s],
    geometry: PatchGeometry,
    outside: float,
) -> Float32s:
    """Return the map patches of n agents: [n, 3, S, S] in [-1, 1].

    Absent is −1, present 1; 0 is unknown. An agent's given patch takes precedence over the raster.

    Args:
        scene: the agents and their raster.
        targets: [n], indices of agents.
        given: agents' own patches by agent index, [3, S, S] in [0, 1].
        geometry: where a patch's pixels lie.
        outside: the value of pixels outside the raster, in [0, 1]: 0 absent, 0.5 unknown.
    """
    patches = np.zeros((len(targets), 3, geometry.size, geometry.size), dtype=np.float32)
    own = np.array([int(target) in given for target in targets], dtype=np.bool_)
    cut = ~own
    if scene.raster is not None and cut.any():
        states, seen = scene.states, targets[cut]
        position, heading = states.position[seen, -1], states.heading[seen, -1]
        patches[cut] = 2 * cut_patches(scene.raster, position, heading, geometry, outside) - 1
    for row in np.flatnonzero(own):
        patches[row] = 2 * given[int(targets[row])].astype(np.float32) - 1
    return patches
