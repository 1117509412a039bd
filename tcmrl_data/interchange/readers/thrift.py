"""Thrift's compact protocol, in which Parquet writes its records, for bytes of unknown origin.

Records become dictionaries by field number, lists become lists. Nothing is allocated on the word of a length:
every value takes at least one byte, and the bytes that are not text are limited.
https://github.com/apache/thrift/blob/master/doc/specs/thrift-compact-protocol.md
"""

from typing import Any

Fields = dict[int, Any]

MOST_BYTES = 2**19
DEEPEST = 16
_TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _STRUCT = 1, 2, 3, 7, 8, 9, 10, 12
_INTEGERS = (4, 5, 6)
_LONGEST_INTEGER = 10
_LONG_LIST = 15


class CompactReader:
    """Reads records of a buffer one behind the other.

    Args:
        data: the buffer.

    Raises:
        ValueError: the bytes are no records, end too early, or are too many; methods raise it too.
    """

    def __init__(self, data: bytes) -> None:
        self._data, self._left = data, MOST_BYTES
        self.position = 0

    def record(self, depth: int = 0) -> Fields:
        """The record at the current position."""
        fields: Fields = {}
        number = 0
        while head := self._byte():
            delta, kind = head >> 4, head & 15
            number = number + delta if delta else self._integer()
            is_truth = kind in (_TRUE, _FALSE)  # whose value is its kind, except in lists
            fields[number] = kind == _TRUE if is_truth else self._value(kind, depth)
        return fields

    def _value(self, kind: int, depth: int) -> Any:
        if depth > DEEPEST:
            raise ValueError("holds records within records without end")
        if kind in (_TRUE, _FALSE):
            return self._byte() == _TRUE
        if kind == _BYTE:
            return self._byte()
        if kind in _INTEGERS:
            return self._integer()
        if kind == _DOUBLE:
            return self._bytes(8)
        if kind == _BINARY:
            return self._bytes(self._unsigned())
        if kind in (_LIST, _SET):
            head = self._byte()
            size, item = head >> 4, head & 15
            size = self._unsigned() if size == _LONG_LIST else size
            return [self._value(item, depth + 1) for _ in range(size)]
        if kind == _STRUCT:
            return self.record(depth + 1)
        raise ValueError(f"holds a value of unknown kind {kind}")

    def _integer(self) -> int:
        value = self._unsigned()
        return (value >> 1) ^ -(value & 1)

    def _unsigned(self) -> int:
        value = 0
        for place in range(_LONGEST_INTEGER):
            byte = self._byte()
            value |= (byte & 127) << (7 * place)
            if byte < 128:
                return value
        raise ValueError("holds a number without end")

    def _byte(self) -> int:
        self._left -= 1
        if self._left < 0:
            raise ValueError(f"is longer than {MOST_BYTES} bytes")
        return self._bytes(1)[0]

    def _bytes(self, size: int) -> bytes:
        found = self._data[self.position : self.position + size]
        if len(found) < size:
            raise ValueError("ends too early")
        self.position += size
        return found
