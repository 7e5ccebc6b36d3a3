"""How many forecasts leave the road: the share of a model's that do is known live without any truth."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from model.metrics.offroad import off_road
from model.scenes.scene import Raster
from service.predict.encode import Result


def count_off_road(raster: Raster | None, results: Sequence[Result]) -> Counter[str]:
    """By model, how many most likely trajectories leave the driveable area.

    Args:
        raster: the scene's map; None: nothing is known of the road.
        results: the forecasts that were made.
    """
    counts: Counter[str] = Counter()
    if raster is None:
        return counts
    for result in results:
        mixture = result.mixture
        # By numpy: a thread that calls torch gets helpers, which would be in the model's way
        rows = np.arange(len(mixture))
        paths = mixture.means.numpy()[rows, mixture.log_weights.numpy().argmax(axis=1)]
        leaving = off_road(raster, paths + mixture.origin.numpy()[:, None]) > 0
        names = [draft.forecaster.info.name for draft in result.drafts if draft.forecaster is not None]
        counts.update(name for name, leaves in zip(names, leaving.tolist(), strict=True) if leaves)
    return counts
