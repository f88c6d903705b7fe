"""Cuts an ONNX model to what some of its outputs need.

The runtimes compute every output of a graph, wanted or not. The graph is cut in its file's own
encoding (protobuf), as the package `onnx` is not installed with the companion.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

# Numbers of the fields in ONNX's messages.
_GRAPH, _NODE, _OUTPUT = 7, 1, 12  # of a model; of a graph
_INPUT_NAME, _OUTPUT_NAME, _VALUE_NAME = 1, 2, 1  # of a node, of a node, of an output
_BYTES_OF = {1: 8, 5: 4}  # by wire type


def cut_to_outputs(model: bytes, outputs: Collection[str]) -> bytes:
    """The model with the nodes that compute `outputs` and no others. Its nodes must be in the order
    of computation, as ONNX requires, and contain no graphs of their own.
    """
    return b"".join(
        _as_graph(_cut(content, set(outputs))) if number == _GRAPH else field
        for number, field, content in _fields(model)
    )


def _cut(graph: bytes, wanted: set[str]) -> bytes:
    kept = []
    for number, field, content in reversed(list(_fields(graph))):
        if number == _OUTPUT and not wanted.intersection(_names(content, _VALUE_NAME)):
            continue
        if number == _NODE:
            if not wanted.intersection(_names(content, _OUTPUT_NAME)):
                continue
            wanted.update(_names(content, _INPUT_NAME))
        kept.append(field)
    return b"".join(reversed(kept))


def _names(message: bytes, wanted: int) -> list[str]:
    return [content.decode() for number, _, content in _fields(message) if number == wanted]


def _fields(message: bytes) -> Iterator[tuple[int, bytes, bytes]]:
    """Number of each field, the whole field, and its content (empty for a number)."""
    at = 0
    while at < len(message):
        first = at
        key, at = _number(message, at)
        content = b""
        if key & 7 == 0:
            _, at = _number(message, at)
        elif key & 7 == 2:
            length, at = _number(message, at)
            content = message[at : at + length]
            at += length
        else:
            at += _BYTES_OF[key & 7]
        yield key >> 3, message[first:at], content


def _number(message: bytes, at: int) -> tuple[int, int]:
    """A number in seven bits a byte, the lowest first, and where it ends."""
    value = shift = 0
    while True:
        byte = message[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at


def _as_graph(content: bytes) -> bytes:
    """The field of a model that holds its graph."""
    head, length = bytearray([_GRAPH << 3 | 2]), len(content)
    while length > 127:
        head.append(length & 127 | 128)
        length >>= 7
    return bytes([*head, length]) + content
