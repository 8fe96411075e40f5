"""Thrift's compact protocol, read and written without a schema: what parquet's headers are made of.

A struct becomes a dict from the field's number to its type and value, a list a pair of its
elements' type and the elements; all others become Python's own. See [1] for the encoding.

References:
    [1] Apache Thrift, "Thrift compact protocol encoding", doc/specs/thrift-compact-protocol.md.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

TRUE, FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, MAP, STRUCT = range(1, 13)
"""Types of values, by their numbers in the encoding."""

type Struct = dict[int, Field]

_DEEPEST = 32
_LONGEST = 1 << 20


class Field(NamedTuple):
    """A value and its type."""

    kind: int
    value: Any


class Malformed(ValueError):
    """The bytes are no such message."""


class Reader:
    """Reads values from bytes.

    Args:
        data: The bytes.
        place: Where it begins.

    Attributes:
        place: Where it is.
    """

    def __init__(self, data: bytes | memoryview, place: int = 0) -> None:
        self._data, self.place = data, place

    def read_struct(self, depth: int = 0) -> Struct:
        """Read a struct.

        Raises:
            Malformed: If the bytes end before, or make no sense.
        """
        if depth > _DEEPEST:
            raise Malformed("structs too deep")
        fields: Struct = {}
        number = 0
        while head := self._take(1)[0]:
            kind, delta = head & 0x0F, head >> 4
            number = number + delta if delta else self._read_zigzag()
            fields[number] = Field(kind, self._read(kind, depth))
        return fields

    def _read(self, kind: int, depth: int) -> Any:
        value: Any
        if kind in (TRUE, FALSE):
            value = kind == TRUE
        elif kind in (I16, I32, I64):
            value = self._read_zigzag()
        elif kind == BYTE:
            value = self._take(1)[0]
        elif kind == DOUBLE:
            value = struct.unpack("<d", self._take(8))[0]
        elif kind == BINARY:
            value = bytes(self._take(self._read_varint()))
        elif kind in (LIST, SET):
            value = self._read_list(depth)
        elif kind == STRUCT:
            value = self.read_struct(depth + 1)
        else:
            raise Malformed(f"type {kind}")
        return value

    def _read_list(self, depth: int) -> tuple[int, list[Any]]:
        head = self._take(1)[0]
        count = head >> 4
        count = self._read_varint() if count == 0x0F else count
        if count > _LONGEST:
            raise Malformed(f"a list of {count}")
        inner = head & 0x0F
        return inner, [self._read_element(inner, depth) for _ in range(count)]

    def _read_element(self, kind: int, depth: int) -> Any:
        # In a list, a flag is a byte of its own.
        return self._take(1)[0] == TRUE if kind in (TRUE, FALSE) else self._read(kind, depth)

    def _read_varint(self) -> int:
        value = shift = 0
        while True:
            byte = self._take(1)[0]
            value |= (byte & 0x7F) << shift
            if not byte & 0x80:
                return value
            shift += 7
            if shift > 63:
                raise Malformed("a number too long")

    def _read_zigzag(self) -> int:
        value = self._read_varint()
        return (value >> 1) ^ -(value & 1)

    def _take(self, count: int) -> bytes | memoryview:
        if count < 0 or self.place + count > len(self._data):
            raise Malformed("cut off")
        piece = self._data[self.place : self.place + count]
        self.place += count
        return piece


def write_struct(fields: Struct) -> bytes:
    """Write a struct as `Reader.read_struct` reads it."""
    out = bytearray()
    last = 0
    for number in sorted(fields):
        kind, value = fields[number]
        if kind in (TRUE, FALSE):
            kind = TRUE if value else FALSE
        delta = number - last
        if 0 < delta <= 0x0F:
            out.append(delta << 4 | kind)
        else:
            out.append(kind)
            out += _write_zigzag(number)
        last = number
        if kind not in (TRUE, FALSE):
            out += _write(kind, value)
    out.append(0)
    return bytes(out)


def _write(kind: int, value: Any) -> bytes:
    if kind in (I16, I32, I64):
        return _write_zigzag(value)
    if kind == BYTE:
        return bytes([value])
    if kind == DOUBLE:
        return struct.pack("<d", value)
    if kind == BINARY:
        return _write_varint(len(value)) + value
    if kind in (LIST, SET):
        inner, elements = value
        count = len(elements)
        head = bytes([count << 4 | inner]) if count < 0x0F else bytes([0xF0 | inner])
        head += b"" if count < 0x0F else _write_varint(count)
        flags = inner in (TRUE, FALSE)
        parts = [bytes([TRUE if e else FALSE]) if flags else _write(inner, e) for e in elements]
        return head + b"".join(parts)
    if kind == STRUCT:
        return write_struct(value)
    raise Malformed(f"type {kind}")


def _write_varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _write_zigzag(value: int) -> bytes:
    return _write_varint((value << 1) ^ (value >> 63))
