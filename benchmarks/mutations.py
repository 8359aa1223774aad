"""Ways in which files come to harm, as functions of random numbers and bytes: on disks, in transfers, in exports."""

from collections.abc import Callable

import numpy as np

Mutation = Callable[[np.random.Generator, bytes], bytes]


def truncated(random: np.random.Generator, content: bytes) -> bytes:
    return content[: random.integers(1, len(content))]


def empty(random: np.random.Generator, content: bytes) -> bytes:
    del random, content
    return b""


def bytes_flipped(random: np.random.Generator, content: bytes) -> bytes:
    array = np.frombuffer(content, np.uint8).copy()
    places = random.integers(len(array), size=random.choice([1, 1, 2, 8, 64]))
    array[places] ^= random.integers(1, 256, len(places), dtype=np.uint8)
    return array.tobytes()


def head_flipped(random: np.random.Generator, content: bytes) -> bytes:
    """Flip within the first 600 bytes, where most formats say what follows."""
    return bytes_flipped(random, content[:600]) + content[600:]


def tail_flipped(random: np.random.Generator, content: bytes) -> bytes:
    """Flip within the last 600 bytes, where archives and parquet keep their directory."""
    return content[:-600] + bytes_flipped(random, content[-600:])


def blocks_swapped(random: np.random.Generator, content: bytes) -> bytes:
    a, b, c, d = np.sort(random.integers(len(content) + 1, size=4))
    return content[:a] + content[c:d] + content[b:c] + content[a:b] + content[d:]


def block_lost(random: np.random.Generator, content: bytes) -> bytes:
    a, b = np.sort(random.integers(len(content) + 1, size=2))
    return content[:a] + content[b:]


def block_zeroed(random: np.random.Generator, content: bytes) -> bytes:
    a = random.integers(len(content))
    b = min(a + random.integers(1, 513), len(content))
    return content[:a] + bytes(b - a) + content[b:]


def garbage_inserted(random: np.random.Generator, content: bytes) -> bytes:
    a = random.integers(len(content) + 1)
    return content[:a] + random.bytes(random.integers(1, 257)) + content[a:]


ANY: tuple[Mutation, ...] = (
    truncated,
    bytes_flipped,
    head_flipped,
    tail_flipped,
    blocks_swapped,
    block_lost,
    block_zeroed,
    garbage_inserted,
    empty,
)


def other_separator(random: np.random.Generator, content: bytes) -> bytes:
    return content.replace(b",", random.choice([b";", b"\t", b" ", b"|"]))


def decimal_comma(random: np.random.Generator, content: bytes) -> bytes:
    return content.replace(b",", random.choice([b";", b",", b"\t"])).replace(b".", b",")


def other_encoding(random: np.random.Generator, content: bytes) -> bytes:
    return content.decode().encode(random.choice(["latin-1", "cp1252", "utf-16", "utf-16-be", "utf-32", "utf-8-sig"]))


def header_lost(random: np.random.Generator, content: bytes) -> bytes:
    return b"".join(content.splitlines(keepends=True)[random.integers(1, 4) :])


def units_below_header(random: np.random.Generator, content: bytes) -> bytes:
    header, rest = content.split(b"\n", 1)
    return header + b"\n" + random.choice([b"s,V,m", b"[s],[V],[m]", b",V,", b"(s);(V);(m)"]) + b"\n" + rest


def ragged(random: np.random.Generator, content: bytes) -> bytes:
    lines = content.split(b"\n")
    for row in random.integers(len(lines) - 1, size=random.integers(1, 4)):
        fields = lines[row].split(b",")
        place = random.integers(len(fields))
        fields[place : place + 1] = [] if random.random() < 0.5 else [fields[place], fields[place]]
        lines[row] = b",".join(fields)
    return b"\n".join(lines)


def odd_numbers(random: np.random.Generator, content: bytes) -> bytes:
    odd = [
        b"nan",
        b"inf",
        b"-Infinity",
        b"1e400",
        b"-1e999",
        b"n/a",
        b"",
        b"--",
        b"1,5",
        b"0x10",
        b"1_0",
        b"1e",
        b"1 2",
    ]
    lines = content.split(b"\n")
    for row in random.integers(1, len(lines) - 1, size=random.integers(1, 4)):
        fields = lines[row].split(b",")
        fields[random.integers(len(fields))] = odd[random.integers(len(odd))]
        lines[row] = b",".join(fields)
    return b"\n".join(lines)


OF_TEXT: tuple[Mutation, ...] = (
    other_separator,
    decimal_comma,
    other_encoding,
    header_lost,
    units_below_header,
    ragged,
    odd_numbers,
)
