from pathlib import Path

import numpy as np

from model.data.nuscenes_pred import NuscenesPredReader
from model.metrics.standing import stood


def test_who_never_was_elsewhere_stood() -> None:
    tracks = np.full((5, 5, 2), [7e5, -3e5])
    tracks[1, 1] += (0.2, 0.3)  # There and back
    tracks[2, 1] = np.nan  # Hidden for a frame
    tracks[3] += 0.06 * np.arange(5)[:, None] * np.array([0.6, 0.8])  # Creeping: 0.24 m
    tracks[4, 0] += (0.5, 0.0)
    assert stood(tracks).tolist() == [True, False, False, True, False]
    assert not stood(tracks[:, 1:]).any()  # 1.5 s are too few to tell
    longer = np.concatenate([tracks - 50.0, tracks], axis=1)
    assert stood(longer).tolist() == stood(tracks).tolist()


def test_pairs_of_train_val(shared: Path) -> None:
    reader = NuscenesPredReader(shared / "data/nuscenes_pred")
    assert sum(record.stood(record.pairs).sum() for record in reader.scenes("train_val")) == 354
