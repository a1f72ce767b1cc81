"""Other ways to the same sums: blocked direct summation, and the Fortran library FMM3D."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dem_mpi.parallel import Parallel
from stokes.fmm.direct import direct_sum
from stokes.fmm.kernels import Kernel

FMM3D_KERNELS = ("laplace", "laplace_gradient", "stokeslet")


class Direct:
    """Every pair of points: the reference, and the fastest way for a few thousand points."""

    def __init__(
        self, kernel: Kernel, sources: NDArray, targets: NDArray, parallel: Parallel, threads: int
    ) -> None:
        self._kernel = kernel
        self._sources = sources
        self._targets = targets
        self._parallel = parallel
        self._threads = threads

    def apply(self, weights: NDArray) -> NDArray:
        """Collective. Sums (m, n_out, r) of weights (n, n_in, r)."""
        return direct_sum(
            self._kernel,
            self._sources,
            self._targets,
            weights,
            parallel=self._parallel,
            threads=self._threads,
        )


class Fmm3d:
    """Sums by FMM3D (Flatiron Institute) where its Python wrapper `fmm3dpy` is installed.

    Its versions scale their kernels differently (1/r, 1/(4 pi r), ...): the factor is taken from
    the value that the installed one gives for a single pair of points.
    """

    def __init__(
        self, kernel: Kernel, sources: NDArray, targets: NDArray | None, eps: float
    ) -> None:
        if kernel.name not in FMM3D_KERNELS:
            raise ValueError(
                f"kernel {kernel.name}: FMM3D has only {', '.join(FMM3D_KERNELS)} of ours; "
                "use the backend 'own'"
            )
        self._library = _import_fmm3dpy()
        self._kernel = kernel
        self._eps = eps
        self._sources = np.asfortranarray(sources.T)
        self._targets = None if targets is None else np.asfortranarray(targets.T)
        pair = np.array([[0.0, 1.0], [0.0, 0.0], [0.0, 0.0]], order="F")
        unit = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]], order="F")[: kernel.n_in]
        theirs = self._sum(pair, None, unit, 1e-12)[0, 1]
        ours = kernel.matrix(np.array([[1.0, 0.0, 0.0]]))[0, 0, 0]
        self._factor = ours / theirs

    def apply(self, weights: NDArray) -> NDArray:
        """Sums (m, n_out, r) of weights (n, n_in, r), one right-hand side after the other."""
        sums = [
            self._sum(
                self._sources, self._targets, np.asfortranarray(weights[:, :, column].T), self._eps
            ).T
            for column in range(weights.shape[2])
        ]
        return self._factor * np.stack(sums, axis=2)

    def _sum(self, sources: NDArray, targets: NDArray | None, w: NDArray, eps: float) -> NDArray:
        """Sums (n_out, m) in the library's own scaling."""
        at_sources = targets is None
        where = {} if at_sources else {"targets": targets}
        if self._kernel.name == "stokeslet":
            wanted = {"ifppreg": int(at_sources), "ifppregtarg": int(not at_sources)}
            result = self._library.stfmm3d(eps=eps, sources=sources, stoklet=w, **where, **wanted)
            sums = result.pot if at_sources else result.pottarg
            return sums.reshape(3, -1)  # version 2.1 gives (1, 3, m)
        gradient = self._kernel.name == "laplace_gradient"
        level = 2 if gradient else 1
        wanted = {"pg": level if at_sources else 0, "pgt": 0 if at_sources else level}
        result = self._library.lfmm3d(eps=eps, sources=sources, charges=w[0], **where, **wanted)
        if gradient:
            return result.grad if at_sources else result.gradtarg
        return (result.pot if at_sources else result.pottarg)[None, :]


def _import_fmm3dpy() -> Any:
    try:
        import fmm3dpy
    except ImportError as error:
        raise ModuleNotFoundError(
            "backend 'fmm3d' needs the package fmm3dpy (pip install fmm3dpy), which is not "
            "installed; the backend 'own' needs nothing"
        ) from error
    return fmm3dpy
