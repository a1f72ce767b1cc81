"""The search for a step of rounding whose error comes close to what is allowed.

Steps are numbered: STEP_PARTS to an octave, so that two bytes hold one. They are relative to values
scaled to at most 1.
"""

from __future__ import annotations

import math

from compress.bounds import Target

STEP_PARTS = 1 << 10
FIRST_OCTAVE = -60  # of the smallest step
STEPS = 64 * STEP_PARTS

MET = 1.0 - 1e-9  # share of the target that meets it whatever the order of a sum
CLOSE = 0.985  # share with which the search ends
SEEK = 0.993  # share it aims at


def step_size(code: int) -> float:
    """The step with this number, exact: 2^octave (1 + part / STEP_PARTS)."""
    octave, part = divmod(code, STEP_PARTS)
    return math.ldexp(1.0 + part / STEP_PARTS, octave + FIRST_OCTAVE)


def step_code(step: float) -> int:
    """The number of the largest step that is not above this one, within the range there is."""
    if step <= 0.0:
        return 0
    fraction, octave = math.frexp(step)
    code = (octave - 1 - FIRST_OCTAVE) * STEP_PARTS + int((2.0 * fraction - 1.0) * STEP_PARTS)
    return min(max(code, 0), STEPS - 1)


def _scaled(error: float, exponent: int) -> float:
    """An allowed error in units of 2^exponent; infinite where it is beyond all values."""
    try:
        return math.ldexp(error, -exponent)
    except OverflowError:
        return math.inf


def scaled_target(target: Target, exponent: int) -> Target:
    """The target for values divided by 2^exponent."""
    return Target(_scaled(target.frobenius, exponent), _scaled(target.maximum, exponent))


class Seeker:
    """Finds the step whose error is just below the target, from one trial to the next."""

    def __init__(self, step: float, close: float = CLOSE) -> None:
        """`close` : share of the target with which the search ends; it aims between this and 1."""
        self.step = step_code(step)
        self._close, self._seek = close, 0.5 * (close + 1.0)
        self._kept, self._broken = -1, STEPS  # largest step that met the target, smallest not
        self._last: tuple[float, float] | None = None
        self._slope = 0.8  # d ln(error) / d ln(step), of the last two trials

    def learn(self, excess: float) -> bool:
        """Take in the error of `step` over the target and choose the next; True at the end."""
        if self._close <= excess <= MET:
            return True
        if excess <= MET:
            self._kept = max(self._kept, self.step)
        else:
            self._broken = min(self._broken, self.step)
        here = math.log(step_size(self.step)), math.log(max(excess, 1e-30))
        if self._last is not None and here[0] != self._last[0]:
            slope = (here[1] - self._last[1]) / (here[0] - self._last[0])
            self._slope = min(max(slope, 0.3), 2.0)
        self._last = here
        if self._broken - self._kept <= 1:
            return True
        wanted = step_code(math.exp(here[0] + (math.log(self._seek) - here[1]) / self._slope))
        self.step = min(max(wanted, self._kept + 1), self._broken - 1)
        return False
