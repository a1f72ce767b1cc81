"""Solvers of the cone complementarity problem, one method a file."""
