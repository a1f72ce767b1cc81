"""Blocks of bodies, and what codes them: a trial of coders on each field of each block.

A *block* is the share of one rank in one chunk of time steps: rows of bodies in the order of
their numbers (gid), each present from some step of the chunk up to another. A block is coded by
itself: an order of rows other than by gid is part of its bytes. What is carried from chunk to chunk
is only which coder paid before, and how large the fields were.

Symbols: T steps of the chunk; n bodies of the block; w components of a field.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from compress import coders
from compress.bounds import Bound, Errors, Target, largest, measure, norm
from compress.effort import EFFORTS, Effort
from compress.tensorize import morton_order
from dem_mpi.errors import InputError


@dataclass(frozen=True)
class FieldSpec:
    """What a field is, and which error is allowed in it.

    dtype : numpy's name of its type, like "f8"; width : components of a row;
    unit : "m/s"; shape : of one step in an array that is no set of bodies, () else;
    guide : name of the field whose integral over time this one is, like "velocity" of "position"
    """

    bound: Bound
    dtype: str = "f8"
    width: int = 1
    unit: str = "1"
    shape: tuple[int, ...] = ()
    guide: str | None = None


@dataclass(frozen=True)
class Settings:
    """How chunks are coded.

    floor [1]: relative bounds do not shrink below this share of the root mean square of all chunks
    so far; trial_every: of so many chunks one is a trial of all coders; step_size [s]: time
    between two step numbers, 0 if unknown; effort: "best" or "fast", how much time is spent on
    fewer bytes: fast takes some per cent more, 15 % at most where bounds are 1 % or closer. Raises
    ValueError for another effort and for trial_every < 1.
    """

    floor: float = 0.0
    trial_every: int = 1
    step_size: float = 0.0
    effort: str = "best"

    def __post_init__(self) -> None:
        if self.trial_every < 1:
            raise ValueError(f"trial_every {self.trial_every}: must be positive")
        if self.effort not in EFFORTS:
            raise ValueError(f"effort {self.effort!r}: must be one of {', '.join(EFFORTS)}")


DEFAULT_SETTINGS = Settings()
# Bytes an entry that change by this factor from chunk to chunk call for another trial.
JUMP = 1.5
SAMPLE = 1024
RUNS = 16  # of consecutive bodies, that a sample consists of
TELLING = 256  # bytes of a sample, below which they are heads and chance


@dataclass(frozen=True)
class Block:
    """Bodies of one rank over one chunk.

    gid : (n,) int64, ascending; fields : {name: (T, n, w)}; first, stop : (n,) int, each body is
    present in steps [first, stop) of the chunk, None: in all. Values of absent steps mean nothing.
    """

    gid: NDArray
    fields: Mapping[str, NDArray]
    first: NDArray | None = None
    stop: NDArray | None = None


@dataclass(frozen=True)
class Chunk:
    """Steps that follow each other: numbers (T,) int64, times (T,) [s], and their blocks."""

    steps: NDArray
    times: NDArray
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class CodedField:
    """A field of a block in bytes, by which coder, and the errors of what it decodes to."""

    coder: str
    data: bytes
    errors: Errors


@dataclass(frozen=True)
class CodedBlock:
    """A block in bytes: small enough to send to the rank that writes; it can be pickled.

    ends : (2, n) int32, first step of presence and the step behind the last; None: all in all
    """

    gid: NDArray
    ends: NDArray | None
    fields: Mapping[str, CodedField]

    @property
    def winners(self) -> dict[str, Winner]:
        """The coder of each field."""
        return {n: Winner.of(p.coder, len(p.data), p.errors) for n, p in self.fields.items()}

    @property
    def scales(self) -> dict[str, Scale]:
        """How large each field is."""
        return {n: Scale(p.errors.norm, p.errors.count) for n, p in self.fields.items()}


@dataclass(frozen=True)
class CodedChunk:
    """A chunk with its blocks in bytes."""

    steps: NDArray
    times: NDArray
    blocks: tuple[CodedBlock, ...]


@dataclass(frozen=True)
class Scale:
    """How large a field is over all blocks of a chunk: ||X||_F and the number of entries."""

    norm: float = 0.0
    count: int = 0

    @property
    def rms(self) -> float:
        """The root mean square of the entries."""
        return self.norm / math.sqrt(max(self.count, 1))

    def __add__(self, other: Scale) -> Scale:
        """That of both together."""
        return Scale(math.hypot(self.norm, other.norm), self.count + other.count)


@dataclass(frozen=True)
class Winner:
    """The coder that a field was coded by last, and the bytes [B] that an entry took."""

    coder: str
    rate: float

    @classmethod
    def of(cls, coder: str, size: int, errors: Errors) -> Winner:
        """That of a piece of `size` bytes with these errors."""
        return cls(coder, size / max(errors.count, 1))


@dataclass(frozen=True)
class Memory:
    """What an encoder carries from chunk to chunk; an archive can tell it (`ArchiveWriter.memory`).

    chunks : how many before; total : {field: Scale of all blocks of all of them};
    winners : {field: Winner of the last block}
    """

    chunks: int = 0
    total: Mapping[str, Scale] = field(default_factory=dict)
    winners: Mapping[str, Winner] = field(default_factory=dict)

    def after(self, winners: Mapping[str, Winner], scales: Mapping[str, Scale]) -> Memory:
        """What is carried on behind a block; `scales` are of all blocks of its chunk."""
        total = {name: self.total.get(name, Scale()) + scale for name, scale in scales.items()}
        return Memory(self.chunks + 1, total, winners)


class Encoder:
    """Codes the blocks of one rank, chunk after chunk.

    memory : what is carried on; give that of an archive to go on as if never interrupted.
    """

    def __init__(
        self,
        fields: Mapping[str, FieldSpec],
        settings: Settings = DEFAULT_SETTINGS,
        memory: Memory | None = None,
    ) -> None:
        check_fields(fields)
        self.fields = dict(fields)
        self.settings = settings
        self.memory = memory or Memory()

    def scales(self, block: Block) -> dict[str, Scale]:
        """How large each field of this block is: gather these of all ranks, in rank order."""
        steps = len(block.fields[next(iter(self.fields))])
        present = presence(block, steps)
        there = {
            name: block.fields[name] if present is None else block.fields[name][present]
            for name in self.fields
        }
        return {name: Scale(norm(values), values.size) for name, values in there.items()}

    def encode(
        self,
        block: Block,
        times: NDArray,
        scales: Sequence[Mapping[str, Scale]] | None = None,
        steps: NDArray | None = None,
    ) -> CodedBlock:
        """Code a block; times : (T,) [s] of its steps, steps : (T,) their numbers, for errors.

        `scales` are those of all blocks of the chunk, None: of this one alone. The blocks of a
        chunk share its relative bound evenly over their entries. Raises InputError for values
        that a lossy bound has no meaning for, saying where they are.
        """
        check_block(block, self.fields, len(times))
        parts = [self.scales(block)] if scales is None else scales
        whole = add_scales(self.fields, parts)
        present = presence(block, len(times))
        ends = None if present is None else presence_ends(block, len(times))
        rows = len(times) * len(block.gid) if present is None else int(present.sum())
        order = _spatial_order(block, ends)
        coded: dict[str, CodedField] = {}
        decoded: dict[str, NDArray] = {}
        for name in in_order_of_guides(self.fields):
            spec = self.fields[name]
            values = held(block.fields[name], ends)
            if spec.bound.kind != "exact" and values.dtype.kind == "f":
                _require_finite(name, values, block.gid, present, steps)
                if spec.bound.kind == "relative":
                    _require_norm(name, values, [part[name] for part in parts])
            guide = None if spec.guide is None else increments(decoded[spec.guide], times)
            context = coders.Context(guide, order)
            target = self._target(name, values.dtype, rows * spec.width, whole[name])
            coded[name], decoded[name] = self._encode_field(name, values, target, context, present)
        result = CodedBlock(block.gid, ends, {name: coded[name] for name in self.fields})
        self.memory = self.memory.after(result.winners, whole)
        return result

    def _target(self, name: str, dtype: np.dtype, count: int, whole: Scale) -> Target:
        """The error of this block: its share, by `count` entries, of what the chunk may have."""
        bound = self.fields[name].bound
        if bound.kind == "exact" or dtype.kind != "f":
            return Target(0.0, 0.0)
        if bound.kind == "pointwise":
            return Target(maximum=bound.value)
        if bound.kind == "rmse":
            allowed = bound.value * math.sqrt(count)
        else:
            before = self.memory.total.get(name, Scale()) + whole
            size = max(whole.norm, self.settings.floor * before.rms * math.sqrt(whole.count))
            allowed = bound.value * size * math.sqrt(count / max(whole.count, 1))
        # Where no number says what is allowed, nothing is.
        return Target(frobenius=allowed) if math.isfinite(allowed) else Target(0.0, 0.0)

    def _encode_field(
        self,
        name: str,
        values: NDArray,
        target: Target,
        context: coders.Context,
        present: NDArray | None,
    ) -> tuple[CodedField, NDArray]:
        """The field in the fewest bytes, and what they decode to."""
        effort = EFFORTS[self.settings.effort]
        names = coders.candidates(target, context, effort)
        last = self.memory.winners.get(name)
        periodic = self.memory.chunks % self.settings.trial_every == 0
        # What an encoder says of its decoder is put to the test now and then.
        decode = periodic if effort.thorough else self.memory.chunks == 0
        task = _Task(values, target, context, present, effort, decode)
        if last is None or last.coder not in names or periodic:
            return task.smallest(task.promising(names)) or task.exact()
        best = task.smallest((last.coder,))
        rate = math.inf
        if best is not None:
            rate = Winner.of(best[0].coder, len(best[0].data), best[0].errors).rate
        ratio = (rate + effort.slight) / max(last.rate + effort.slight, 1e-300)
        if not 1.0 / JUMP <= ratio <= JUMP:
            # Another phase of the flow may have begun, in which another coder pays.
            rest = tuple(n for n in task.promising(names) if n != last.coder)
            found = [result for result in (best, task.smallest(rest)) if result is not None]
            best = min(found, key=_length, default=None)
        return best or task.exact()


def _length(result: tuple[CodedField, NDArray]) -> int:
    return len(result[0].data)


@dataclass(frozen=True)
class _Task:
    """A field of a block to be coded: values (T, n, w), what they have to meet, and how.

    present : (T, n) whether each body is there, None: all are; decode: whether to decode even what
    an encoder says it decodes to
    """

    values: NDArray
    target: Target
    context: coders.Context
    present: NDArray | None
    effort: Effort
    decode: bool

    def promising(self, names: Sequence[str]) -> tuple[str, ...]:
        """Without those coders that take far more than the others on a sample of the bodies."""
        bodies = self.values.shape[1]
        if self.target.exact or bodies < 4 * SAMPLE:
            return tuple(names)
        # Neighbours together, for coders that use them, from all parts of the block: gids often go
        # by place, and a bed lands from below.
        starts = np.linspace(0, bodies - SAMPLE // RUNS, RUNS).astype(np.int64)
        rows = (starts[:, None] + np.arange(SAMPLE // RUNS)).ravel()
        sample = self.values[:, rows]
        share = replace(self.target, frobenius=self.target.frobenius * math.sqrt(SAMPLE / bodies))
        guide = self.context.guide
        known = coders.Context(None if guide is None else guide[:, rows])
        sized = [name for name in names if name in ("tt", "predictive", "qtt", coders.GUIDED)]
        codes = {n: coders.encode(n, sample, share, known, self.effort) for n in sized}
        # What needs more than the values is as good as what does not.
        sizes = {n: sample.nbytes if code is None else len(code) for n, code in codes.items()}
        most = max(self.effort.promising * min(sizes.values()), TELLING)
        return tuple(n for n in names if sizes.get(n, 0) <= most)

    def smallest(self, names: Sequence[str]) -> tuple[CodedField, NDArray] | None:
        """Of the coders named, the result in fewest bytes that keeps to the target."""
        best = None
        for name in names:
            data, decoded = coders.encode_and_decode(
                name, self.values, self.target, self.context, self.effort
            )
            if data is None or (best is not None and len(data) >= len(best[0].data)):
                continue
            if decoded is None or self.decode:
                decoded = self._decoded(name, data, decoded)
            errors = _measure(self.values, decoded, self.present)
            if (
                self.target.met_by(errors)
                if not self.target.exact
                else _same_bits(self.values, decoded)
            ):
                best = CodedField(name, data, errors), decoded
        return best

    def exact(self) -> tuple[CodedField, NDArray]:
        """The result that every field has: every bit kept."""
        data = coders.encode("exact", self.values, self.target)
        assert data is not None
        errors = _measure(self.values, self.values, self.present)
        return CodedField("exact", data, errors), self.values

    def _decoded(self, name: str, data: bytes, expected: NDArray | None) -> NDArray:
        values = self.values
        decoded = coders.decode(name, data, values.dtype, values.shape, self.context.guide)
        assert expected is None or _same_bits(expected, decoded), f"{name}: decodes otherwise"
        return decoded


def _spatial_order(block: Block, ends: NDArray | None) -> Callable[[], NDArray] | None:
    """The order of bodies along the Morton curve at the first step, None without such positions.

    Positions that are kept exactly need not be finite, and then have none.
    """
    position = block.fields.get("position")
    if position is None or position.shape[2] != 3 or not position.size:
        return None
    first = held(position, ends)[0]
    return (lambda: morton_order(first)) if np.isfinite(first).all() else None


def _same_bits(values: NDArray, decoded: NDArray) -> bool:
    return values.tobytes() == decoded.tobytes()


def _measure(values: NDArray, decoded: NDArray, present: NDArray | None) -> Errors:
    """Errors of the entries of bodies while they are present; NaN equal to NaN is no error."""
    if present is not None:
        values, decoded = values[present], decoded[present]
    if values.dtype.kind == "f" and not math.isfinite(largest(values)):
        finite = np.isfinite(values)
        inner = measure(values[finite], decoded[finite])
        return replace(inner, count=values.size)
    return measure(values, decoded)


# ---- blocks --------------------------------------------------------------------------------


def presence_ends(block: Block, steps: int) -> NDArray[np.int32]:
    """(2, n) first step of presence of each body, and the step behind the last."""
    ends = np.zeros((2, len(block.gid)), np.int32)
    ends[0] = 0 if block.first is None else block.first
    ends[1] = steps if block.stop is None else block.stop
    return ends


def presence(block: Block, steps: int) -> NDArray[np.bool_] | None:
    """(T, n) whether each body is there; None if all are in all steps."""
    ends = presence_ends(block, steps)
    return None if (ends[0] == 0).all() and (ends[1] == steps).all() else presence_mask(ends, steps)


def presence_mask(ends: NDArray, steps: int) -> NDArray[np.bool_]:
    """(T, n) whether step t is in [ends[0, b], ends[1, b]) of body b."""
    t = np.arange(steps)[:, None]
    return (t >= ends[0]) & (t < ends[1])


def held(values: NDArray, ends: NDArray | None) -> NDArray:
    """Values (T, n, w) with those of absent steps replaced by the nearest step of presence.

    A body that is absent throughout gets zeros.
    """
    if ends is None or not values.size:
        return np.ascontiguousarray(values)
    low, stop = ends.astype(np.int64)
    nearest = np.clip(np.arange(len(values))[:, None], low, np.maximum(stop - 1, low))
    nearest = np.minimum(nearest, len(values) - 1)
    filled = np.take_along_axis(values, nearest[:, :, None], axis=0)
    filled[:, low >= stop] = 0
    return filled


def increments(decoded: NDArray, times: NDArray) -> NDArray:
    """h_t y_t, (T, n, w) float64 with 0 for t = 0: what a field grows by from t - 1 to t."""
    return np.diff(times, prepend=times[:1])[:, None, None] * decoded.astype(np.float64, copy=False)


def add_scales(
    fields: Mapping[str, FieldSpec], scales: Sequence[Mapping[str, Scale]]
) -> dict[str, Scale]:
    """Those of all blocks together; in the order of blocks, on which the last bit depends."""
    return {name: sum((part[name] for part in scales), Scale()) for name in fields}


def in_order_of_guides(fields: Mapping[str, FieldSpec]) -> list[str]:
    """Names of fields, each behind that which guides it."""
    return sorted(fields, key=lambda name: fields[name].guide is not None)


# ---- what is refused -----------------------------------------------------------------------


def check_fields(fields: Mapping[str, FieldSpec]) -> None:
    """Raise InputError unless every field can be coded by its specification."""
    if not fields:
        raise InputError("fields: an archive needs at least one")
    for name, spec in fields.items():
        dtype = np.dtype(spec.dtype)
        if dtype.kind not in "biuf" or dtype.itemsize > 8 or not dtype.isnative:
            raise InputError(f"{name}: {dtype} is no plain number of at most 8 bytes")
        if dtype.kind == "f" and dtype.itemsize < 4 and spec.bound.kind != "exact":
            raise InputError(f"{name}: {dtype} can only be kept exactly")
        if spec.width < 1:
            raise InputError(f"{name}: width {spec.width}: must be positive")
        if spec.guide is not None:
            guide = fields.get(spec.guide)
            if guide is None or guide.guide is not None or guide.width != spec.width:
                raise InputError(f"{name}: cannot be guided by {spec.guide!r}")


def check_block(block: Block, fields: Mapping[str, FieldSpec], steps: int) -> None:
    """Raise ValueError unless the block has rows and columns as its fields demand."""
    gid = np.asarray(block.gid)
    if gid.ndim != 1 or gid.dtype.kind not in "iu" or (np.diff(gid) <= 0).any():
        raise ValueError("gid: must be integers in ascending order, each once")
    for name, spec in fields.items():
        values = block.fields.get(name)
        shape = (steps, len(gid), spec.width)
        if values is None or values.shape != shape or values.dtype != np.dtype(spec.dtype):
            found = "nothing" if values is None else f"{values.dtype} {values.shape}"
            raise ValueError(f"{name}: {spec.dtype} {shape} expected, {found} given")
    for ends in (block.first, block.stop):
        if ends is not None and (len(ends) != len(gid) or ((ends < 0) | (ends > steps)).any()):
            raise ValueError(f"presence: must be within the {steps} steps, one a body")


def _require_finite(
    name: str,
    values: NDArray,
    gid: NDArray,
    present: NDArray | None,
    steps: NDArray | None,
) -> None:
    if math.isfinite(largest(values)):
        return
    bad = ~np.isfinite(values)
    if present is not None:
        bad &= present[:, :, None]
    step, row, component = (int(i) for i in np.argwhere(bad)[0])
    when = f"{step} of the chunk" if steps is None else f"{int(steps[step])}"
    raise InputError(
        f"{name}: {values[step, row, component]} at step {when}, body {int(gid[row])}, "
        f"component {component}: only an exact bound keeps it: {_kept_by(name)}"
    )


def _require_norm(name: str, values: NDArray, parts: Sequence[Scale]) -> None:
    """Refuse values whose norm, or that of all blocks together, no number holds.

    Where another block is at fault it is for that block to say so: it knows the place.
    """
    whole = sum(parts, Scale())
    others = any(not math.isfinite(part.norm) for part in parts) and math.isfinite(norm(values))
    if not math.isfinite(whole.norm) and not others:
        raise InputError(
            f"{name}: values up to {largest(values):.3g}: their norm, which a relative bound goes "
            f"by, overflows: {_kept_by(name)}"
        )


def _kept_by(name: str) -> str:
    """How a user says that a field is to be kept exactly."""
    return f"--field {name}=exact (in a scene, {name}: exact)"
