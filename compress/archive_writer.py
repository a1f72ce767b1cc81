"""Writing archives: chunk after chunk, by one process, interrupted at any point."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from compress.coding import Chunk, CodedChunk, FieldSpec, Memory, Settings


class ArchiveWriter:
    """An archive that grows. Only one process writes: ranks send it their coded blocks."""

    def __init__(
        self,
        path: Path | str,
        fields: Mapping[str, FieldSpec],
        *,
        settings: Settings = Settings(),  # noqa: B008
        provenance: Mapping[str, Any] | None = None,
        force: bool = False,
    ) -> None:
        """Begin an archive; `provenance` are numbers and texts (JSON) kept with it.

        Raises OutputError if there is such a file (unless `force`), or it cannot be written.
        """
        raise NotImplementedError

    @classmethod
    def resume(cls, path: Path | str, last_step: int | None = None) -> ArchiveWriter:
        """Go on with an archive, interrupted or complete, behind its last whole chunk.

        Chunks with steps after `last_step` are dropped first.
        """
        raise NotImplementedError

    @property
    def last_step(self) -> int | None:
        """The last step number in the archive, None while it is empty."""
        raise NotImplementedError

    def memory(self, block: int = 0) -> Memory:
        """What the encoder of this block of each chunk has to start from (after `resume`)."""
        raise NotImplementedError

    def append(self, chunk: Chunk) -> CodedChunk:
        """Code all blocks of a chunk in this process, and append it."""
        raise NotImplementedError

    def append_coded(self, chunk: CodedChunk) -> None:
        """Append a chunk that ranks have coded. When this returns a killed process loses none."""
        raise NotImplementedError

    def close(self) -> None:
        """Complete the archive: exactly as long as what it holds."""
        raise NotImplementedError
