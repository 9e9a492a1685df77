"""What the footer of a Parquet file claims, within the bytes that are there: no library allocates by it before.

The footer is a structure in Thrift's compact protocol; fields are numbered as in Apache Parquet's `parquet.thrift`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

MARK = b"PAR1"
LONGEST = 2**22
"""Bytes of a footer: some 10,000 parts of columns."""

_TAIL = 4 + len(MARK)
_ROWS, _GROUPS, _SCHEMA, _CHILDREN = 3, 4, 2, 5
_GROUP_COLUMNS, _GROUP_ROWS = 1, 3
_ELSEWHERE, _COLUMN = 1, 3
_VALUES, _UNPACKED, _PACKED = 5, 6, 7
_STOP, _TRUE, _FALSE, _BYTE, _I16, _I32, _I64, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = range(13)


class Footer(NamedTuple):
    """Rows, columns, values of all columns, and their bytes unpacked."""

    rows: int
    columns: int
    values: int
    unpacked: int


def read_footer(data: bytes) -> Footer:
    """The claims of the footer of a Parquet file.

    Raises ValueError where it is cut short, or contradicts itself or the size of the file.
    """
    size = int.from_bytes(data[-_TAIL : -len(MARK)], "little")
    if size > len(data) - len(MARK) - _TAIL:
        raise ValueError("its footer is longer than the file")
    if size > LONGEST:
        raise ValueError(f"its footer has {size:,} bytes, expected at most {LONGEST:,}")
    try:
        content = _Compact(data[len(data) - _TAIL - size : -_TAIL]).struct()
        rows = _count(content, _ROWS)
        groups = [(_count(group, _GROUP_ROWS), group[_GROUP_COLUMNS]) for group in content.get(_GROUPS, [])]
        chunks = [chunk for _, columns in groups for chunk in columns]
        columns = sum(_CHILDREN not in element for element in content[_SCHEMA])
        values, unpacked, packed = (
            sum(_count(chunk[_COLUMN], field) for chunk in chunks) for field in (_VALUES, _UNPACKED, _PACKED)
        )
        elsewhere = any(_ELSEWHERE in chunk for chunk in chunks)
    except (LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError("its footer is damaged") from error
    if elsewhere:
        raise ValueError("it keeps columns in other files")
    if rows != sum(own for own, _ in groups):
        raise ValueError(f"its footer has {rows:,} rows, its parts {sum(own for own, _ in groups):,}")
    if packed > len(data):
        raise ValueError(f"its columns have {packed:,} bytes, the file {len(data):,}")
    return Footer(rows, columns, values, unpacked)


def _count(struct: dict[int, Any], field: int) -> int:
    number = struct[field]
    if not isinstance(number, int) or number < 0:
        raise ValueError("its footer is damaged")
    return number


class _Compact:
    """A reader of Thrift's compact protocol; structures are dictionaries by the number of the field.

    Raises LookupError beyond the end. A list cannot claim more elements than there are bytes.
    """

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0
        self.readers: dict[int, Callable[[], Any]] = {
            _TRUE: self.byte,
            _FALSE: self.byte,
            _BYTE: self.byte,
            _I16: self.integer,
            _I32: self.integer,
            _I64: self.integer,
            _DOUBLE: lambda: self.taken(8),
            _BINARY: lambda: self.taken(self.varint()),
            _LIST: self.list,
            _SET: self.list,
            _MAP: self.map,
            _STRUCT: self.struct,
        }

    def struct(self) -> dict[int, Any]:
        found: dict[int, Any] = {}
        field = 0
        while head := self.byte():
            kind = head & 15
            field = field + (head >> 4) if head >> 4 else self.integer()
            # A field that is true or false has its value in its type.
            found[field] = kind == _TRUE if kind in (_TRUE, _FALSE) else self.readers[kind]()
        return found

    def list(self) -> list[Any]:
        head = self.byte()
        size = self.varint() if head >> 4 == 15 else head >> 4
        if size > len(self.data) - self.at:
            raise LookupError
        return [self.readers[head & 15]() for _ in range(size)]

    def map(self) -> None:
        size = self.varint()
        kinds = self.byte() if size else 0
        if size > len(self.data) - self.at:
            raise LookupError
        for _ in range(size):
            self.readers[kinds >> 4]()
            self.readers[kinds & 15]()

    def integer(self) -> int:
        value = self.varint()
        return (value >> 1) ^ -(value & 1)

    def varint(self) -> int:
        value = 0
        for shift in range(0, 70, 7):
            byte = self.byte()
            value |= (byte & 127) << shift
            if byte < 128:
                return value
        raise LookupError

    def byte(self) -> int:
        self.at += 1
        return self.data[self.at - 1]

    def taken(self, size: int) -> bytes:
        if size > len(self.data) - self.at:
            raise LookupError
        self.at += size
        return self.data[self.at - size : self.at]
