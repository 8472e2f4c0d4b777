"""How a good file becomes a bad one: bytes, numbers, words and lines, by a seeded generator."""

from __future__ import annotations

import random
import re

NUMBERS = (
    b"0", b"-1", b"nan", b"-nan", b"inf", b"-inf", b"1e308", b"-1e308", b"1e-300", b"1e999",
    b"1e15", b"2147483648", b"-9223372036854775809", b"18446744073709551616", b"0x7fffffff",
    b"1_000", b"1:2",
    b"9" * 400, b"9" * 5000, b"\xd9\xa3", b"", b".", b"1e", b"--1", b"true",
)  # fmt: skip
WORDS = (
    b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"\r", b"\n\n", b"\x1b[31m", b"%s%n",
    b"../../etc/passwd",
    b"&a [*a]", b"*x", b"!!int x", b"!!timestamp y", b"2001-99-99",
    b"!!python/name:os.system", b"<<:",
    b"[" * 300, b"{" * 300, b"- " * 300, b"x" * 5000, b"~", b"null", b"yes", b"{}", b"[]", b"|",
    b"? ",
    b"FLASER", b"ROBOTLASER1 ", b"VERTEX2", b"EDGE_SE2 0 0", b"FIX 7", b"Odometry", b",", b"#",
    b'"',
)  # fmt: skip
_NUMBER = re.compile(rb"-?\d+\.?\d*")


def mutant(data: bytes, seed: int, *, is_text: bool) -> bytes:
    """Return a file with one to four things changed; the same seed gives the same.

    Args:
        data: the good file.
        seed: of every choice.
        is_text: also change numbers, words and lines.
    """
    rng = random.Random(seed)  # noqa: S311 - no secret
    changes = (*_BYTES, *_TEXT, *_TEXT) if is_text else _BYTES
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        if not out:
            break
        out = bytearray(rng.choice(changes)(rng, out))
    return bytes(out)


def _byte(rng: random.Random, data: bytearray) -> bytearray:
    """Change a byte: any, of the head, where sizes stand, or of the end, with its directories."""
    at = rng.randrange(len(data))
    at = rng.choice((at, at, at % 64, -1 - at % 200 % len(data)))
    values = (data[at] ^ 1 << rng.randrange(8), rng.randrange(256), 0, 1, 127, 128, 255)
    data[at] = rng.choice(values)
    return data


def _size(rng: random.Random, data: bytearray) -> bytearray:
    """Put a size that lies in the place of four or eight bytes."""
    width = rng.choice((4, 8))
    value = rng.choice((0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63, 2**64 - 1)) % 256**width
    at = rng.randrange(len(data))
    data[at : at + width] = value.to_bytes(width, rng.choice(("little", "big")))
    return data


def _cut(rng: random.Random, data: bytearray) -> bytearray:
    return data[: rng.randrange(len(data))]


def _drop(rng: random.Random, data: bytearray) -> bytearray:
    at = rng.randrange(len(data))
    return data[:at] + data[at + rng.choice((1, 2, 16, 100)) :]


def _double(rng: random.Random, data: bytearray) -> bytearray:
    at = rng.randrange(len(data))
    part = data[at : at + rng.choice((1, 8, 64, 500))]
    return data[:at] + part * rng.choice((2, 3, 50)) + data[at:]


def _append(rng: random.Random, data: bytearray) -> bytearray:
    return data + rng.randbytes(rng.choice((1, 10, 1000)))


def _number(rng: random.Random, data: bytearray) -> bytearray:
    found = list(_NUMBER.finditer(data))
    if not found:
        return data
    place = rng.choice(found)
    return data[: place.start()] + rng.choice(NUMBERS) + data[place.end() :]


def _word(rng: random.Random, data: bytearray) -> bytearray:
    at = rng.randrange(len(data))
    return data[:at] + rng.choice(WORDS) + data[at + rng.choice((0, 0, 3)) :]


def _line(rng: random.Random, data: bytearray) -> bytearray:
    """Drop, double, swap or cut a line."""
    lines = bytes(data).splitlines(keepends=True)
    one, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    choice = rng.randrange(4)
    if choice == 0:
        del lines[one]
    elif choice == 1:
        lines.insert(other, lines[one] * rng.choice((1, 40)))
    elif choice == 2:
        lines[one], lines[other] = lines[other], lines[one]
    else:
        lines[one] = lines[one][: rng.randrange(len(lines[one]) + 1)]
    return bytearray(b"".join(lines))


_BYTES = (_byte, _byte, _byte, _byte, _size, _cut, _drop, _double, _append)
_TEXT = (_number, _number, _word, _line)
