"""Tensor trains for simulation data: compression to a stated error, and the algebra of the format.

Begin with `compress.archive` for files, `compress.tensor_train` and `compress.decompose` for
tensors in memory.
"""
