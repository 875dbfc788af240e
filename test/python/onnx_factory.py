# SPDX-License-Identifier: MIT
"""Small ONNX networks as protobuf bytes, so that tests need neither a file nor a library."""
import struct
from typing import Sequence


def _varint(value: int) -> bytes:
    data = b""
    while value >= 0x80:
        data += bytes([value & 0x7F | 0x80])
        value >>= 7
    return data + bytes([value])


def _integer(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _bytes(field: int, value: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(value)) + value


def _text(field: int, value: str) -> bytes:
    return _bytes(field, value.encode())


def _tensor(name: str, shape: Sequence[int], values: Sequence[float]) -> bytes:
    dims = b"".join(_integer(1, n) for n in shape)
    return (
        dims
        + _integer(2, 1)
        + _text(8, name)
        + _bytes(9, struct.pack("<%df" % len(values), *values))
    )


def _value(name: str, shape: Sequence[int]) -> bytes:
    dims = b"".join(_bytes(1, _integer(1, n)) for n in shape)
    return _text(1, name) + _bytes(2, _bytes(1, _integer(1, 1) + _bytes(2, dims)))


def convolution(
    width: int, height: int, weights: Sequence[Sequence[float]], bias: Sequence[float]
) -> bytes:
    """A network of one 1x1 convolution: channel c of its output (1, n, height, width) is
    weights[c] (3 numbers) times the pixel of its input (1, 3, height, width), plus bias[c]."""
    count = len(bias)
    ones = _text(1, "kernel_shape") + _integer(8, 1) + _integer(8, 1) + _integer(20, 7)
    node = _text(1, "image") + _text(1, "weight") + _text(1, "bias") + _text(2, "scores")
    node += _text(4, "Conv") + _bytes(5, ones)
    flat = [value for row in weights for value in row]
    graph = _bytes(1, node) + _text(2, "network")
    graph += _bytes(5, _tensor("weight", (count, 3, 1, 1), flat))
    graph += _bytes(5, _tensor("bias", (count,), bias))
    graph += _bytes(11, _value("image", (1, 3, height, width)))
    graph += _bytes(12, _value("scores", (1, count, height, width)))
    return _integer(1, 7) + _bytes(7, graph) + _bytes(8, _integer(2, 11))
