"""Kinds of wall faces, and the columns of the row of numbers that describes a face.

A module of its own without imports, so that compiled kernels need no scene to know them.
"""

from __future__ import annotations

# Kinds of surfaces and what the geometry of each holds.
ABSENT = -1
PLANE = 0  # point 0:3, unit normal 3:6 to the side of the bodies
RECTANGLE = 1  # centre 0:3, unit normal 3:6, half edges 6:9 and 9:12
FRUSTUM = 2  # start 0:3, unit axis 3:6, length 6, radii at start and end 7:9, side 9 (+1 inside)

# Columns of a row: the geometry first, then vectors of three, then the kind.
GEOMETRY = 12  # so many columns
VELOCITY, SPIN, CENTRE = 12, 15, 18
KIND = 21
ROW = 22  # columns in all
