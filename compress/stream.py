"""Tensors that arrive chunk by chunk, compressed as they come, to one tolerance of the whole.

Symbols: X the whole tensor, X_p the chunks of part p, Y_p the train that stands for them, tau the
tolerance, K the number of chunks so far.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from compress.decompose import tt_svd
from compress.rounding import round_train
from compress.tensor_train import TensorTrain, concatenate, stack, zeros
from dem_mpi.errors import DataError

Form = Literal["concatenate", "stack"]
FORMS: tuple[Form, ...] = ("concatenate", "stack")

# Norms are taken this much too small. It covers the rounding errors of norms, and those of adding
# up errors, of some 1e-13 together.
_SHORT = 1.0 - 2.0**-30

_MAGIC = b"TTSTREAM"
_FORMAT = 1
_HEAD = struct.Struct("<8sIQ")  # magic, CRC-32 of all that follows, bytes of the description


@dataclass(frozen=True)
class Part:
    """A tensor train Y in place of a tensor X.

    train : Y; error : ||X - Y||_F is at most this; norm : ||X||_F is at least this

    Raises ValueError for an error or a norm that is negative or not finite.
    """

    train: TensorTrain
    error: float
    norm: float

    def __post_init__(self) -> None:
        for name, value in (("error", self.error), ("norm", self.norm)):
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} = {value}: must be finite and >= 0")


class TensorTrainStream:
    """A tensor that grows chunk by chunk, held as tensor trains.

    tolerance : ||X - Y||_F <= tolerance ||X||_F holds for the whole after any number of chunks
    form      : "concatenate" joins chunks along their dimension `axis`, in which their lengths
                may differ (D algorithm 4.3); "stack" joins chunks of one shape, in pairs and
                pairs of pairs, along new dimensions of length 2, inserted before dimension `axis`
                of the chunks, the most significant first (D algorithm 4.4)
    axis      : see form; for "stack", the chunks' number of dimensions puts them last

    D: S. De, PhD thesis, University of Michigan 2021, chapter 4, whose algorithms bound no error
    of the whole: truncated at tau on every append, the whole drifts away from it.

    Chunks are held as parts of 1, 2, 4, ... chunks, at most one of each size: as in a binary
    counter, two of a size are joined and rounded to one of the next. Level l has 2^l chunks.

    Proof that the whole meets the tolerance. Each part p has a bound e_p >= ||X_p - Y_p|| and a
    norm N_p <= ||X_p||, and e_p <= tau N_p, which three steps preserve:

    1. A new chunk is decomposed to e = tau_0 N, or comes with e <= tau N, which is checked.
    2. Joining a and b only places their entries next to each other, without arithmetic: errors
       and norms of disjoint sets of entries add as squares, e^2 = e_a^2 + e_b^2 <= tau^2 N^2.
    3. A part of level l with tau_l N > e is then rounded with an error of at most tau_l N - e,
       rounding errors included, so that by the triangle inequality e' <= tau_l N < tau N. Where
       the rounding cannot promise that, the part stays as it is.

    The whole is all parts joined (step 2) and rounded with an error of at most tau N - e (step
    3 again). With tau_l = tau (1 - 1/(l + 2)) half of the tolerance belongs to the chunks
    themselves and tau / ((l + 1)(l + 2)) to the rounding at level l, so that some is left at any
    level: a chunk is rounded log2 K times, not K times, and no number of chunks uses it up.

    Held are the trains of at most log2 K + 1 parts, whatever they come to; an append needs the
    chunk, what decomposing it needs, and the joined parts, the ranks of which are the sums of
    theirs. A result depends on the chunks and their order alone.
    """

    def __init__(self, tolerance: float, axis: int = 0, form: Form = "concatenate") -> None:
        """Raises ValueError for a tolerance outside 0 ... 1, a negative axis, an unknown form."""
        if not 0.0 < tolerance < 1.0:
            raise ValueError(f"tolerance = {tolerance}: must lie between 0 and 1")
        if form not in FORMS:
            raise ValueError(f"form {form!r}: must be one of {', '.join(FORMS)}")
        if axis < 0:
            raise ValueError(f"axis = {axis}: must be >= 0")
        self.tolerance = float(tolerance)
        self.form: Form = form
        self.axis = int(axis)
        self.chunks = 0
        self._parts: list[tuple[int, Part]] = []  # (level, part), levels falling

    # ---- what is held ----------------------------------------------------------------------

    @property
    def parts(self) -> tuple[Part, ...]:
        """The parts held, oldest first."""
        return tuple(part for _, part in self._parts)

    @property
    def parameters(self) -> int:
        """Numbers held in cores."""
        return sum(part.train.parameters for part in self.parts)

    @property
    def norm(self) -> float:
        """||X||_F of all chunks so far, or a little less."""
        return math.hypot(*(part.norm for part in self.parts))

    @property
    def error(self) -> float:
        """What the parts held may be away from the chunks, in the Frobenius norm of all."""
        return math.hypot(*(part.error for part in self.parts))

    # ---- chunks in, tensor out -------------------------------------------------------------

    def append(
        self, chunk: ArrayLike | TensorTrain, error: float = 0.0, norm: float | None = None
    ) -> None:
        """Add a chunk, an array or a train that stands for one.

        error, norm : of a train alone: what it may be away from the chunk, and the norm of the
        chunk (default: the least that the error allows) [unit of the chunk].

        Raises ValueError for a chunk of another shape or dtype, for values that are not finite,
        and for an error above the tolerance. The stream is then as before.
        """
        if isinstance(chunk, TensorTrain):
            part = _stated(chunk, error, norm)
        else:
            decomposed = tt_svd(chunk, tolerance=_share(0) * self.tolerance)
            part = Part(decomposed.train, decomposed.error, _SHORT * decomposed.norm)
        self._check(part)
        parts, level = [*self._parts], 0
        while parts and parts[-1][0] == level:
            _, older = parts.pop()
            level += 1
            part = join((older, part), self.axis, self.form, _share(level) * self.tolerance)
        self._parts = [*parts, (level, part)]
        self.chunks += 1

    def whole(self) -> Part:
        """All chunks so far as one train, with its error and the norm; the stream stays as it is.

        Raises ValueError if there is no chunk.
        """
        if not self._parts:
            raise ValueError("no chunk has been appended")
        if self.form == "concatenate":
            return join(self.parts, self.axis, self.form, self.tolerance)
        return _rounded(self._filled_up(), self.tolerance)

    def result(self) -> TensorTrain:
        """All chunks so far as one train; see `whole`.

        "stack": K chunks give ceil(log2 K) new dimensions, and zeros where chunks are missing:
        with L new dimensions merged to one of length 2^L, chunk c is entry c.
        """
        return self.whole().train

    def _filled_up(self) -> Part:
        """The parts stacked, with zeros for the chunks missing from a power of two."""
        level, newest = self._parts[-1]
        for above, older in reversed(self._parts[:-1]):
            while level < above:
                newest = join((newest, _zeros_like(newest)), self.axis, self.form)
                level += 1
            newest = join((older, newest), self.axis, self.form)
            level += 1
        return newest

    def _check(self, part: Part) -> None:
        shape, dtype = part.train.shape, part.train.dtype
        if part.error > self.tolerance * part.norm:
            raise ValueError(
                f"chunk {self.chunks}: its error {part.error:.3g} is above {self.tolerance:g} of "
                f"its norm {part.norm:.3g}"
            )
        if self.axis >= len(shape) + (self.form == "stack"):
            raise ValueError(f"axis = {self.axis}: a chunk has {len(shape)} dimensions")
        if not self._parts:
            return
        level, first = self._parts[0]
        expected = first.train.shape
        if self.form == "stack":
            expected = (*expected[: self.axis], *expected[self.axis + level :])
            fits = shape == expected
        else:
            fits = _without(shape, self.axis) == _without(expected, self.axis)
        if not fits:
            raise ValueError(f"chunk {self.chunks} of shape {shape}: does not fit to {expected}")
        if dtype != first.train.dtype:
            raise ValueError(f"chunk {self.chunks} of {dtype}: others are {first.train.dtype}")

    # ---- interrupted and resumed -----------------------------------------------------------

    def save(self) -> bytes:
        """All there is, from which `load` goes on bit by bit as if nothing had happened."""
        description = {
            "format": _FORMAT,
            "tolerance": self.tolerance,
            "axis": self.axis,
            "form": self.form,
            "chunks": self.chunks,
            "parts": [
                {
                    "level": level,
                    "error": part.error,
                    "norm": part.norm,
                    "dtype": part.train.dtype.name,
                    "shape": part.train.shape,
                    "ranks": part.train.ranks,
                }
                for level, part in self._parts
            ],
        }
        text = json.dumps(description).encode()
        cores = [_little(core).tobytes() for part in self.parts for core in part.train.cores]
        body = b"".join([text, *cores])
        return _HEAD.pack(_MAGIC, zlib.crc32(body), len(text)) + body

    @classmethod
    def load(cls, data: bytes) -> TensorTrainStream:
        """The stream that was saved. Raises DataError if the data are not one, or are damaged."""
        try:
            magic, checksum, length = _HEAD.unpack_from(data)
        except struct.error:
            raise DataError("saved stream: ends too early") from None
        if magic != _MAGIC:
            raise DataError("saved stream: is of another kind")
        body = memoryview(data)[_HEAD.size :]
        if zlib.crc32(body) != checksum:
            raise DataError("saved stream: damaged (checksum)")
        try:
            return cls._from_description(json.loads(bytes(body[:length])), body[length:])
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            raise DataError(f"saved stream: {error}") from error

    @classmethod
    def _from_description(cls, description: dict, cores: memoryview) -> TensorTrainStream:
        if description["format"] != _FORMAT:
            raise ValueError(f"format {description['format']}: this program reads {_FORMAT}")
        stream = cls(description["tolerance"], description["axis"], description["form"])
        at = 0
        for saved in description["parts"]:
            train, at = _read_train(saved, cores, at)
            part = Part(train, float(saved["error"]), float(saved["norm"]))
            level = int(saved["level"])
            if not 0 <= level < (stream._parts[-1][0] if stream._parts else 64):
                raise ValueError(f"part of level {level} where there can be none")
            if part.error > stream.tolerance * part.norm:
                raise ValueError(f"part of level {level}: its error is above the tolerance")
            stream._parts.append((level, part))
        if at != len(cores):
            raise ValueError("more cores than described")
        stream.chunks = int(description["chunks"])
        if stream.chunks != sum(2**level for level, _ in stream._parts):
            raise ValueError("number of chunks does not fit to the parts")
        return stream


def join(
    parts: Sequence[Part], axis: int = 0, form: Form = "concatenate", tolerance: float | None = None
) -> Part:
    """Parts next to each other along dimension `axis`, an old one or (stack) a new one.

    With a tolerance the train is rounded so that ||X - Y||_F <= tolerance ||X||_F, as far as the
    errors of the parts leave room; without, no entry changes. Parts that ranks have compressed
    apart from each other, each its own bodies, are joined so on one of them.
    """
    place = concatenate if form == "concatenate" else stack
    joined = Part(
        place([part.train for part in parts], axis),
        math.hypot(*(part.error for part in parts)),
        math.hypot(*(part.norm for part in parts)),
    )
    return joined if tolerance is None else _rounded(joined, tolerance)


def _rounded(part: Part, tolerance: float) -> Part:
    """The part rounded to an error of at most that of its norm, or itself if that cannot be."""
    allowed = tolerance * part.norm - part.error
    if allowed < 0.0:
        return part
    rounded = round_train(part.train, absolute=allowed)
    if rounded.error > allowed:
        return part
    return Part(rounded.train, part.error + rounded.error, part.norm)


def _zeros_like(part: Part) -> Part:
    return Part(zeros(part.train.shape, part.train.dtype), 0.0, 0.0)


def _share(level: int) -> float:
    """The share of the tolerance that a part of 2^level chunks may have used."""
    return 1.0 - 1.0 / (level + 2.0)


def _stated(train: TensorTrain, error: float, norm: float | None) -> Part:
    """A part of a train that stands for a chunk."""
    if norm is None:
        norm = max(train.norm() - error, 0.0)
    return Part(train, float(error), _SHORT * norm)


def _without(shape: tuple[int, ...], axis: int) -> tuple[int, ...]:
    return (*shape[:axis], -1, *shape[axis + 1 :])


def _little(core: NDArray) -> NDArray:
    return core.astype(core.dtype.newbyteorder("<"), copy=False)


def _read_train(saved: dict, data: memoryview, at: int) -> tuple[TensorTrain, int]:
    """The train described, from the bytes at `at`, and where the next one begins."""
    dtype = np.dtype(saved["dtype"])
    cores = []
    for n, (left, right) in zip(saved["shape"], pairwise(saved["ranks"]), strict=True):
        size = left * n * right * dtype.itemsize
        if min(left, n, right) < 0 or at + size > len(data):
            raise ValueError("fewer cores than described")
        values = np.frombuffer(data[at : at + size], dtype=dtype.newbyteorder("<"))
        cores.append(values.astype(dtype).reshape(left, n, right))
        at += size
    return TensorTrain(tuple(cores)), at
