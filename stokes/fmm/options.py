"""What a user may ask of the fast sum, and what it says about itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from numbers import Integral, Real
from typing import Literal, get_args, get_type_hints

from stokes.fmm._threads import most_threads

Method = Literal["auto", "ufmm", "bbfmm", "symmetric"]
Precision = Literal["auto", "double", "single"]
Derivative = Literal["auto", "exact", "interpolated"]
Admissibility = Literal["auto", "standard", "smooth"]
Near = Literal["auto", "cached", "recomputed"]
Backend = Literal["own", "fmm3d", "direct"]


@dataclass(frozen=True)
class FmmOptions:
    """Overrides of what `Fmm` would choose from the asked error.

    method        : "ufmm" equispaced grids with transfers in Fourier space; "bbfmm" Chebyshev grids
                    with globally compressed transfers; "symmetric" Chebyshev grids with the 16
                    operators that the symmetries of the cube leave, each of low rank
    order         : p of the interpolation; a grid has p + 1 nodes a direction
    leaf_size     : most points of one kind (sources or targets) in a leaf
    depth         : a uniform tree instead: its leaves are the occupied boxes of this level
    precision     : of the far field; single also of near pairs, of kernels up to 1/r
    derivative    : a kernel that is a gradient of another: "exact" transfers the gradient itself,
                    "interpolated" transfers the other kernel and differentiates the interpolation
    admissibility : "smooth" transfers between touching leaves too, and has no near field: for
                    kernels smooth at the origin, in boxes not much larger than their length.
                    "auto" takes it for such kernels where the cost model finds it cheaper
    near          : "cached" stores the near field's matrices, "recomputed" does not; "auto" stores
                    them for kernels of the package that take longer to compute than to read, if
                    they fit. Neither changes results by more than round-off
    near_memory   : most bytes of such matrices on a rank; where one rank has more, "auto" stores
                    none on any, and "cached" is an error
    threads       : of this rank, at most those of the machine
    """

    method: Method = "auto"
    order: int | None = None
    leaf_size: int | None = None
    depth: int | None = None
    precision: Precision = "auto"
    derivative: Derivative = "auto"
    admissibility: Admissibility = "auto"
    near: Near = "auto"
    near_memory: float = 2e9
    backend: Backend = "own"
    threads: int = 1

    def __post_init__(self) -> None:
        """Raise ValueError, with the option's name, for a value outside its rule."""
        hints = get_type_hints(type(self))
        for item in fields(self):
            allowed = get_args(hints[item.name])
            value = getattr(self, item.name)
            named = bool(allowed) and all(isinstance(choice, str) for choice in allowed)
            if named and value not in allowed:
                raise ValueError(f"{item.name} = {value!r}: must be one of {allowed}")
        least_values = {"order": 1, "leaf_size": 1, "depth": 0, "near_memory": 0, "threads": 1}
        for name, least in least_values.items():
            value = getattr(self, name)
            kind = Real if name == "near_memory" else Integral
            if value is not None and not (isinstance(value, kind) and value >= least):
                whole = "a number" if kind is Real else "an integer"
                raise ValueError(f"{name} = {value!r}: must be {whole} >= {least}")
        if self.order is not None and self.order > MAX_ORDER:
            raise ValueError(f"order = {self.order}: must be <= {MAX_ORDER}")
        if self.threads > most_threads():
            raise ValueError(f"threads = {self.threads}: there are {most_threads()}")
        if self.leaf_size is not None and self.depth is not None:
            raise ValueError("leaf_size and depth exclude each other: give one of them")


MAX_ORDER = 31


@dataclass(frozen=True)
class FmmReport:
    """What a plan is made of, on this rank unless said otherwise.

    method          : "ufmm", "bbfmm", "symmetric", "direct" or "fmm3d"; why: one sentence
    expected_error  : relative 2-norm of the sum's error that the error model expects
    compile_seconds : so far, of compiling kernels while planning and applying; a kernel that the
                      disk cache has is not compiled
    nodes           : of a grid in one direction, order + 1
    depth           : level of the finest leaves
    boxes           : in this rank's table, those of other ranks' points included
    pairs           : by list: of points ("near"), of boxes ("far"), of nodes and points
                      ("multipole_to_target", "source_to_local")
    memory          : bytes by part; "spectra" are taken by the first application
    plan_seconds    : wall clock by phase, compilation included
    """

    method: str
    kernel: str
    expected_error: float
    why: str = ""
    compile_seconds: float = 0.0
    nodes: int = 0
    precision: str = "double"
    derivative: str = "exact"
    admissibility: str = "standard"
    near: str = "recomputed"
    leaf_size: int | None = None
    depth: int = 0
    boxes: int = 0
    pairs: Mapping[str, int] = field(default_factory=dict)
    memory: Mapping[str, int] = field(default_factory=dict)
    plan_seconds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ErrorEstimate:
    """Error of a sum on sampled targets against direct summation.

    relative_l2  : ||u - u_direct||_2 / ||u_direct||_2 over all sampled targets and components
    relative_max : largest |u - u_direct| / largest |u_direct|
    samples      : targets sampled, on all ranks
    """

    relative_l2: float
    relative_max: float
    samples: int
