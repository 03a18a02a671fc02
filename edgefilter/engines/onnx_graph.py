"""What an ONNX file asks for, read from its bytes before any library opens it: onnx.proto's fields, protobuf's wire format."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

MOST_FIELDS = 1_000_000
"""Fields that are read of a file: a second of computing. The largest network of models/ has 6,000."""
_ELSEWHERE = "takes its weights from other files, expected them inside"
_LOOPS = "has graphs within its graph (Loop, If, Scan), expected one that runs straight on"
_FUNCTIONS = "has functions of its own, expected standard operators alone"
_FOREIGN = "has operators of the domain '{}', expected only those of ONNX and of ONNX Runtime"
# by number each field that holds more of its kind, or that none may hold: what is wrong then
_TENSOR = {13: _ELSEWHERE, 14: _ELSEWHERE}
_SPARSE = {1: _TENSOR, 2: _TENSOR}
_ATTRIBUTE = {5: _TENSOR, 6: _LOOPS, 10: _TENSOR, 11: _LOOPS, 22: _SPARSE, 23: _SPARSE}
_NODE = {5: _ATTRIBUTE, 7: _FOREIGN}
_GRAPH = {1: _NODE, 5: _TENSOR, 15: _SPARSE}
_MODEL = {7: _GRAPH, 20: _LOOPS, 25: _FUNCTIONS}
_HARMLESS = {_ELSEWHERE: (0,), _FOREIGN: (b"", b"ai.onnx", b"com.microsoft")}
"""What such a field may hold all the same: that data are inside; the standard operators, and those that ONNX Runtime itself has."""


def refusal(content: bytes) -> str | None:
    """Why a model must not be opened: weights in other files, loops and branches, functions, operators of other libraries.

    None where nothing is wrong. Raises ValueError for bytes that are no protobuf, as far as they were read.
    """
    left = iter(range(MOST_FIELDS))

    def wrong(message: memoryview, form: dict[int, Any]) -> str | None:
        for number, value in _fields(message):
            if next(left, None) is None:
                raise ValueError(f"more than {MOST_FIELDS} fields")
            below = form.get(number)
            if isinstance(below, str):
                found = value if isinstance(value, int) else bytes(value[:80])
                if found not in _HARMLESS.get(below, ()):
                    return below.format(found.decode(errors="replace") if isinstance(found, bytes) else found)
            elif below and isinstance(value, memoryview) and (said := wrong(value, below)):
                return said
        return None

    return wrong(memoryview(content), _MODEL)


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield (field number, value) of each protobuf field: an int for a varint, otherwise the field's bytes."""
    at = 0
    while at < len(message):
        tag, at = _varint(message, at)
        number, kind = tag >> 3, tag & 7
        if kind == 0:
            value, at = _varint(message, at)
            yield number, value
            continue
        if kind == 2:
            size, at = _varint(message, at)
        else:
            size = {1: 8, 5: 4}.get(kind, -1)
        # libraries cut longer tags to 32 bits: they would read another field than is seen here
        if not 0 < number < 1 << 29 or not 0 <= size <= len(message) - at:
            raise ValueError(
                f"field {number} (wire type {kind}) says {size} bytes, and the message ends after {len(message) - at}"
            )
        yield number, message[at : at + size]
        at += size


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """A number of up to ten bytes of seven bits each, the lowest first, and where it ends."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(message):
            break
        byte = message[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise ValueError("a number that does not end")
