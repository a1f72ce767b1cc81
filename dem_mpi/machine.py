"""What the machine has: memory that a rank may use. Sizes in B."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dem_mpi.parallel import Parallel

_GROUPS = Path("/proc/self/cgroup")  # the control groups of this process, one hierarchy a line
_MOUNTED = Path("/sys/fs/cgroup")
_MEBIBYTE = 1 << 20  # SLURM's megabyte


def installed_memory() -> int:
    """Memory of this machine, or what the batch system or a container lets this process use."""
    installed = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return min((installed, *group_limits(_GROUPS, _MOUNTED), *job_limits(os.environ)))


def memory_share(parallel: Parallel) -> int:
    """Collective. What a rank may use, all ranks of its machine alike; the least of all ranks."""
    return parallel.min(installed_memory() // parallel.ranks_of_machine())


def group_limits(groups: Path, mounted: Path) -> Iterator[int]:
    """Limits [B] of the control groups that `groups` lists, and of all groups these are within.

    groups : lines "number:controllers:path", no controllers in version 2 of control groups
    mounted : where the hierarchies are; a container sees its own group there as the root
    """
    try:
        lines = groups.read_text().splitlines()
    except (OSError, ValueError):
        lines = []
    places = [(mounted, "memory.max"), (mounted / "memory", "memory.limit_in_bytes")]
    for line in lines:
        _, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if controllers and "memory" not in controllers.split(","):
            continue
        root, name = places[bool(controllers)]
        parts = PurePosixPath(path).parts[1:]
        if ".." in parts:  # a group outside of what a container sees
            continue
        places += [(root.joinpath(*parts[:depth]), name) for depth in range(1, len(parts) + 1)]
    for place, name in places:
        try:
            yield int((place / name).read_text())
        except (OSError, ValueError):  # no such file; "max": no limit
            continue


def job_limits(environment: Mapping[str, str]) -> Iterator[int]:
    """Limits [B] on this node that SLURM tells a job; 0 stands for all there is."""

    def number(name: str) -> int:
        text = environment.get(name, "")
        return int(text) if text.isdecimal() else 0

    megabytes = number("SLURM_MEM_PER_NODE")
    each = number("SLURM_MEM_PER_CPU") * number("SLURM_CPUS_ON_NODE")
    for limit in (megabytes, each):
        if limit:
            yield limit * _MEBIBYTE
