"""Rigid bodies in frictional contact on any number of MPI ranks."""

__version__ = "0.1.0"
