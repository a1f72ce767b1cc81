"""Numbers of variable length in bytes, and a reader that never runs past their end."""

from __future__ import annotations


def number(value: int) -> bytes:
    """A natural number, seven bits a byte."""
    data = bytearray()
    while value >= 0x80:
        data.append(value & 0x7F | 0x80)
        value >>= 7
    data.append(value)
    return bytes(data)


def signed(value: int) -> bytes:
    """An integer of any sign, likewise."""
    return number(2 * value if value >= 0 else -2 * value - 1)


class Bytes:
    """Reads numbers and pieces one after the other. Raises ValueError at the end of the data."""

    def __init__(self, data: bytes) -> None:
        self._data = bytes(data)
        self._at = 0

    def number(self, most: int) -> int:
        """The next natural number, which must not exceed `most`."""
        value = shift = 0
        while True:
            byte = self.take(1)[0]
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                break
            if shift > 63:
                raise ValueError("coded block: a number without end")
        if value > most:
            raise ValueError(f"coded block: {value} where at most {most} is possible")
        return value

    def signed(self, most: int) -> int:
        """The next integer, of a magnitude of at most `most`."""
        value = self.number(2 * most)
        return value // 2 if value % 2 == 0 else -(value + 1) // 2

    def take(self, count: int) -> bytes:
        """The next `count` bytes."""
        if count > len(self._data) - self._at:
            raise ValueError("coded block: ends too early")
        self._at += count
        return self._data[self._at - count : self._at]

    def peek(self) -> bytes:
        """All bytes that are left, which stay to be read."""
        return self._data[self._at :]

    def rest(self) -> bytes:
        """All bytes that are left."""
        return self.take(len(self._data) - self._at)
