"""Fast multipole method by interpolation: sums of non-oscillatory kernels over many points."""

from stokes.fmm.direct import direct_sum
from stokes.fmm.fmm import Fmm
from stokes.fmm.kernels import KERNELS, Kernel
from stokes.fmm.options import ErrorEstimate, FmmOptions, FmmReport

__all__ = ["KERNELS", "ErrorEstimate", "Fmm", "FmmOptions", "FmmReport", "Kernel", "direct_sum"]
