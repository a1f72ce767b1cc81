"""Permutations in few bytes, by what changed since the one before.

The Morton order of bodies that move is mostly the one before. Numbers are counted in the places of
the one before, and each is coded by its place among the numbers not used yet: from the beginning
(few bytes where a few bodies jumped far), or from the one coded last (few where runs of neighbours
moved together), of the permutation or of its inverse. The shortest of these is kept, or all
numbers as they are where none is shorter.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import ArrayLike, NDArray

from compress._kernels_permutation import displacements, from_displacements
from compress.entropy import decode_integers, encode_integers

_UNCHANGED, _PLAIN, _FROM_FIRST, _FROM_LAST, _INVERSE = range(5)
_CHECKSUM_BYTES = 4


def encode(permutation: ArrayLike, previous: ArrayLike | None = None) -> bytes:
    """A permutation (n,) of 0 ... n-1 in bytes that `decode` reads given the same `previous`.

    previous : (n,) another one, by default 0 ... n-1.
    5 bytes where both are equal; never more than 5 + ceil(n bits(n - 1) / 8).
    Raises ValueError where either is no permutation, or if their lengths differ.
    """
    order = check(permutation)
    rank = _ranks(previous, len(order))
    sequence = rank[order]
    return b"".join((_checksum(order), *_shortest(sequence)))


def decode(data: bytes, n: int, previous: ArrayLike | None = None) -> NDArray[np.int32]:
    """The permutation (n,) in bytes of `encode`, with the same `previous`.

    Raises ValueError where the bytes, n or `previous` are not those of the encoder.
    """
    if len(data) < _CHECKSUM_BYTES + 1:
        raise ValueError(f"coded permutation: {len(data)} bytes are too few")
    before = np.argsort(_ranks(previous, n))
    kind, body = data[_CHECKSUM_BYTES], data[_CHECKSUM_BYTES + 1 :]
    order = before[_sequence(kind, body, n)].astype(np.int32)
    if _checksum(order) != data[:_CHECKSUM_BYTES]:
        raise ValueError("coded permutation: checksum does not fit; damaged, or of another one")
    return order


def check(permutation: ArrayLike) -> NDArray[np.int64]:
    """The permutation (n,) as int64. Raises ValueError where a number is missing, saying which."""
    order = np.asarray(permutation)
    if order.ndim != 1 or (order.dtype.kind not in "iu" and order.size):
        raise ValueError(
            f"permutation: {order.dtype} of shape {order.shape}, must be integers (n,)"
        )
    n = len(order)
    if n and not (order.min() >= 0 and order.max() < n):
        raise ValueError(f"permutation: {order.min()} to {order.max()}, must be 0 to {n - 1}")
    order = order.astype(np.int64)
    missing = np.bincount(order, minlength=n) == 0
    if missing.any():
        raise ValueError(f"permutation: {int(np.argmax(missing))} is missing")
    return order


def _ranks(previous: ArrayLike | None, n: int) -> NDArray[np.int64]:
    """Where each number stands in `previous`."""
    if previous is None:
        return np.arange(n)
    before = check(previous)
    if len(before) != n:
        raise ValueError(f"permutation: {n} numbers, but {len(before)} before")
    return _inverse(before)


def _inverse(order: NDArray[np.int64]) -> NDArray[np.int64]:
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return rank


def _checksum(order: NDArray) -> bytes:
    return zlib.crc32(order.astype("<i4").tobytes()).to_bytes(_CHECKSUM_BYTES, "little")


def _shortest(sequence: NDArray[np.int64]) -> tuple[bytes, bytes]:
    """What kind of code is the shortest, and that code."""
    if np.array_equal(sequence, np.arange(len(sequence))):
        return bytes([_UNCHANGED]), b""
    plain = _packed(sequence)
    codes = {
        _FROM_FIRST: encode_integers(displacements(sequence, False)),
        _FROM_LAST: encode_integers(displacements(sequence, True)),
        _INVERSE: encode_integers(displacements(_inverse(sequence), True)),
        _PLAIN: plain,
    }
    kind = min(codes, key=lambda k: len(codes[k]))
    return bytes([kind]), codes[kind]


def _sequence(kind: int, body: bytes, n: int) -> NDArray[np.int64]:
    """What `_shortest` was given."""
    if kind == _UNCHANGED:
        if body:
            raise ValueError("coded permutation: bytes behind its end")
        return np.arange(n)
    if kind == _PLAIN:
        return check(_unpacked(body, n))
    if kind not in (_FROM_FIRST, _FROM_LAST, _INVERSE):
        raise ValueError(f"coded permutation: kind {kind} is unknown")
    places, used = decode_integers(body, limit=n)
    if used != len(body) or len(places) != n:
        raise ValueError(f"coded permutation: {len(places)} places, must be {n}")
    sequence = from_displacements(places, kind != _FROM_FIRST)
    if len(sequence) != n:
        raise ValueError("coded permutation: a place beyond the numbers left")
    return _inverse(sequence) if kind == _INVERSE else sequence


def _packed(sequence: NDArray[np.int64]) -> bytes:
    """Each number in as few bits as the largest needs."""
    bits = _bits(len(sequence))
    return np.packbits(sequence[:, None] >> np.arange(bits) & 1).tobytes()


def _unpacked(body: bytes, n: int) -> NDArray[np.int64]:
    bits = _bits(n)
    if len(body) != -(-n * bits // 8):
        raise ValueError(f"coded permutation: {len(body)} bytes for {n} numbers of {bits} bits")
    digits = np.unpackbits(np.frombuffer(body, np.uint8), count=n * bits).reshape(n, bits)
    return digits.astype(np.int64) @ (1 << np.arange(bits))


def _bits(n: int) -> int:
    return max(n - 1, 0).bit_length()
