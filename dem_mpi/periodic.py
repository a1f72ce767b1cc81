"""The periodic box: which axes repeat, wrapping into it, and the images that reach into it.

A body at x has images at x + k L, k one of the 26 shifts in {-1, 0, 1}^3 other than none, along
the periodic axes alone. A pair touches across a face where one body's image touches the other.

Two images of one body may touch the same partner: the box need only be as wide as the largest
distance at which two bodies interact. (A body never touches its own image then: the two move as
one and keep their gap.)

Symbols: n bodies; L period; image code (kx + 1) 9 + (ky + 1) 3 + (kz + 1), 13 the body itself.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from dem_mpi.scene_models import Domain

AXES = "xyz"
ITSELF = 13
_SHIFTS = np.array(list(itertools.product((-1, 0, 1), repeat=3)), dtype=np.float64)


@dataclass(frozen=True)
class PeriodicBox:
    """The box low <= x < high, which repeats along the axes marked in `periodic`.

    low, high : (3,) [m]; periodic : (3,) bool. Coordinates along other axes are left alone.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    periodic: NDArray[np.bool_]

    def __post_init__(self) -> None:
        """Keep read-only copies in the right types."""
        for name, dtype in (("low", np.float64), ("high", np.float64), ("periodic", np.bool_)):
            array = np.array(getattr(self, name), dtype=dtype)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @classmethod
    def of(cls, domain: Domain) -> PeriodicBox | None:
        """Return the box of a scene's domain; None if no axis is periodic."""
        if not domain.periodic:
            return None
        return cls(domain.min, domain.max, [axis in domain.periodic for axis in AXES])

    @property
    def period(self) -> NDArray[np.float64]:
        """L (3,) [m], zero along the axes that do not repeat."""
        return np.where(self.periodic, self.high - self.low, 0.0)

    @property
    def shortest(self) -> tuple[float, str]:
        """The shortest period [m] and its axis."""
        length = np.where(self.periodic, self.high - self.low, np.inf)
        axis = int(np.argmin(length))
        return float(length[axis]), AXES[axis]

    def shift(self, code: ArrayLike) -> NDArray[np.float64]:
        """Return the displacement (..., 3) [m] of images `code` from the bodies themselves."""
        return _SHIFTS[code] * self.period

    def wrap(self, position: NDArray) -> NDArray[np.float64]:
        """Return positions (n, 3) [m] brought into the box; those in it keep their bits.

        A body keeps its distance to all images of the others, to within rounding.
        """
        wrapped = np.array(position, dtype=np.float64)
        for axis in np.flatnonzero(self.periodic):
            low, high = self.low[axis], self.high[axis]
            x = wrapped[:, axis]
            strayed = np.flatnonzero((x < low) | (x >= high))
            turns = np.floor((x[strayed] - low) / (high - low))
            home = x[strayed] - turns * (high - low)
            # Rounding may leave a body on the upper face or an ulp below the lower one: the same
            # place, which belongs to the lower face.
            x[strayed] = np.where((home < low) | (home >= high), low, home)
        return wrapped

    def images(
        self, position: NDArray, reach: NDArray
    ) -> tuple[NDArray[np.int32], NDArray[np.int8]]:
        """Return row and code of every image within `reach` (n,) [m] of the box in each coordinate.

        The bodies themselves, `position` (n, 3) [m], must lie in the box. Images are in order of
        (code, row). The cost beyond one look at each body grows with the bodies near the faces.
        """
        # One ulp more than the rounded position covers the exact one.
        touches_low = np.nextafter(position - reach[:, None], -np.inf) <= self.low
        touches_high = np.nextafter(position + reach[:, None], np.inf) >= self.high
        touches = {-1: touches_high & self.periodic, 1: touches_low & self.periodic}
        near = np.flatnonzero((touches[-1] | touches[1]).any(axis=1))
        touches = {k: marks[near] for k, marks in touches.items()}
        rows, codes = [np.empty(0, np.int32)], [np.empty(0, np.int8)]
        for code, shift in enumerate(_SHIFTS):
            axes = np.flatnonzero(shift)
            if code == ITSELF or not self.periodic[axes].all():
                continue
            reaching = np.ones(len(near), dtype=bool)
            for axis in axes:
                reaching &= touches[int(shift[axis])][:, axis]
            rows.append(near[reaching].astype(np.int32))
            codes.append(np.full(len(rows[-1]), code, np.int8))
        return np.concatenate(rows), np.concatenate(codes)
