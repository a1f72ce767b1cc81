"""Nodes and weights exact for polynomials and polynomials times log x: how they are made.

`python -m stokes.log_rule_table 32` prints the table kept in `stokes._log_rule`. It takes a minute
and is needed only to change that table.

The n-point rule on (0, 1) integrates x^k and x^k log x, k < n, exactly (a Gauss rule of a Chebyshev
system: J. Ma, V. Rokhlin, S. Wandzura, SIAM J. Numer. Anal. 33, 1996). It is reached along the
systems {x^k, x^(k + delta)}: delta = 1/2 is a Gauss-Jacobi rule in t = sqrt(x), delta -> 0 is the
wanted one. Newton's method follows the path in the basis P_k(2x - 1), P_k(2x - 1) (x^delta - 1)
/delta, in long decimals, for the two halves of the basis are nearly dependent.
"""

from __future__ import annotations

import decimal
import sys
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray
from scipy.special import roots_jacobi

_DIGITS = 90
_STEPS = 40  # along the path in delta
_ENOUGH = Decimal("1e-35")  # relative change of nodes and weights at the end


def _legendre(x: NDArray) -> tuple[NDArray, NDArray]:
    """P_k(2x - 1) and its derivative, k < n = len(x): arrays (n, n), row k."""
    n = len(x)
    y = 2 * x - 1
    values, slopes = [x * 0 + 1, y], [x * 0, x * 0 + 2]
    for k in range(1, n - 1):
        values.append(((2 * k + 1) * y * values[k] - k * values[k - 1]) / (k + 1))
        slopes.append(slopes[k - 1] + 2 * (2 * k + 1) * values[k])
    return np.array(values), np.array(slopes)


def _power(x: NDArray, delta: Decimal) -> tuple[NDArray, NDArray]:
    """(x^delta - 1)/delta and its derivative; log x at delta = 0."""
    logs = np.array([v.ln() for v in x])
    if delta == 0:
        return logs, 1 / x
    powers = np.array([(delta * v).exp() for v in logs])
    return (powers - 1) / delta, powers / x


def _moments(n: int, delta: Decimal) -> NDArray:
    """Integrals over (0, 1) of the basis: P_k(2x - 1), then those times (x^delta - 1)/delta."""
    moments = [Decimal(int(k == 0)) for k in range(n)]
    moments.append(-1 / (1 + delta))
    product = 1 / (1 + delta)  # of 1/(delta + 1 + j), j <= k, and delta - j, 0 < j < k
    for k in range(1, n):
        product *= (delta - (k - 1) if k > 1 else 1) / (delta + 1 + k)
        moments.append(product)
    return np.array(moments)


def _solve(A: NDArray, b: NDArray) -> NDArray:
    """Gaussian elimination with row pivoting, for arrays of Decimals."""
    A = np.column_stack([A, b])
    n = len(b)
    for k in range(n):
        pivot = k + int(np.argmax(np.abs(A[k:, k])))
        A[[k, pivot]] = A[[pivot, k]]
        A[k + 1 :, k:] -= np.outer(A[k + 1 :, k] / A[k, k], A[k, k:])
    x = A[:, n]
    for k in range(n - 1, -1, -1):
        x[k] = (x[k] - A[k, k + 1 : n] @ x[k + 1 :]) / A[k, k]
    return x


def _newton(x: NDArray, w: NDArray, delta: Decimal, enough: Decimal) -> tuple[NDArray, NDArray]:
    """Solve the moment equations from a guess; the nodes as exponentials, for they span decades."""
    n = len(x)
    for _ in range(30):
        values, slopes = _legendre(x)
        power, power_slope = _power(x, delta)
        jacobian = np.block(
            [
                [slopes * w * x, values * w],
                [(slopes * power + values * power_slope) * w * x, values * power * w],
            ]
        )
        residual = np.concatenate([values @ w, (values * power) @ w]) - _moments(n, delta)
        step = _solve(jacobian, residual)
        largest = max(abs(v) for v in step)
        step *= min(Decimal(1), Decimal("0.5") / largest)
        x = x * np.array([(-v).exp() for v in step[:n]])
        w = w * np.array([(-v).exp() for v in step[n:]])
        if largest < enough:
            return x, w
    raise ArithmeticError(f"no {n}-point rule found at delta = {float(delta):.3g}")


def generate(n: int) -> tuple[list[Decimal], list[Decimal]]:
    """Return nodes (rising) and weights of the n-point rule to more than 30 digits."""
    decimal.getcontext().prec = _DIGITS
    t, w = roots_jacobi(n, 0, 1)
    x = np.array([Decimal((1 + v) / 2) ** 2 for v in t])
    w = np.array([Decimal(v / 2) for v in w])
    previous = None
    for step in range(_STEPS + 1):
        # Extrapolated logarithms: the nodes move by constant factors along the path.
        guess = (x, w) if previous is None else (x * x / previous[0], w * w / previous[1])
        delta = Decimal(_STEPS - step) / (2 * _STEPS)
        enough = _ENOUGH if step == _STEPS else Decimal("1e-6")
        previous, (x, w) = (x, w) if step else None, _newton(*guess, delta, enough)
    return list(x), list(w)


def _print_table(n: int) -> None:
    for name, values in zip(("NODES", "WEIGHTS"), generate(n), strict=True):
        print(f"{name} = (")
        for value in values:
            print(f"    {value:.25e},")
        print(")")


if __name__ == "__main__":
    _print_table(int(sys.argv[1]))
