"""What may be in a model file: a plain graph of standard operators with its weights inside, and nothing that leads out of it.

ONNX files can name other files as their weights, bring loops and functions, and ask for operators of other people's
libraries. Networks of this package need none of that, so a file that has it is refused before onnxruntime sees it. Only
the few fields that matter are read, by the wire format of Protocol Buffers and the numbers of onnx.proto.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

from edgefilter.errors import ModelError

MOST_BYTES = 512 * 2**20
STANDARD = (b"", b"ai.onnx")
OWN_OPERATORS = ((b"com.microsoft", b"DynamicQuantizeLSTM"),)
"""Library and name of operators beside the standard ones: onnxruntime's own, which int8 variants are made of."""
SHIPPED = {
    "crnn.onnx": "ab3b1c9ea0a1e5601f4942aa8ad161852121db9af3c2cad511e95df6a6ec571a",
    "crnn_int8.onnx": "43b32629814fba62d568eb0162784cf4f8a1621643e64a69f109321e524c6872",
}
"""sha256 of the files in models/, as MODELS.md lists them."""

# numbers of fields in onnx.proto: ModelProto, GraphProto, NodeProto, AttributeProto, SparseTensorProto, TensorProto
GRAPH, TRAINING, FUNCTIONS = 7, 20, 25
NODE, INITIALIZER, SPARSE_INITIALIZER = 1, 5, 15
OPERATOR, ATTRIBUTE, DOMAIN = 4, 5, 7
TENSOR, SUBGRAPH, TENSORS, SUBGRAPHS, SPARSE, SPARSES = 5, 6, 10, 11, 22, 23
PARTS_OF_SPARSE = (1, 2)
EXTERNAL_DATA, DATA_LOCATION = 13, 14


class _Refused(Exception):
    """What the file has that it may not have."""


def read_model(path: Path) -> bytes:
    """The bytes of a model file that is a plain graph; raises ModelError for any other."""
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise _Refused(f"is {size} bytes long, expected at most {MOST_BYTES}")
        content = path.read_bytes()
        _check_model(memoryview(content))
        return content
    except OSError as error:
        raise ModelError(f"model {path} cannot be read ({error.strerror}): check the path") from None
    except _Refused as refused:
        raise ModelError(f"model {path} cannot be loaded (it {refused}): export it again") from None


def digest(path: Path) -> str:
    """sha256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def check_shipped(path: Path) -> None:
    """Raise ModelError where a file that came with the package is not, bit by bit, the one that the package was tested with."""
    expected = SHIPPED.get(path.name)
    if expected and digest(path) != expected:
        raise ModelError(
            f"model {path} is not the one that belongs to this edgefilter (its sha256 is another): reinstall edgefilter,"
            " or name a model of your own with --model"
        )


def _check_model(data: memoryview) -> None:
    graphs = 0
    for field, value in _fields(data):
        if field == FUNCTIONS:
            raise _Refused("brings functions of its own, expected a graph of standard operators")
        if field == TRAINING:
            raise _Refused("brings steps of training, expected a graph alone")
        if field == GRAPH:
            graphs += 1
            _check_graph(_message(value))
    if not graphs:
        raise _Refused("holds no graph, so it is no ONNX model")


def _check_graph(data: memoryview) -> None:
    for field, value in _fields(data):
        if field == NODE:
            _check_node(_message(value))
        elif field == INITIALIZER:
            _check_tensor(_message(value))
        elif field == SPARSE_INITIALIZER:
            _check_sparse(_message(value))


def _check_node(data: memoryview) -> None:
    domain, operator = b"", b""
    for field, value in _fields(data):
        if field == DOMAIN:
            domain = bytes(_message(value))
        elif field == OPERATOR:
            operator = bytes(_message(value))
        elif field == ATTRIBUTE:
            _check_attribute(_message(value))
    if domain not in STANDARD and (domain, operator) not in OWN_OPERATORS:
        name = domain[:40].decode("latin-1")
        raise _Refused(f"asks for operators of the library {name!a}, expected standard ones")


def _check_attribute(data: memoryview) -> None:
    for field, value in _fields(data):
        if field in (SUBGRAPH, SUBGRAPHS):
            raise _Refused("has a loop or a branch, expected a plain graph")
        if field in (TENSOR, TENSORS):
            _check_tensor(_message(value))
        elif field in (SPARSE, SPARSES):
            _check_sparse(_message(value))


def _check_sparse(data: memoryview) -> None:
    for field, value in _fields(data):
        if field in PARTS_OF_SPARSE:
            _check_tensor(_message(value))


def _check_tensor(data: memoryview) -> None:
    for field, value in _fields(data):
        if field == EXTERNAL_DATA or (field == DATA_LOCATION and value):
            raise _Refused("takes its weights from other files, expected them inside")


def _message(value: memoryview | int) -> memoryview:
    if isinstance(value, int):
        raise _Refused("is damaged (a number where a part was expected)")
    return value


def _fields(data: memoryview) -> Iterator[tuple[int, memoryview | int]]:
    """Number and value of each field: bytes where it has a length, else a number."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        kind = key & 7
        if kind == 0:
            value, at = _varint(data, at)
            yield key >> 3, value
            continue
        if kind == 2:
            size, at = _varint(data, at)
        elif kind in (1, 5):
            size = 8 if kind == 1 else 4
        else:
            raise _Refused("is damaged, or no ONNX model (a field of no known kind)")
        if at + size > len(data):
            raise _Refused("is truncated, or no ONNX model (a field is longer than what is there)")
        yield key >> 3, data[at : at + size]
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """The number that begins at, seven bits a byte, and where it ends."""
    value = 0
    for place in range(10):
        if at + place >= len(data):
            raise _Refused("is truncated, or no ONNX model (it ends within a number)")
        byte = data[at + place]
        value |= (byte & 127) << (7 * place)
        if byte < 128:
            return value, at + place + 1
    raise _Refused("is damaged, or no ONNX model (a number of more than 64 bits)")
