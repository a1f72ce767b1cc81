"""How finely a body is resolved: panels along its meridian, Fourier modes about its axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Resolution:
    """Panels and modes of a body.

    breaks : edges of the panels, rising from 0 to 1; nodes : Gauss-Legendre nodes of a panel;
    modes : highest Fourier mode, 2 modes + 1 angles. ValueError for anything else.
    """

    breaks: tuple[float, ...]
    nodes: int
    modes: int

    def __post_init__(self) -> None:
        edges = np.array(self.breaks, float)
        if edges.ndim != 1 or len(edges) < 2 or edges[0] != 0 or edges[-1] != 1:
            raise ValueError(f"Resolution: breaks {self.breaks} must run from 0 to 1")
        if not np.all(np.diff(edges) > 0):
            raise ValueError(f"Resolution: breaks {self.breaks} must rise")
        if self.nodes < 2 or self.modes < 0:
            raise ValueError(f"Resolution: nodes {self.nodes} >= 2, modes {self.modes} >= 0 wanted")
        object.__setattr__(self, "breaks", tuple(edges.tolist()))

    @classmethod
    def uniform(cls, panels: int, nodes: int, modes: int) -> Resolution:
        """Return equal panels."""
        return cls(tuple(np.linspace(0, 1, panels + 1).tolist()), nodes, modes)

    @property
    def panels(self) -> int:
        """Number of panels."""
        return len(self.breaks) - 1

    @property
    def angles(self) -> int:
        """Number of equal angles about the axis."""
        return 2 * self.modes + 1

    @property
    def surface_nodes(self) -> int:
        """Number of nodes of the surface."""
        return self.panels * self.nodes * self.angles
