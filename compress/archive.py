"""Archives: one HDF5 file of coded chunks (`archive_format` says how it lies in the file).

with ArchiveWriter(path, {"velocity": FieldSpec(Bound("relative", 1e-2), width=3)}) as writer:
    writer.append(Chunk(steps, times, (Block(gid, {"velocity": v}),)))

with Archive(path) as archive:
    some = archive.read(["velocity"], steps=slice(100, 200), bodies=slice(0, 1000))
"""

from compress.archive_reader import Archive, Restored
from compress.archive_writer import ArchiveWriter
from compress.coding import Block, Chunk, CodedBlock, CodedChunk, Encoder, FieldSpec, Settings

__all__ = [
    "Archive",
    "ArchiveWriter",
    "Block",
    "Chunk",
    "CodedBlock",
    "CodedChunk",
    "Encoder",
    "FieldSpec",
    "Restored",
    "Settings",
]
