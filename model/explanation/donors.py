"""Donors: agents of training scenes, whose history, map and neighbours stand for what is absent.

They lie in a small file beside the checkpoints (``model.data.explanation_donors`` makes it). Everything is in
the donor's frame: origin at its position now, x along its heading.
"""

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from model.arrays import Bools, Bytes, Float32s, Floats, Ints
from model.explanation.matching import alike, is_driveable, overlaps
from model.geometry import rotate, wrap_angle
from model.scenes.raster import FAR, NEAR, PATCH_SIZE
from model.scenes.scene import AgentStates, AgentType

FILE: Final = "donors.npz"
"""Name of the file in a folder of checkpoints."""
STATE_NUMBERS: Final = 8
"""x, y (m), vx, vy (m/s), ax, ay (m/s²), heading (rad) and heading rate (rad/s)."""
KINDS: Final = (AgentType.VEHICLE, AgentType.PEDESTRIAN)
"""Types of a donor's neighbours, by their numbers in the file."""
_ABSENT: Final = 255
_BITS: Final = -(-3 * PATCH_SIZE**2 // 8)
_VERSION: Final = 1


class DonorsError(Exception):
    """Fault of a file of donors; the text names it."""


@dataclass(frozen=True)
class Donors:
    """C donors, all vehicles."""

    history: Floats
    """[C, F, 8], ``STATE_NUMBERS`` of each frame, NaN where not observed; the last frame is now."""
    neighbors: Floats
    """[C, M, F, 8], likewise, nearest first; NaN behind the last one."""
    kinds: Bytes
    """[C, M], index into ``KINDS``; 255 behind the last one."""
    near: Bytes
    """[C, 3, 100, 100], 0 or 1, map patches."""
    far: Bytes
    """[C, 3, 100, 100], far map patches."""
    weight: Floats
    """[C], share of the training agents that a donor stands for; sums to 1."""
    source: str
    """Data that they are from."""
    license: str

    def __len__(self) -> int:
        return len(self.history)

    @property
    def speeds(self) -> Floats:
        """[C], m/s."""
        return np.hypot(self.history[:, -1, 2], self.history[:, -1, 3])

    def matching(self, own: Floats, size: int, random: np.random.Generator) -> Ints:
        """Return the donors of map and neighbours for an agent, those to be taken first before the others.

        They are as fast as the agent and have road under its past. Those with as many neighbours as it has
        come first, in random order, then the others by the number of their neighbours.

        Args:
            own: [F, 8], the agent's history in its own frame.
            size: number of its neighbours.
            random: generator of random numbers.
        """
        speed = float(np.hypot(own[-1, 2], own[-1, 3]))
        fitting = [
            int(donor)
            for donor in np.flatnonzero(alike(self.speeds, speed))
            if is_driveable(self.far[donor], FAR, own[:, :2])
        ]
        found = random.permutation(np.array(fitting, dtype=np.int64))
        missing = [max(size - int(self._free(donor, own).sum()), 0) for donor in found.tolist()]
        return found[np.argsort(missing, kind="stable")]

    def spread(self, count: int, patch: Bytes | Float32s | None) -> Ints:
        """Return donors of all speeds, as frequent as in training, that could drive in an agent's place.

        Args:
            count: number of donors; one may occur more than once.
            patch: [3, 100, 100] in [0, 1], the agent's far map; None: unknown. Where no donor's past fits it,
                it does not count.

        Returns:
            [count], indices.
        """
        fits = np.ones(len(self), dtype=np.bool_)
        if patch is not None:
            fits = np.array([is_driveable(patch, FAR, one[:, :2]) for one in self.history], dtype=np.bool_)
        chosen = np.flatnonzero(fits if fits.any() else ~fits)
        # The middle of each of so many equal shares of the agents, by speed: less random than draws
        chosen = chosen[np.argsort(self.speeds[chosen], kind="stable")]
        shares = np.cumsum(self.weight[chosen]) / self.weight[chosen].sum()
        places = np.searchsorted(shares, (np.arange(count) + 0.5) / count)
        return np.asarray(chosen[np.minimum(places, len(chosen) - 1)])

    def neighbors_of(self, donor: int, size: int, own: Floats) -> tuple[list[AgentType], Floats]:
        """Return the nearest neighbours of a donor that do not overlap with an agent's past.

        Args:
            donor: index of the donor.
            size: maximum number of neighbours.
            own: [F, 8], history of the agent in its own frame.

        Returns:
            Their types, and their histories in the frame of the donor [·, F, 8].
        """
        rows = np.flatnonzero(self._free(donor, own))[:size]
        return [KINDS[kind] for kind in self.kinds[donor, rows].tolist()], self.neighbors[donor, rows]

    def _free(self, donor: int, own: Floats) -> Bools:
        there = self.kinds[donor] != _ABSENT
        frames = min(len(own), self.history.shape[1])
        past = own[-frames:]
        seen = self.neighbors[donor][:, -frames:, :2]
        return np.asarray(there & ~overlaps(seen, past[:, :2], past[:, 6]))


def in_own_frame(states: AgentStates, agents: Ints, position: Floats, heading: float) -> Floats:
    """Return histories in a frame: [n, F, 8], NaN where not observed.

    Args:
        states: states of a scene.
        agents: [n], indices of agents.
        position: [2], m, origin of the frame.
        heading: rad, of its x axis.
    """
    turn = np.asarray(-heading)
    parts = [
        rotate(states.position[agents] - position, turn),
        rotate(states.velocity[agents], turn),
        rotate(states.acceleration[agents], turn),
        wrap_angle(states.heading[agents] - heading)[..., None],
        states.heading_rate[agents][..., None],
    ]
    return np.concatenate(parts, axis=-1)


def in_ground_frame(histories: Floats, position: Floats, heading: float, frames: int) -> AgentStates:
    """Return the states of agents whose histories are given in a frame; the inverse of ``in_own_frame``.

    Args:
        histories: [n, F, 8]; agents without a position in a frame were not observed there.
        position: [2], m, origin of the frame.
        heading: rad, of its x axis.
        frames: number of frames of the result, the newest ones; what is missing was not observed.
    """
    count, given = histories.shape[:2]
    values = np.full((count, frames, STATE_NUMBERS), np.nan)
    kept = min(frames, given)
    values[:, frames - kept :] = histories[:, given - kept :]
    turn = np.asarray(heading)
    seen = np.isfinite(values[..., 0])
    # The unbroken run that ends now
    first = frames - np.where(seen.all(axis=1), frames, np.argmin(seen[:, ::-1], axis=1))
    return AgentStates(
        position=rotate(values[..., :2], turn) + position,
        velocity=rotate(values[..., 2:4], turn),
        acceleration=rotate(values[..., 4:6], turn),
        heading=wrap_angle(values[..., 6] + heading),
        heading_rate=values[..., 7],
        first=first.astype(np.int64),
        velocity_known=np.isfinite(values[:, -1, 2]),
    )


def save_donors(file: Path, donors: Donors) -> None:
    """Write donors to a file.

    Raises:
        OSError: the file cannot be written.
    """
    np.savez_compressed(
        file,
        version=np.int64(_VERSION),
        history=donors.history.astype(np.float16),
        neighbors=donors.neighbors.astype(np.float16),
        kinds=donors.kinds,
        near=np.packbits(donors.near.reshape(len(donors), -1), axis=1),
        far=np.packbits(donors.far.reshape(len(donors), -1), axis=1),
        weight=donors.weight.astype(np.float32),
        source=np.array(donors.source),
        license=np.array(donors.license),
    )


def load_donors(folder: Path) -> Donors | None:
    """Return the donors of a folder of checkpoints; None if it has none.

    Raises:
        DonorsError: the file is damaged or of another version.
    """
    file = folder / FILE
    try:
        # From memory: of a damaged archive numpy would leave the file open
        with np.load(io.BytesIO(file.read_bytes()), allow_pickle=False) as data:
            if int(data["version"]) != _VERSION:
                raise DonorsError(f"{file}: of a version that this release does not read")
            donors = Donors(
                history=data["history"].astype(np.float64),
                neighbors=data["neighbors"].astype(np.float64),
                kinds=data["kinds"],
                near=_patches(data["near"]),
                far=_patches(data["far"]),
                weight=data["weight"].astype(np.float64),
                source=str(data["source"]),
                license=str(data["license"]),
            )
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise DonorsError(f"{file}: no file of donors: {error}") from error
    _check(file, donors)
    return donors


def _patches(bits: Bytes) -> Bytes:
    """Return patches from their bits [C, ·]: [C, 3, 100, 100]."""
    if bits.dtype != np.uint8 or bits.ndim != 2 or bits.shape[1] != _BITS:
        raise ValueError(f"patches are {list(bits.shape)} bytes")
    size = (3, NEAR.size, NEAR.size)
    return np.unpackbits(bits, axis=1, count=3 * PATCH_SIZE**2).reshape(-1, *size)


def _check(file: Path, donors: Donors) -> None:
    """Refuse donors of contradicting shapes, or with histories that cannot be used.

    Raises:
        DonorsError: a fault was found.
    """
    count = len(donors)
    neighbors = donors.neighbors
    fits = (
        count > 0
        and donors.history.ndim == 3
        and donors.history.shape[2] == STATE_NUMBERS
        and neighbors.shape[:1] + neighbors.shape[2:] == donors.history.shape
        and donors.kinds.shape == neighbors.shape[:2]
        and donors.kinds.dtype == np.uint8
        and donors.near.shape[0] == donors.far.shape[0] == count
        and donors.weight.shape == (count,)
    )
    if not fits:
        raise DonorsError(f"{file}: its arrays contradict each other")
    there = donors.kinds != _ABSENT
    usable = (
        np.isfinite(donors.history[:, -1]).all()
        and np.isfinite(neighbors[there][:, -1]).all()
        and np.isin(donors.kinds[there], np.arange(len(KINDS))).all()
        and np.isfinite(donors.weight).all()
        and (donors.weight > 0).all()
    )
    if not usable:
        raise DonorsError(f"{file}: it holds values that cannot be used")
