"""Fast multipole method by interpolation: sums of non-oscillatory kernels over many points."""
