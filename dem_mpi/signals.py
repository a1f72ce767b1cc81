"""Signals that ask a run to save and stop. Imports nothing heavy: they can come during start-up."""

from __future__ import annotations

import signal
from types import FrameType


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
        for number in (signal.SIGUSR1, signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._remember)

    def ignore(self) -> None:
        """Let USR1 pass from now on.

        The launcher may send it until the process has ended, and Python restores the deadly
        default while it shuts down.
        """
        signal.signal(signal.SIGUSR1, signal.SIG_IGN)

    def _remember(self, number: int, frame: FrameType | None) -> None:
        self.name = signal.Signals(number).name
        self.ignore()
