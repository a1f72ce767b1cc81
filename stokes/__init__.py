"""Stokes flow around rigid bodies, and the fast sums that it stands on."""
