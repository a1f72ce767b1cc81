"""Memory that a process may use: of the machine, its control groups, and its batch job."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from dem_mpi import machine
from dem_mpi.machine import group_limits, installed_memory, job_limits

GIB = 1 << 30


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def limits(tmp_path: Path, groups: str) -> list[int]:
    write(tmp_path / "cgroup", groups)
    return sorted(group_limits(tmp_path / "cgroup", tmp_path / "fs"))


def test_limits_of_the_groups_around_a_job_count_in_version_2(tmp_path):
    """SLURM limits the job, and not the step that the process is in."""
    job = tmp_path / "fs" / "system.slice" / "slurmstepd.scope" / "job_7"
    write(job / "memory.max", f"{4 * GIB}\n")
    write(job / "step_0" / "memory.max", "max\n")
    write(tmp_path / "fs" / "other" / "memory.max", "1\n")
    found = limits(tmp_path, "0::/system.slice/slurmstepd.scope/job_7/step_0\n")
    assert found == [4 * GIB]


def test_limits_of_version_1_are_those_of_its_memory_controller(tmp_path):
    root = tmp_path / "fs" / "memory"
    write(root / "memory.limit_in_bytes", "9223372036854771712\n")
    write(root / "slurm" / "uid_1" / "job_7" / "memory.limit_in_bytes", f"{2 * GIB}\n")
    write(tmp_path / "fs" / "cpu" / "slurm" / "memory.max", "1\n")
    text = "11:cpu,cpuacct:/slurm\n9:hugetlb,memory:/slurm/uid_1/job_7/step_0/task_1\n0::/\n"
    assert min(limits(tmp_path, text)) == 2 * GIB


def test_a_container_sees_its_own_group_as_the_root(tmp_path):
    write(tmp_path / "fs" / "memory.max", f"{GIB}\n")
    assert limits(tmp_path, "0::/\n") == [GIB]
    assert limits(tmp_path, "0::/../../job\n") == [GIB]


def test_without_control_groups_there_is_no_limit(tmp_path):
    assert list(group_limits(tmp_path / "none", tmp_path / "nowhere")) == []
    assert limits(tmp_path, "nonsense\n\n::\n") == []


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({"SLURM_MEM_PER_NODE": "2048"}, [2 * GIB]),
        ({"SLURM_MEM_PER_CPU": "1024", "SLURM_CPUS_ON_NODE": "3"}, [3 * GIB]),
        ({"SLURM_MEM_PER_NODE": "0"}, []),  # --mem=0: all of the node
        ({"SLURM_MEM_PER_CPU": "1024"}, []),
        ({"SLURM_MEM_PER_NODE": "many"}, []),
        ({}, []),
    ],
)
def test_what_slurm_grants_a_node_is_a_limit(environment, expected):
    assert list(job_limits(environment)) == expected


def test_the_least_limit_counts(tmp_path, monkeypatch):
    whole = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    monkeypatch.setattr(machine, "_GROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(machine, "_MOUNTED", tmp_path / "fs")
    for name in ("SLURM_MEM_PER_NODE", "SLURM_MEM_PER_CPU"):
        monkeypatch.delenv(name, raising=False)
    assert installed_memory() == whole
    write(tmp_path / "cgroup", "0::/job\n")
    write(tmp_path / "fs" / "job" / "memory.max", str(whole // 2))
    assert installed_memory() == whole // 2
    monkeypatch.setenv("SLURM_MEM_PER_NODE", "1")
    assert installed_memory() == 1 << 20
