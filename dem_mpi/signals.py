"""Signals that ask a run to save and stop. Imports nothing heavy: they can come during start-up."""

from __future__ import annotations

import signal
from types import FrameType

_HEEDED = (signal.SIGUSR1, signal.SIGTERM, signal.SIGINT)


class StopRequest:
    """Remembers that a signal asked this rank to stop.

    USR1 is what a batch system sends before the time is up and what mpirun passes on; TERM and
    INT are heeded where they reach the ranks.
    """

    def __init__(self) -> None:
        self.name = ""

    @property
    def requested(self) -> bool:
        """Whether a signal has come."""
        return bool(self.name)

    def install(self) -> None:
        """Heed USR1, TERM and INT from now on; once one has come there is no more to heed."""
        if self.requested:
            return
        for number in _HEEDED:
            signal.signal(number, self._remember)

    def ignore(self) -> None:
        """Let these signals pass from now on.

        The launcher may send USR1 until the process has ended, and srun sends TERM as soon as
        another rank has left with 75; but Python restores the deadly default while it shuts down.
        """
        for number in _HEEDED:
            signal.signal(number, signal.SIG_IGN)

    def _remember(self, number: int, frame: FrameType | None) -> None:
        self.name = signal.Signals(number).name
        self.ignore()
