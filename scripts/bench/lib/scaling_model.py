"""A model of the seconds of a step on many cores, fitted to few.

    t = n t_n + I p (m t_m s + bytes / bandwidth + messages latency
                     + reductions latency log2 P)

for n bodies and m contacts a rank on P ranks: t_n and t_m are measured on one core, s is how much
slower a core works while the others of its node do, I the iterations and p the products with the
Delassus operator of an iteration (its line search and fresh residuals make it a little over one).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

# S. De, PhD thesis, University of Michigan 2021, table 2.2: cores and iterations.
THESIS_CORES = (4, 8, 16, 32, 64, 128, 256)
THESIS_ITERATIONS = (713, 763, 748, 788, 836, 803, 832)
THESIS_SPHERES = tuple(500_000 * cores for cores in THESIS_CORES)


@dataclass(frozen=True)
class Network:
    """What is assumed of messages: latency [s] of one, bandwidth [B/s] a core has for its own.

    The default shares the 100 Gbit/s of a node among eight cores, as many as S. De used a node.
    """

    latency: float = 2e-6
    bandwidth: float = 12.5e9 / 8


@dataclass(frozen=True)
class Cost:
    """Seconds of one core: of a body outside the solve, of a contact in a product.

    slowdown : factor on both while all cores of the node are busy
    """

    detection: float
    other: float
    contact: float
    slowdown: float


@dataclass(frozen=True)
class Load:
    """What the fullest rank has to do in a product: its contacts, and what it sends."""

    bodies: float
    contacts: float
    bytes: float
    messages: float
    reductions: float


def product_seconds(cost: Cost, load: Load, ranks: int, network: Network) -> float:
    """Seconds of a product with what belongs to it in an iteration."""
    reduction = network.latency * math.ceil(math.log2(ranks)) if ranks > 1 else 0.0
    return (
        load.contacts * cost.contact * cost.slowdown
        + load.bytes / network.bandwidth
        + load.messages * network.latency
        + load.reductions * reduction
    )


def step_seconds(
    cost: Cost, load: Load, ranks: int, products: float, network: Network
) -> dict[str, float]:
    """Seconds of a step's detection, of the rest outside the solve, and of the solve."""
    return {
        "detection": load.bodies * cost.detection * cost.slowdown,
        "other": load.bodies * cost.other * cost.slowdown,
        "solve": products * product_seconds(cost, load, ranks, network),
    }


def surface_law(ranks: ArrayLike, amount: ArrayLike, exponent: float = 0.5) -> tuple[float, float]:
    """Fit amount = full (1 - edge P^-exponent), what a rank sends; returns full and edge.

    At the rim of the bed there is nobody to send to: of P columns of a flat bed about P^(1/2)
    stand there.
    """
    p, y = np.asarray(ranks, dtype=float), np.asarray(amount, dtype=float)
    matrix = np.stack((np.ones_like(p), -(p**-exponent)), axis=1)
    full, lost = np.linalg.lstsq(matrix, y, rcond=None)[0]
    return float(full), float(lost / full)


def surface_amount(law: tuple[float, float], ranks: float, exponent: float = 0.5) -> float:
    """What the fitted law gives for so many ranks."""
    full, edge = law
    return full * (1.0 - edge * ranks**-exponent)


def logarithmic(x: ArrayLike, y: ArrayLike) -> tuple[float, float]:
    """Fit y = a + b log2 x."""
    b, a = np.polyfit(np.log2(np.asarray(x, dtype=float)), np.asarray(y, dtype=float), 1)
    return float(a), float(b)


def thesis_iterations(cores: float) -> float:
    """Iterations that the trend of S. De's table 2.2 gives for so many cores."""
    a, b = logarithmic(THESIS_CORES, THESIS_ITERATIONS)
    return a + b * math.log2(cores)


def power(x: ArrayLike, y: ArrayLike) -> float:
    """The exponent of y ~ x^e."""
    return float(np.polyfit(np.log(np.asarray(x, float)), np.log(np.asarray(y, float)), 1)[0])
