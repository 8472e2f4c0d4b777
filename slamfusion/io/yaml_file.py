"""Read YAML files of at most 1 MiB.

Values are counted, aliases as often as they are used, so that a short file cannot become a large
value. A key that occurs twice is refused, because programs differ in which of both they use. Every
failure of PyYAML is one error.
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import yaml

from slamfusion.errors import SlamFusionError
from slamfusion.io.files import read_small

# 1 MiB of measured distances is 90 000 values; settings and courses have some hundred.
VALUES_MAX = 100_000
DEPTH_MAX = 50


class Loader(yaml.SafeLoader):
    """PyYAML's, with the numbers of YAML 1.2 and JSON that have an exponent alone: ``1e-1``."""


Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)

_TOO_DEEP = f"more than {DEPTH_MAX} levels of nesting"


def read_yaml(
    path: str | Path, error: type[SlamFusionError], what: str, *, as_text: bool = False
) -> Any:
    """Return the values of a YAML file; None (as text: empty) if it is empty."""
    data = read_small(Path(path), error, what)
    try:
        loader = (yaml.BaseLoader if as_text else Loader)(data.decode("utf-8-sig"))
        node = loader.get_single_node()
        if node is None:
            return None
        _check_nodes(node)
        return loader.construct_document(node)
    except UnicodeDecodeError:
        message = f"{path}: wanted {what} in UTF-8, found other bytes; unpack it or save it so"
        raise error(message) from None
    except Exception as failure:  # noqa: BLE001 - values that are none fail in PyYAML in many ways
        reason = "a value that is none of its kind"
        if isinstance(failure, RecursionError):
            reason = _TOO_DEEP
        elif isinstance(failure, (yaml.YAMLError, ValueError)):
            reason = " ".join(str(failure).split())[:200]
        raise error(f"{path}: not YAML ({reason}); fix the file or give {what}") from None


def _check_nodes(node: yaml.Node) -> None:
    """Refuse a key that occurs twice, too many values, and too deep ones, as is one in itself."""
    left, count = [(node, 1)], 0
    while left:
        item, depth = left.pop()
        count += 1
        if depth > DEPTH_MAX:
            raise ValueError(_TOO_DEEP)
        if count > VALUES_MAX:
            message = f"more than {VALUES_MAX} values, aliases counted as often as they are used"
            raise ValueError(message)
        if isinstance(item, yaml.SequenceNode):
            left += [(own, depth + 1) for own in item.value]
        elif isinstance(item, yaml.MappingNode):
            keys = Counter(key.value for key, _ in item.value if isinstance(key, yaml.ScalarNode))
            for key, times in keys.items():
                if times > 1:
                    raise ValueError(f"the key {key!r} occurs {times} times")
            left += [(own, depth + 1) for pair in item.value for own in pair]
