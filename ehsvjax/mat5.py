"""Whether a MATLAB file (-v5 to -v7) is built as its tags say: SciPy trusts them, and dies of a wrong one.

The file is a sequence of elements, each a tag (type and count of bytes) with its bytes; an array is an element that
holds elements: flags, dimensions, a name, then values, or arrays in cells and structs. MATLAB describes the format in
"MAT-File Format".
"""

import math
import struct
import zlib
from collections.abc import Iterator

_NUMBERS = frozenset((1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18))  # integers, floats, text
_ARRAY, _COMPRESSED = 14, 15
_SPARSE, _NUMERIC = 5, range(4, 16)  # classes of arrays: characters and numbers
_SIZED = frozenset(range(1, 16)) - {_SPARSE}  # those whose elements are all in the file
_COMPLEX = 0x08  # of the flags


def check_elements(content: bytes) -> None:
    """Raise ValueError, of a compressed one zlib.error, unless each element is of a known type and within its own."""
    order = "<" if content[126:128] == b"IM" else ">"
    for kind, body in _elements(content[128:], order):
        parts = list(_elements(zlib.decompress(body), order)) if kind == _COMPRESSED else [(kind, body)]
        for kind_inside, body_inside in parts:
            _check_array(kind_inside, body_inside, order)


def _check_array(kind: int, body: bytes, order: str) -> None:
    if kind != _ARRAY:
        raise ValueError(f"an element of type {kind} where an array should begin")
    if not body:
        return  # an empty cell
    parts = list(_elements(body, order))
    if len(parts) < 3 or len(parts[0][1]) < 8:
        raise ValueError("an array without flags, dimensions and a name")
    (flags,) = struct.unpack(order + "I", parts[0][1][:4])
    array_class, is_complex = flags & 0xFF, bool(flags >> 8 & _COMPLEX)
    if array_class in _SIZED:
        sizes = struct.unpack(f"{order}{len(parts[1][1]) // 4}i", parts[1][1][: len(parts[1][1]) // 4 * 4])
        if min(sizes, default=0) < 0 or math.prod(sizes) > len(body):
            raise ValueError(f"an array of sizes {sizes} in {len(body)} bytes")
    if array_class in _NUMERIC:
        expected = (3 if array_class == _SPARSE else 1) + is_complex
        if len(parts) != 3 + expected or any(kind not in _NUMBERS for kind, _ in parts):
            raise ValueError(f"an array of {len(parts) - 3} parts where its class has {expected} of numbers")
        return
    for kind_inside, body_inside in parts:
        if kind_inside not in _NUMBERS:
            _check_array(kind_inside, body_inside, order)


def _elements(content: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Type and bytes of each element, which begin at multiples of 8 unless they are compressed."""
    place = 0
    while place < len(content):
        if place + 8 > len(content):
            raise ValueError("the file ends within a tag")
        kind, count = struct.unpack_from(order + "II", content, place)
        begin = place + 8
        if kind >> 16:  # up to 4 bytes within the tag itself
            kind, count, begin = kind & 0xFFFF, kind >> 16, place + 4
        if (begin == place + 4 and count > 4) or begin + count > len(content):
            raise ValueError("an element is longer than what holds it")
        yield kind, content[begin : begin + count]
        end = begin + count
        place = end if kind == _COMPRESSED else max(end + -end % 8, place + 8)
