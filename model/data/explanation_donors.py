"""Choice of the donors that explanations take what is absent from, out of training scenes.

    python -m model.data.explanation_donors nuscenes_pred:DIR --split train

writes ``model/checkpoints/donors.npz``. Agents are drawn at random from strata: of each m/s of speed, those
with few and with many neighbours. Each gets the weight of its stratum among all agents of the split.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from model.arrays import Bytes, Floats
from model.data.protocols import SceneFrames
from model.data.scenes import Pair, Reader, SceneRecord
from model.data.sources import READERS, parse_data
from model.explanation.donors import FILE, KINDS, STATE_NUMBERS, Donors, in_own_frame, save_donors
from model.explanation.matching import NEIGHBORS_M
from model.forecaster import Protocol
from model.scenes.raster import FAR, NEAR, cut_patches

FRAMES: Final = 5
"""F, frames of history of a donor."""
NEIGHBORS: Final = 12
"""M, maximum number of a donor's neighbours; the nearest are taken."""
MANY: Final = 3
"""Number of neighbours from which on an agent has many."""
LICENSE: Final = "from nuScenes: non-commercial use only (CC BY-NC-SA 4.0 and the nuScenes terms of use)"
_ABSENT: Final = 255


class _Donor(NamedTuple):
    history: Floats  # [F, 8]
    neighbors: Floats  # [M, F, 8]
    kinds: Bytes  # [M]
    near: Bytes  # [3, 100, 100]
    far: Bytes


class _Stratum:
    """A uniform sample of the agents of one stratum, all from different scenes (reservoir sampling)."""

    def __init__(self) -> None:
        self.agents = 0
        self.donors: dict[str, _Donor] = {}


def choose_donors(reader: Reader, split: str, each: int, seed: int = 0) -> Donors:
    """Return donors.

    Args:
        reader: reader of the scenes.
        split: one of its splits.
        each: number of donors of each stratum.
        seed: seed of the draws.

    Raises:
        DataError: the data is bad, or there is no such split.
        ValueError: no agent has a whole history.
    """
    random = np.random.default_rng(seed)
    strata: dict[tuple[int, bool], _Stratum] = {}
    for record in reader.scenes(split):
        for pair, speed, donor in _agents(record):
            many = int((donor.kinds != _ABSENT).sum()) >= MANY
            stratum = strata.setdefault((round(speed), many), _Stratum())
            stratum.agents += 1
            name = record.name
            if name in stratum.donors or random.random() >= each / stratum.agents:
                continue
            if len(stratum.donors) >= each:
                del stratum.donors[str(random.choice(sorted(stratum.donors)))]
            stratum.donors[name] = _with_map(donor, record, pair)
    agents = sum(stratum.agents for stratum in strata.values())
    if not agents:
        raise ValueError(f"no agent of {split} has a whole history")
    chosen = [
        (donor, stratum.agents / agents / len(stratum.donors))
        for _, stratum in sorted(strata.items())
        for _, donor in sorted(stratum.donors.items())
    ]
    donors = [donor for donor, _ in chosen]
    weight = np.array([share for _, share in chosen])
    return Donors(
        history=np.stack([donor.history for donor in donors]),
        neighbors=np.stack([donor.neighbors for donor in donors]),
        kinds=np.stack([donor.kinds for donor in donors]),
        near=np.stack([donor.near for donor in donors]),
        far=np.stack([donor.far for donor in donors]),
        weight=weight / weight.sum(),
        source=f"{agents} agents of {split} in {len(strata)} strata",
        license=LICENSE,
    )


def _agents(record: SceneRecord) -> Iterator[tuple[Pair, float, _Donor]]:
    """Yield the pairs whose agents have a whole history: the pair, the speed in m/s, a donor without map."""
    frames = SceneFrames(record, Protocol.CAUSAL, FRAMES)
    none = np.zeros(0, dtype=np.uint8)
    for pair in record.pairs:
        scene, tracks = frames.at(pair.frame)
        found = np.flatnonzero(tracks == pair.track)
        if not len(found) or scene.states.first[found[0]] > 0:
            continue
        own = int(found[0])
        position = scene.states.position[own, -1]
        local = in_own_frame(
            scene.states, np.arange(len(tracks)), position, float(scene.states.heading[own, -1])
        )
        distance = np.hypot(local[:, -1, 0], local[:, -1, 1])
        order = [
            index
            for index in np.argsort(distance, kind="stable").tolist()
            if index != own and distance[index] <= NEIGHBORS_M and scene.types[index] in KINDS
        ][:NEIGHBORS]
        neighbors = np.full((NEIGHBORS, FRAMES, STATE_NUMBERS), np.nan)
        kinds = np.full(NEIGHBORS, _ABSENT, dtype=np.uint8)
        neighbors[: len(order)] = local[order]
        kinds[: len(order)] = [KINDS.index(scene.types[index]) for index in order]
        speed = float(np.hypot(*local[own, -1, 2:4]))
        yield pair, speed, _Donor(local[own], neighbors, kinds, none, none)


def _with_map(donor: _Donor, record: SceneRecord, pair: Pair) -> _Donor:
    track, frame = record.tracks[pair.track], np.array([pair.frame])
    place = track.positions(frame), track.headings(frame)
    near, far = (
        (cut_patches(record.raster, *place, geometry)[0] >= 0.5).astype(np.uint8) for geometry in (NEAR, FAR)
    )
    return donor._replace(near=near, far=far)


def main() -> None:
    """Write the file into the package."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", help="KIND:PATH of the data")
    parser.add_argument("--split", default="train")
    parser.add_argument("--each", type=int, default=4, help="donors of each stratum")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "checkpoints" / FILE)
    arguments = parser.parse_args()
    kind, path = parse_data(arguments.data)
    donors = choose_donors(READERS[kind](path), arguments.split, arguments.each)
    save_donors(arguments.out, donors)
    size = arguments.out.stat().st_size / 1e3
    print(f"{arguments.out}: {len(donors)} donors, {size:.0f} kB")  # noqa: T201


if __name__ == "__main__":
    main()
