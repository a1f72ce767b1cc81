"""Blocks as trains of two cores, rounded and coded: bodies, and time with the components.

X(b, j) = m(j) + sum over k of U(b, k) V(k, j), where j = t w + c. m is the trajectory of the bodies
that all move alike (free fall), if there are such: their rows of U are zero. V holds the right
singular vectors of what is left and U carries the singular values. One step serves for all of U:
columns below the step vanish, which is how bits are best spent on independent variables of unlike
variance ("reverse water-filling"). An error dV of row k counts for s_k |dV|, so that s_k V is
rounded with the same step, and sqrt(n) m too, both as coefficients of polynomials in time.
U is found by least squares against the V and m that the decoder will have, and the step is sought
for which the error of the decoded block comes close to the target.

Symbols: n bodies, T steps of time, w components, c = T w columns, r rank, s singular values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compress import _kernels_basis as basis
from compress._bytes import Bytes, number, signed
from compress._kernels_context import combine
from compress.bounds import Target
from compress.effort import BEST, Effort
from compress.quantise import PRICE, Rounded, round_matrix, shift_values, unround
from compress.step_search import FIRST_OCTAVE, MET, Seeker, scaled_target, step_size

SAMPLE = 2048  # bodies on which the step is sought first
FEW = 1024  # bodies by which it is decided whether there is a common trajectory
PASSES = 8  # trials of a step on the whole block


@dataclass(frozen=True)
class _Code:
    """A block rounded with one step."""

    step: int
    core: Rounded
    body: Rounded
    excess: float  # error over target, the larger of both kinds

    def pack(self, exponent: int) -> bytes:
        head = signed(exponent) + self.step.to_bytes(2, "little") + number(len(self.core.q) - 1)
        head += number(len(self.core.data)) + self.core.data
        if len(self.core.q) == 1:
            return head
        return head + bytes(shift % 256 for shift in self.body.shifts) + self.body.data


def encode(values: NDArray, target: Target, effort: Effort = BEST) -> bytes | None:
    """Code (T, n, w) finite values; None if that takes more bytes or finer steps than there are.

    The target, not exact, is met to within the rounding of float64 arithmetic.
    """
    T, n, width = values.shape
    exponent = math.frexp(float(np.abs(values).max()))[1]
    X = np.ldexp(np.asarray(values, np.float64).transpose(1, 0, 2), -exponent)
    X = np.ascontiguousarray(X).reshape(n, T * width)
    block = _Block(X, width, scaled_target(target, exponent), values.nbytes)
    code = block.search(effort.enough)
    return None if code is None else code.pack(exponent)


def decode(
    source: Bytes, shape: tuple[int, int, int], steps: NDArray, bodies: NDArray
) -> NDArray[np.float64]:
    """Values (T', n', w) of the steps and bodies with these indices, of a block (T, n, w)."""
    T, n, width = shape
    exponent = source.signed(1100)
    step = step_size(int.from_bytes(source.take(2), "little"))
    rank = source.number(T * width)
    core = unround(source.take(source.number(1 << 40)), rank + 1, T * width)
    V, m = _restore_cores(core, step, n, width)
    q, shifts = np.zeros((n, 0), np.int64), np.zeros(2)
    if rank:
        shifts = shift_values(tuple(np.frombuffer(source.take(2), np.int8)))
        # Rows behind the last one asked for are not even decoded.
        rows = int(bodies.max(initial=-1)) + 1
        q = unround(source.rest(), rows, rank)
    elif source.rest():
        raise ValueError("coded block: bodies of a train of rank 0")
    columns = (steps[:, None] * width + np.arange(width)).ravel()
    y = combine(q[bodies], shifts, np.ascontiguousarray(V[:, columns]), m[columns])
    y = y.reshape(len(bodies), len(steps), width).transpose(1, 0, 2)
    with np.errstate(over="ignore", under="ignore"):
        return np.ldexp(np.ascontiguousarray(y), exponent)


def _restore_cores(q: NDArray, step: float, n: int, width: int) -> tuple[NDArray, NDArray]:
    """step * V (r, c) and m (c,) of the integers (1 + r, c) of the core of time."""
    p = basis.polynomials(q.shape[1] // width)
    coefficients = step * basis.normalise_rows(q)
    coefficients[0] = (step / math.sqrt(n)) * q[0]
    rows = basis.apply_polynomials(coefficients, p, width)
    return rows[1:], rows[0]


def _singular(Y: NDArray) -> tuple[NDArray, NDArray]:
    """Right singular vectors (k, c) of Y (n, c) and their singular values, largest first.

    By the Gram matrix where it is the smaller one: vectors of singular values below 1e-8 of the
    largest are then any orthonormal ones, which costs bytes but no accuracy.
    """
    n, c = Y.shape
    if n <= c:
        _, s, V = np.linalg.svd(Y, full_matrices=False)
        return V, s
    squares, V = np.linalg.eigh(Y.T @ Y)
    return np.ascontiguousarray(V.T[::-1]), np.sqrt(np.maximum(squares[::-1], 0.0))


def _bits(Y: NDArray, step: float) -> float:
    """What the coefficients of Y would cost with this step, roughly."""
    V, _ = _singular(Y)
    return float(np.log2(1.0 + np.square(Y @ (V.T / step))).sum()) / 2.0


class _Block:
    """The search for the step of one block X (n, c), its values scaled to at most 1."""

    def __init__(self, X: NDArray, width: int, target: Target, limit: int) -> None:
        n, c = X.shape
        self.X, self.width, self.target, self.limit = X, width, target, limit
        few = X[:: max(1, n // FEW)]
        guess = min(8.0 * target.frobenius / math.sqrt(X.size), target.maximum)
        self.m = np.median(few, axis=0)
        if n > 1 and _bits(few - self.m, guess) > _bits(few, guess):
            self.m = np.zeros(c)
        self.p = basis.polynomials(c // width)
        V, self.s = _singular(X - self.m)
        self.U = (X - self.m) @ V.T
        self.largest = np.abs(self.U).max(axis=0, initial=0.0)
        rows = np.concatenate([math.sqrt(n) * self.m[None], self.s[:, None] * V])
        self.rows = np.einsum(
            "ktw,dt->kdw", rows.reshape(len(rows), -1, width), self.p, optimize=True
        ).reshape(len(rows), c)

    def search(self, close: float) -> _Code | None:
        """The code of the largest step tried whose error keeps to the target, `close` if it can."""
        if self._vanishes():
            return self._zero()
        n = len(self.X)
        step = self._first_step()
        if n >= 2 * SAMPLE:
            trial = Seeker(step, close)
            for _ in range(3):
                code = self.code(trial.step, slice(None, None, n // SAMPLE))
                if code is None or trial.learn(code.excess):
                    break
            step = step_size(trial.step)
        trial, best = Seeker(step, close), None
        for _ in range(PASSES):
            code = self.code(trial.step)
            if code is None:
                break
            if code.excess <= MET and (best is None or code.step > best.step):
                best = code
            if trial.learn(code.excess):
                break
        return best

    def code(self, step: int, rows: slice = slice(None)) -> _Code | None:
        """Round these rows of the block with a step; None if that is no use."""
        size = step_size(step)
        X = self.X[rows]
        rank = self._rank(size)
        core = round_matrix(self.rows[: rank + 1] / size, PRICE, self.limit)
        if core is None:
            return None
        V, m = _restore_cores(core.q, size, len(self.X), self.width)
        # Least squares; rows of V that were rounded to nothing are left out.
        inverse = np.linalg.pinv(V @ V.T, rcond=1e-6, hermitian=True) if rank else np.zeros((0, 0))
        x = (X - m) @ (V.T @ inverse)
        body = round_matrix(x, PRICE, self.limit)
        if body is None:
            return None
        error = combine(body.q, shift_values(body.shifts), V, m)
        error -= X
        frobenius = math.sqrt(float(np.vdot(error, error)) * (len(self.X) / len(X)))
        maximum = float(np.abs(error).max()) if math.isfinite(self.target.maximum) else 0.0
        excess = max(frobenius / self.target.frobenius, maximum / self.target.maximum)
        return _Code(step, core, body, excess)

    def _vanishes(self) -> bool:
        """Whether zeros meet the target."""
        norm = math.sqrt(float(np.vdot(self.X, self.X)))
        return norm <= self.target.frobenius and np.abs(self.X).max() <= self.target.maximum

    def _zero(self) -> _Code:
        nothing = round_matrix(np.zeros((1, self.X.shape[1])))
        return _Code(0, nothing, round_matrix(np.zeros((0, 0))), 0.0)

    def _rank(self, step: float) -> int:
        """Columns of U that are worth their row of V."""
        c = self.X.shape[1]
        for k in range(int(np.count_nonzero(self.largest > step)), 0, -1):
            u = self.U[:, k - 1] / step
            saved = float(np.maximum(u * u - 1.2, 0.0).sum())
            bits = 10.0 + 0.5 * c * math.log2(1.0 + (self.s[k - 1] / step) ** 2 / c)
            if saved > PRICE * bits:
                return k
        return 0

    def _first_step(self) -> float:
        """A step of about the right error, as if every coefficient were rounded by itself."""
        if not math.isfinite(self.target.frobenius):
            return 0.7 * self.target.maximum
        U = np.abs(self.U[:: max(1, len(self.U) // SAMPLE)])
        allowed = self.target.frobenius**2 * (len(U) / len(self.U))
        low, high = float(FIRST_OCTAVE), 4.0
        for _ in range(14):
            middle = 0.5 * (low + high)
            step = 2.0**middle
            squares = float(np.where(0.65 * step > U, U * U, step * step / 12.0).sum())
            low, high = (low, middle) if squares > allowed else (middle, high)
        return min(2.0**low, 0.7 * self.target.maximum)
