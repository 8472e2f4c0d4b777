"""One reader of YAML: whatever a file holds ends in values or in one error, soon."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamfusion.errors import ConfigError, MapFileError
from slamfusion.io.files import SMALL_BYTES
from slamfusion.io.yaml_file import DEPTH_MAX, VALUES_MAX, read_yaml

pytestmark = pytest.mark.once


def nine_levels() -> str:
    """Return ten lines that stand for 9 ** 10 values."""
    lines = ["a0: &a0 [" + ", ".join("x" * 9) + "]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 10)]
    return "\n".join(lines)


REFUSED = {
    "no date": ("seed: 2001-99-99", "not YAML (month must be in 1..12)"),
    "no time": ("!!timestamp x", "not YAML (a value that is none of its kind)"),
    "no integer": ('seed: !!int "abc"', "not YAML (invalid literal for int()"),
    "long integer": ("seed: " + "1" * 5000, "not YAML (Exceeds the limit"),
    "no base 64": ('seed: !!binary "a"', "not YAML (failed to decode base64 data"),
    "code": ("!!python/object/apply:os.system [true]", "could not determine a constructor"),
    "open brackets": ("[" * 20_000, f"more than {DEPTH_MAX} levels of nesting"),
    "closed brackets": ("[" * 900 + "]" * 900, f"more than {DEPTH_MAX} levels of nesting"),
    "deep block": ("".join(f"{' ' * i}- \n" for i in range(900)), "levels of nesting"),
    "aliases": (nine_levels(), f"more than {VALUES_MAX} values"),
    "itself": ("&a [*a]", "levels of nesting"),
    "merged": ("a: &a {x: 1}\nb: &b {<<: [*a, *b]}", "levels of nesting"),
    "no alias": ("a: *b", "found undefined alias"),
    "list as key": ("? [1, 2]\n: 3", "found unhashable key"),
    "a key twice": ("a: {b: 0.05, c: 1, b: 0.1}", "not YAML (the key 'b' occurs 2 times)"),
    "control": ("a: \x00", "special characters are not allowed"),
    "long tag": ("!" + "t" * 100_000 + " x", "could not determine a constructor"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_yaml_is_one_short_error(tmp_path: Path, case: str) -> None:
    text, words = REFUSED[case]
    path = tmp_path / "a.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        read_yaml(path, ConfigError, "settings")
    message = str(caught.value)
    assert message.startswith(f"{path}: not YAML (")
    assert words in message
    assert "\n" not in message
    assert len(message) < 200 + 2 * len(str(path)) + 100


def test_bytes_that_are_no_utf8_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes("seed: 1".encode("utf-16"))
    with pytest.raises(MapFileError, match="wanted settings in UTF-8, found other bytes"):
        read_yaml(path, MapFileError, "settings")


def test_a_mebibyte_is_read_and_one_byte_more_is_not(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(b"a: 1\n" + b"#" * (SMALL_BYTES - 5))
    assert read_yaml(path, ConfigError, "settings") == {"a": 1}
    path.write_bytes(b"a: 1\n" + b"#" * (SMALL_BYTES - 4))
    with pytest.raises(ConfigError, match=r"settings of at most 1\.0 MiB, found more"):
        read_yaml(path, ConfigError, "settings")


def test_values_are_counted_to_the_last(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a: &a [1, 2]\nb: [*a, *a]\n", encoding="utf-8")
    assert read_yaml(path, ConfigError, "settings") == {"a": [1, 2], "b": [[1, 2], [1, 2]]}
    # A list of lists: each alias of ten thousand values counts as often as it stands.
    row = "- &a [" + ",".join(["1"] * 9_998) + "]\n"
    path.write_text(row + "- *a\n" * 9, encoding="utf-8")
    assert len(read_yaml(path, ConfigError, "settings")) == 10
    path.write_text(row + "- *a\n" * 10, encoding="utf-8")
    with pytest.raises(ConfigError, match=f"more than {VALUES_MAX} values"):
        read_yaml(path, ConfigError, "settings")


def test_texts_stay_as_they_are_written(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a: 1e-3\nb: 2001-99-99\nc: yes\n", encoding="utf-8")
    texts = {"a": "1e-3", "b": "2001-99-99", "c": "yes"}
    assert read_yaml(path, ConfigError, "settings", as_text=True) == texts


def test_numbers_may_have_an_exponent_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("[1e-1, -2E3, .5e+1, 1.5e3, 3e5m, e5]", encoding="utf-8")
    assert read_yaml(path, ConfigError, "settings") == [0.1, -2e3, 5.0, 1.5e3, "3e5m", "e5"]
