"""Blocks of bodies, and what codes them: a trial of coders on each field of each block.

A *block* is the share of one rank in one chunk of time steps: rows of bodies in the order of
their numbers (gid), each present from some step of the chunk up to another. A block is coded by
itself; what is carried from chunk to chunk is only what paid before, and in which order rows lay.

Symbols: T steps of the chunk; n bodies of the block; w components of a field.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from compress.bounds import Bound, Errors


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

    floor [unit of the field]: relative bounds do not shrink below this times the root mean square
    of all chunks so far; trial_every: chunks between trials of all coders; step_size [s]: time
    between two step numbers, 0 if unknown; effort: which coders are tried
    """

    floor: float = 0.0
    trial_every: int = 1
    step_size: float = 0.0


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
    """A block in bytes: small enough to send to the rank that writes; it can be pickled."""

    gid: NDArray
    first: NDArray | None
    stop: NDArray | None
    fields: Mapping[str, CodedField]
    order: bytes = b""


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


@dataclass(frozen=True)
class Memory:
    """What an encoder carries from chunk to chunk; an archive can tell it (`ArchiveWriter.memory`).

    chunk : chunks before; total : {field: Scale of all chunks so far, all blocks};
    winners : {field: coder and bytes of its last block}
    """

    chunk: int = 0
    total: Mapping[str, Scale] = field(default_factory=dict)
    winners: Mapping[str, tuple[str, int]] = field(default_factory=dict)


class Encoder:
    """Codes the blocks of one rank, chunk after chunk."""

    def __init__(
        self,
        fields: Mapping[str, FieldSpec],
        settings: Settings = Settings(),  # noqa: B008
        memory: Memory | None = None,
    ) -> None:
        raise NotImplementedError

    def scales(self, block: Block) -> dict[str, Scale]:
        """How large each field of this block is: gather these of all ranks, in rank order."""
        raise NotImplementedError

    def encode(self, block: Block, scales: list[dict[str, Scale]] | None = None) -> CodedBlock:
        """Code a block. `scales` are those of all blocks of the chunk, None: of this one alone.

        The blocks of a chunk share its relative bound evenly over their entries.
        Raises InputError for values that a lossy bound has no meaning for, saying where they are.
        """
        raise NotImplementedError
