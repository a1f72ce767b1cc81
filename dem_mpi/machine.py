"""What the machine has: memory that a rank may use. Sizes in B."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dem_mpi.parallel import Parallel

_GROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")  # of the batch system's job, or of a container


def installed_memory() -> int:
    """Memory of this machine, or what the group of this process may use of it."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        return min(memory, int(_GROUP_LIMIT.read_text()))
    except (OSError, ValueError):  # no such file; "max": no limit
        return memory


def memory_share(parallel: Parallel) -> int:
    """Collective. What a rank may use, all ranks of its machine alike; the least of all ranks."""
    return parallel.min(installed_memory() // parallel.ranks_of_machine())
