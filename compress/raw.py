"""Every bit kept: differences between steps, bytes of one significance together, zlib or LZMA.

The coder of integers and of exact fields, and the one that is left where nothing else pays. Two
bytes in front say what was done: which filter, which method of compression.

Symbols: T steps; any shape behind.
"""

from __future__ import annotations

import lzma
import math
import zlib
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

_PLAIN, _DIFFERENCES = range(2)
_STORED, _ZLIB, _LZMA = range(3)
# Without the container: it has checksums of its own, 60 bytes of them.
_LZMA_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 6, "dict_size": 1 << 22}]
_SAMPLE_BYTES = 1 << 16
# LZMA has to save this much over zlib to be worth ten times the time.
_LZMA_GAIN = 0.97


def encode(values: NDArray) -> bytes:
    """The bits of `values` (T, ...), numbers or flags, in few bytes.

    What pays is found on a sample from the middle.
    """
    words = _words(values)
    if not words.size:
        return bytes((_PLAIN, _STORED))
    size = math.prod(words.shape[1:]) * words.itemsize
    steps = max(2, _SAMPLE_BYTES // max(size, 1))
    first = max(0, (len(words) - steps) // 2)
    sample = words[first : first + steps].reshape(min(steps, len(words)), -1)
    sample = sample[:, : max(1, _SAMPLE_BYTES // (steps * words.itemsize))]
    trials = {
        (how, method): len(_compress(_filtered(sample, how), method))
        * (_LZMA_GAIN if method < _LZMA else 1.0)
        for how, method in product((_PLAIN, _DIFFERENCES), (_STORED, _ZLIB, _LZMA))
    }
    how, method = min(trials, key=lambda choice: (trials[choice], choice))
    filtered = _filtered(words, how)
    data = _compress(filtered, method)
    if method == _ZLIB and len(data) < len(filtered) // 50:
        # Near the end of what zlib can do LZMA does ten times better, and quickly.
        method, data = min(
            ((m, _compress(filtered, m)) for m in (_ZLIB, _LZMA)), key=lambda pair: len(pair[1])
        )
    if len(data) >= len(filtered) and method != _STORED:
        how, method, data = _PLAIN, _STORED, _filtered(words, _PLAIN)
    return bytes((how, method)) + data


def decode(data: bytes, dtype: DTypeLike, shape: tuple[int, ...]) -> NDArray:
    """The values of a type and shape that `encode` was given. Raises ValueError if they are not."""
    dtype = np.dtype(dtype)
    size = math.prod(shape) * dtype.itemsize
    if len(data) < 2 or data[0] > _DIFFERENCES or data[1] > _LZMA:
        raise ValueError("no data of the exact coder")
    filtered = _decompress(data[2:], data[1], size)
    if len(filtered) != size:
        raise ValueError(f"{len(filtered)} bytes decoded, {size} expected")
    planes = np.frombuffer(filtered, np.uint8).reshape(dtype.itemsize, size // dtype.itemsize)
    words = np.ascontiguousarray(planes.T).view(f"<u{dtype.itemsize}").reshape(shape)
    if data[0] == _DIFFERENCES and shape:
        # Sums modulo 2^bits undo differences modulo 2^bits.
        words = np.cumsum(words, axis=0, dtype=words.dtype)
    return words.astype(f"=u{dtype.itemsize}", copy=False).view(dtype)


def _words(values: NDArray) -> NDArray:
    """The bits as unsigned integers, (T, ...) little-endian."""
    values = np.ascontiguousarray(values)
    if values.dtype.itemsize not in (1, 2, 4, 8) or values.dtype.kind not in "biuf":
        raise ValueError(f"{values.dtype} is no plain number of at most 8 bytes")
    size = values.dtype.itemsize
    native = values.astype(values.dtype.newbyteorder("="), copy=False).view(f"=u{size}")
    return native.astype(f"<u{size}", copy=False).reshape(values.shape or (1,))


def _filtered(words: NDArray, how: int) -> bytes:
    if how == _DIFFERENCES:
        differences = words.copy()
        differences[1:] -= words[:-1]
        words = differences
    return np.ascontiguousarray(words).view(np.uint8).reshape(-1, words.itemsize).T.tobytes()


def _compress(data: bytes, method: int) -> bytes:
    if method == _ZLIB:
        return zlib.compress(data, 6)
    if method == _LZMA:
        return lzma.compress(data, lzma.FORMAT_RAW, filters=_LZMA_FILTERS)
    return data


def _decompress(data: bytes, method: int, size: int) -> bytes:
    """At most `size` + 1 bytes, whatever the data claim."""
    if method == _STORED:
        return data
    decoder: Any = (
        zlib.decompressobj()
        if method == _ZLIB
        else lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_LZMA_FILTERS)
    )
    try:
        decompressed = decoder.decompress(data, size + 1)
    except (zlib.error, lzma.LZMAError, EOFError) as error:
        raise ValueError(f"cannot be decompressed: {error}") from None
    if not decoder.eof:
        raise ValueError("cannot be decompressed: is cut off, or longer than expected")
    return decompressed
