"""Errors a user can act on, each with the exit code the command line ends with.

The codes follow BSD's sysexits.h: 64 usage, 65 data, 70 software, 74 input/output, 75 try again.
"""

from __future__ import annotations


class DemError(Exception):
    """An error whose text is written for the user; `exit_code` is the process's exit code."""

    exit_code = 70


class InputError(DemError):
    """A scene file, a flag or a value that breaks a rule."""

    exit_code = 64


class DataError(DemError):
    """A data file that is damaged, foreign or refused."""

    exit_code = 65


class OutputError(DemError):
    """Writing failed: disk full, no permission, another writer holds the file."""

    exit_code = 74


class StoppedError(DemError):
    """Stopped by a signal; a checkpoint is saved and the same command with --resume goes on."""

    exit_code = 75
