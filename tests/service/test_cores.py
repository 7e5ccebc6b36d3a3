"""Cores by quota, on made-up trees of control groups."""

import os
from pathlib import Path

import pytest

from service.cores import usable_cores, whole_cores
from service.predict import torch_threads
from service.predict.torch_threads import forward_threads

ALL = len(os.sched_getaffinity(0))
V2 = "sys/fs/cgroup"
V1 = "sys/fs/cgroup/cpu,cpuacct"


def tree(root: Path, membership: str, files: dict[str, str]) -> Path:
    """Write the membership of this process and the files of control groups; return the root."""
    for name, text in {"proc/self/cgroup": membership, **files}.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


@pytest.mark.parametrize(
    ("membership", "files", "expected"),
    [
        ("0::/\n", {f"{V2}/cpu.max": "50000 100000\n"}, 0.5),
        ("0::/\n", {f"{V2}/cpu.max": "max 100000\n"}, ALL),
        ("0::/\n", {}, ALL),
        ("0::/a/b\n", {f"{V2}/a/cpu.max": "20000 100000", f"{V2}/a/b/cpu.max": "90000 100000"}, 0.2),
        # In a container the path may be the host's, while its own group is at the top.
        ("0::/kubepods/pod1\n", {f"{V2}/cpu.max": "70000 100000\n"}, 0.7),
        ("0::/\n", {f"{V2}/cpu.max": "nonsense"}, ALL),
        (
            "4:cpu,cpuacct:/docker/x\n1:name=systemd:/\n",
            {f"{V1}/docker/x/cpu.cfs_quota_us": "40000", f"{V1}/docker/x/cpu.cfs_period_us": "100000"},
            0.4,
        ),
        ("4:cpu,cpuacct:/\n", {f"{V1}/cpu.cfs_quota_us": "-1", f"{V1}/cpu.cfs_period_us": "100000"}, ALL),
        # A mixed system has version 1 for the CPU, and version 2 without it.
        (
            "3:cpu:/c\n0::/u\n",
            {
                "sys/fs/cgroup/cpu/c/cpu.cfs_quota_us": "30000",
                "sys/fs/cgroup/cpu/c/cpu.cfs_period_us": "100000",
            },
            0.3,
        ),
    ],
)
def test_a_quota_bounds_the_cores(
    tmp_path: Path, membership: str, files: dict[str, str], expected: float
) -> None:
    root = tree(tmp_path, membership, files)
    assert usable_cores(root) == pytest.approx(expected)
    assert whole_cores(root) == max(int(expected), 1)


def test_without_control_groups_all_cores_may_be_used(tmp_path: Path) -> None:
    assert usable_cores(tmp_path) == ALL


@pytest.mark.parametrize(
    ("setting", "workers", "quota", "expected"),
    [
        (None, None, 2.5, (2, 2, 1, 2)),
        (None, None, 0.5, (1, 1, 1, 0)),
        (None, None, 100.0, (4, 4, 1, 4)),
        (None, None, 8.0, (4, 4, 1, 4)),
        (5, None, 1.0, (5, 4, 1, 4)),
        (6, None, 1.0, (6, 3, 2, 3)),
        (7, None, 1.0, (7, 3, 2, 3)),
        (8, None, 1.0, (8, 4, 2, 4)),
        (3, 0, 1.0, (3, 2, 1, 0)),
        (None, 0, 8.0, (4, 2, 2, 0)),
        (None, 3, 8.0, (4, 3, 1, 3)),
        (1, 2, 8.0, (1, 2, 1, 2)),
    ],
)
def test_a_quota_bounds_the_threads_of_the_forward(
    monkeypatch: pytest.MonkeyPatch,
    setting: int | None,
    workers: int | None,
    quota: float,
    expected: tuple[int, int, int, int],
) -> None:
    cores = 8 if quota == 8.0 else 128
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setattr(torch_threads, "usable_cores", lambda: quota)
    monkeypatch.setattr(torch_threads, "whole_cores", lambda: max(int(quota), 1))
    monkeypatch.setattr(torch_threads, "_CORES", 4)
    assert forward_threads(setting, workers) == expected
