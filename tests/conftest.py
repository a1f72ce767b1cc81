"""Fixtures and options of the whole suite; `support/mpi_pytest.py` runs tests on several ranks."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from mpi_pytest import Dispatcher, RankReporter

if TYPE_CHECKING:
    from dem_mpi.parallel import Parallel


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="also run tests marked `long`")
    parser.addoption("--slurm", action="store_true", help="also run tests marked `slurm`")


def _on_rank(config: pytest.Config) -> RankReporter | None:
    """The reporter where this pytest is one rank of an mpirun, None in the user's own."""
    plugins = config.pluginmanager.get_plugins()
    return next((plugin for plugin in plugins if isinstance(plugin, RankReporter)), None)


def pytest_configure(config: pytest.Config) -> None:
    if _on_rank(config) is None:
        config.pluginmanager.register(Dispatcher(config))
        _give_programs_their_signals()


def _give_programs_their_signals() -> None:
    """Let programs that tests start take HUP and INT, though this process ignores them.

    `nohup`, and `&` in a script, start a process that ignores signals, and what it starts inherits
    that; a handler, which does nothing here, is not inherited.
    """
    for number in (signal.SIGHUP, signal.SIGINT):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda *_: None)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    unasked = [name for name in ("long", "slurm") if not config.getoption(f"--{name}")]
    left_out = [item for item in items if any(map(item.get_closest_marker, unasked))]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


@pytest.fixture(scope="session")
def parallel() -> Parallel:
    """All ranks of this run: one in a serial test, `rank_count` in a test marked `mpi`."""
    from dem_mpi.parallel import Parallel

    return Parallel()


@pytest.fixture
def shared_path(request: pytest.FixtureRequest) -> Path:
    """An empty directory that all ranks of the test share (`tmp_path` differs on each rank)."""
    on_rank = _on_rank(request.config)
    if on_rank is None:
        return request.getfixturevalue("tmp_path")
    return on_rank.shared_path(request.node.nodeid)
