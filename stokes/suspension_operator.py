"""The equations of a suspension, applied: velocities on all surfaces made by densities on all.

    residual velocity = sum over bodies j of (S_ij or D_ij + eta S_ij) density_j - K motion_i
    residual load     = B density_i

A fast sum runs over all nodes, a body's own included. What it makes of the own body, by the plain
product rule, is replaced by the exact operator of the shape in one product; what it makes of close
pairs of different bodies is corrected by the near field. Frames and units: `suspension_layout`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from dem_mpi.parallel import Halo, Parallel
from stokes.fmm import Fmm, FmmOptions, Kernel
from stokes.formulation import ShapeSolver
from stokes.geometry import Body, Resolution
from stokes.near import Layers, NearField
from stokes.sources import Surfaces
from stokes.suspension_layout import Field, Layout
from stokes.suspension_options import SuspensionOptions, Tolerances
from stokes.suspension_surfaces import OwnSurfaces

Map = Callable[[NDArray], NDArray]
# Errors of fast sums that interpolate end here, by round-off of their transfers.
_LEAST_FAST = 5e-11


class PhaseClock:
    """Wall-clock seconds by name of a phase; phases inside others are taken off these."""

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}
        self._running: list[str] = []
        self._since = 0.0

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Count what happens inside under this name."""
        self._stop()
        self._running.append(name)
        try:
            yield
        finally:
            self._stop()
            self._running.pop()

    def _stop(self) -> None:
        now = time.perf_counter()
        if self._running:
            name = self._running[-1]
            self._seconds[name] = self._seconds.get(name, 0.0) + now - self._since
        self._since = now

    @property
    def seconds(self) -> Mapping[str, float]:
        """So far."""
        return MappingProxyType(dict(self._seconds))


class Ghosts:
    """Densities of other ranks' bodies, behind this rank's own."""

    def __init__(self, layout: Layout, needed: Mapping[int, NDArray], parallel: Parallel) -> None:
        """Collective. needed: by rank, which of its bodies, counted as they were given there.

        Their nodes stand behind this rank's, rank after rank, in the order asked for.
        """
        self._halo: Halo | None = None
        if not parallel.any(len(needed) > 0):
            return
        wanted = parallel.exchange(
            {r: np.asarray(bodies, dtype=np.int64).tobytes() for r, bodies in needed.items()}
        )
        send = {}
        for rank, message in wanted.items():
            rows = layout.rows[np.frombuffer(message, dtype=np.int64)]
            send[rank] = np.concatenate([layout.range_of(row) for row in rows.tolist()])
        self._halo = Halo.build(parallel, layout.nodes, send)

    @property
    def nodes(self) -> int:
        """Nodes of ghost bodies on this rank."""
        return 0 if self._halo is None else self._halo.ghosts

    def extend(self, nodal: NDArray) -> NDArray:
        """Collective. Own rows (n, 3) followed by those of ghosts."""
        if self._halo is None:
            return nodal
        values = np.empty((len(nodal) + self.nodes, 3))
        values[: len(nodal)] = nodal
        self._halo.forward(values)
        return values


def sum_options(options: SuspensionOptions, tolerance: float) -> FmmOptions:
    """Options of sums: with this rank's threads, direct where no fast one reaches the tolerance."""
    fmm = replace(options.fmm, threads=max(options.fmm.threads, options.threads))
    if tolerance >= _LEAST_FAST or fmm.order is not None or fmm.backend != "own":
        return fmm
    return replace(fmm, backend="direct")


@dataclass(frozen=True)
class Members:
    """Bodies that densities stand on: this rank's in the layout's order, then ghosts.

    bodies, resolutions : of each
    layers : coefficients of the single and the double layer that a density makes on each
    """

    bodies: Sequence[Body]
    resolutions: Sequence[Resolution]
    layers: Layers


class SuspensionOperator:
    """A of A x = b: from densities and motions to velocities and loads, on all ranks."""

    def __init__(
        self,
        surfaces: OwnSurfaces,
        solvers: Mapping[int, ShapeSolver],
        members: Members,
        ghosts: Ghosts,
        tolerances: Tolerances,
        options: SuspensionOptions,
        clock: PhaseClock,
        parallel: Parallel,
    ) -> None:
        """Collective. solvers: of this rank's shapes, by number."""
        self._surfaces, self._layout = surfaces, surfaces.layout
        self._solvers, self._ghosts, self._clock = solvers, ghosts, clock
        self.applications = 0
        own = slice(surfaces.layout.bodies)
        self._sources = Surfaces(members.bodies[own], members.resolutions[own]).sources()
        self._layers = members.layers
        points = self._sources.points
        with clock.phase("near plan"):
            self.near = NearField(
                members.bodies,
                members.resolutions,
                points,
                members.layers,
                tolerances.near,
                self._layout.body_of_node,
                options.threads,
            )
        fmm = sum_options(options, tolerances.fmm)
        with clock.phase("fmm plan"):
            self.sums = tuple(
                (weights, Fmm(kernel, points, None, tolerances.fmm, fmm, parallel))
                for weights, kernel in self._kernels()
            )

    def _kernels(self) -> list[tuple[Map, Kernel]]:
        """Weights of a fast sum, made of densities, and its kernel, for each layer."""
        single, double = self._layers.kernels
        own = self._layout.bodies
        found = []
        if single is not None:
            a = np.broadcast_to(self._layers.single, max(own, np.size(self._layers.single)))[:own]
            found.append((partial(self._sources.single_weights, coefficient=a), single))
        if double is not None:
            found.append((partial(self._sources.double_weights, coefficient=1.0), double))
        return found

    def apply(self, unknown: Field) -> Field:
        """Collective. The velocities and loads of densities and motions (`rigid` may be None)."""
        self.applications += 1
        velocity = self.disturbance(unknown.nodal)
        if unknown.rigid is None:
            return Field(velocity)
        with self._clock.phase("self"):
            load = np.empty_like(unknown.rigid)
            for group in self._layout.groups:
                solver = self._solvers[group.shape]
                motion = np.tensordot(solver.rigid_motions, unknown.rigid[group.bodies].T, axes=1)
                group.view(velocity)[...] -= np.moveaxis(motion, -1, 0)
                single_layer, _ = solver.layers(group.columns(unknown.nodal))
                load[group.bodies] = solver.loads(single_layer).T
        return Field(velocity, load)

    def disturbance(self, density: NDArray) -> NDArray:
        """Collective. Velocities (n, 3) on this rank's surfaces of the densities on all."""
        with self._clock.phase("self"):
            velocity = np.empty_like(density)
            for group in self._layout.groups:
                solver = self._solvers[group.shape]
                group.put(velocity, solver.self_correction(group.columns(density)))
        with self._clock.phase("fmm"):
            world = np.zeros_like(density)
            for weights, plan in self.sums:
                world += plan.apply(weights(density[:, :, None])[:, :, 0])
        with self._clock.phase("near"):
            world += self.near.apply(self._ghosts.extend(density))
        velocity += self._surfaces.to_local(world)
        return velocity
