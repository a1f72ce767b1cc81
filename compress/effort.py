"""How much time coders spend on fewer bytes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Effort:
    """Where a search ends.

    promising : coders that take more than this many times the fewest bytes on a sample of bodies
    are not tried on all; slight : bytes an entry [B] by which a change of bytes calls for no trial;
    sample : bodies on which the width of steps is sought first;
    aim : share of the error allowed that a trial on the whole block aims at;
    enough : share with which the search ends;
    thorough : whether paths are chosen with regard to all that comes later, and slow coders tried
    """

    promising: float
    slight: float
    sample: int
    aim: float
    enough: float
    thorough: bool


BEST = Effort(promising=1.5, slight=0.0, sample=2048, aim=0.996, enough=0.985, thorough=True)
# For while a simulation runs: a third of the time, some per cent more bytes.
FAST = Effort(promising=1.3, slight=5e-3, sample=512, aim=0.96, enough=0.85, thorough=False)
EFFORTS = {"best": BEST, "fast": FAST}
