"""Files that once ended in a traceback, hung, filled the memory, or were taken silently."""

from __future__ import annotations

import gzip
from collections.abc import Callable

Make = Callable[[bytes], bytes]


def line(key: bytes, value: bytes) -> Make:
    """Return what gives a key of a YAML file another value."""

    def make(good: bytes) -> bytes:
        rest = [one for one in good.splitlines() if not one.startswith(key + b":")]
        return b"\n".join([*rest, key + b": " + value, b""])

    return make


def text(data: bytes) -> Make:
    """Return what gives a file of its own."""
    return lambda _: data


def packed(head: bytes, part: bytes, times: int) -> Make:
    """Return what gives a packed file of many equal parts, made when it is asked for."""
    return lambda _: gzip.compress(head + part * times)


LONG = b"9" * 5000
# What `tests/io/test_yaml_file.py` does not try: all readers of YAML share one.
YAML: dict[str, Make] = {
    "a date that is none": text(b"seed: 2001-99-99\nname: 2001-99-99\ndistances: 2001-99-99\n"),
    "5000 digits": text(b"seed: " + LONG + b"\n"),
    "5000 hexadecimal digits": text(b"world: 0x" + b"f" * 5000 + b"\n"),
    "a value that holds itself": text(b"&a [*a]"),
    "100 000 letters": text(b"distances: " + b"x" * 100_000),
    "a start of two lines": text(b'start: {map_a: "1\\n.0,2,0.1"}\n'),
}
MAP: dict[str, Make] = {
    "a resolution of 5000 digits": line(b"resolution", LONG),
    "a threshold of 5000 digits": line(b"free_thresh", LONG),
    "an image that is a device": line(b"image", b"/dev/zero"),
    "an image that is the file itself": line(b"image", b"map.yaml"),
    "an image of 5000 letters": line(b"image", b"x" * 5000),
    "an image with a zero byte": line(b"image", b'"a\\0b"'),
}
PICTURE: dict[str, Make] = {
    "a side of 10 digits": text(b"P5\n9999999999 9999999999\n255\n"),
    "a side of 5000 digits": text(b"P5\n" + LONG + b" 1\n255\n"),
    "a bomb": packed(b"P5\n4000000 4000000\n255\n", b"\0", 2**20),
}
ROWS: dict[str, Make] = {
    "empty": text(b""),
    "a number of 5000 digits": text(LONG + b" " + b"x " * 5 + b"\n"),
    "zero bytes": text(bytes(1000)),
    "one line of 17 MiB": text(b"1 " * (17 << 19)),
    "a bomb of lines": packed(b"", b"1 2 3 " * 200 + b"\n", 2**23 // 1201),
    "a bomb of zeros": packed(b"", b"\0", 2**25),
    "half a packed file": text(gzip.compress(b"1 2 3 4\n" * 1000)[:40]),
}
CORPUS: dict[str, tuple[str, str, Make]] = {
    **{
        f"{reader}: {name}": (reader, ".yaml", make)
        for reader in ("settings", "course", "distances", "map")
        for name, make in YAML.items()
    },
    **{f"map: {name}": ("map", ".yaml", make) for name, make in MAP.items()},
    **{f"picture: {name}": ("picture", "p5.pgm", make) for name, make in PICTURE.items()},
    **{
        f"{reader}: {name}": (reader, suffix, make)
        for reader, suffix in (
            ("trajectory", ".tum"),
            ("relations", ".relations"),
            ("scan odometry", ".csv"),
            ("graph", ".g2o"),
            ("log", ".log"),
            ("log", ".dat"),
        )
        for name, make in ROWS.items()
    },
    "settings: a list of ten million numbers": (
        "settings",
        ".yaml",
        text(b"experiment: {failures: {rotations: 0..1e12}}\n"),
    ),
    "settings: a start of 5000 digits": (
        "settings",
        ".yaml",
        line(b"start", b"{a: [" + LONG + b"]}"),
    ),
    "course: people without end": ("course", ".yaml", line(b"people", b"1" + b"0" * 300)),
    "live state: zeros": ("live state", ".state", text(bytes(1000))),
    "state: zeros": ("state", ".state", text(bytes(1000))),
}
