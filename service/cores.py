"""Cores that this process may use: by its affinity and by the CPU quotas of its control groups."""

import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

_MEMBERSHIP = "proc/self/cgroup"
_V2 = "sys/fs/cgroup"
_V1 = ("sys/fs/cgroup/cpu,cpuacct", "sys/fs/cgroup/cpu")


def usable_cores(root: Path = Path("/")) -> float:
    """Return the number of cores that this process may use.

    Args:
        root: folder that holds /proc and /sys.
    """
    return min(float(len(os.sched_getaffinity(0))), *_quotas(root), float("inf"))


def whole_cores(root: Path = Path("/")) -> int:
    """Return the number of threads that can run at a time without being throttled, at least 1.

    Args:
        root: folder that holds /proc and /sys.
    """
    return max(int(usable_cores(root)), 1)


def _quotas(root: Path) -> Iterator[float]:
    """Yield the quotas, in cores, of this process's control groups and of those above them.

    In a container the path of the own group may be the host's, and its folder missing: the folder at the top
    is the container's own then.
    """
    for group, controllers in _memberships(root):
        if controllers and "cpu" not in controllers:
            continue
        for base in _V1 if controllers else (_V2,):
            for folder in (group, *group.parents):
                place = root / base / folder
                quota = _quota_v1(place) if controllers else _quota_v2(place)
                if quota is not None:
                    yield quota


def _memberships(root: Path) -> Iterator[tuple[PurePosixPath, list[str]]]:
    """Yield path and controllers of this process's control groups; without controllers it is of version 2."""
    try:
        lines = (root / _MEMBERSHIP).read_text(encoding="utf-8").splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        yield PurePosixPath(path.lstrip("/")), [name for name in controllers.split(",") if name]


def _quota_v2(folder: Path) -> float | None:
    try:
        allowed, period = (folder / "cpu.max").read_text(encoding="ascii").split()
        return int(allowed) / int(period)
    except (OSError, ValueError):  # no such file, or "max": there is no quota
        return None


def _quota_v1(folder: Path) -> float | None:
    try:
        allowed = int((folder / "cpu.cfs_quota_us").read_text(encoding="ascii"))
        period = int((folder / "cpu.cfs_period_us").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None
    return allowed / period if allowed > 0 else None  # -1: there is no quota
