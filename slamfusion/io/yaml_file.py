"""Read YAML files of at most 1 MiB.

Values are counted while reading, aliases as often as they are used, so that a short file cannot
become a large value. Every failure of PyYAML is one error.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from slamfusion.errors import SlamFusionError, shown
from slamfusion.io.files import read_small

# 1 MiB of measured distances is 90 000 values; settings and courses have some hundred.
VALUES_MAX = 100_000
DEPTH_MAX = 50


class _LimitError(yaml.YAMLError):
    """The text exceeds a limit."""


class _Counted:
    """Counts composed nodes; a base class in front of a loader."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)  # type: ignore[call-arg]
        self._values = 0
        self._depth = 0
        # Values below each anchor, the anchor's own included.
        self._sizes: dict[str, int] = {}

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose one value and those below it."""
        loader: Any = self
        event = loader.peek_event()
        anchor = event.anchor
        if isinstance(event, yaml.AliasEvent):
            if anchor in loader.anchors and anchor not in self._sizes:
                raise _LimitError(f"the value of &{shown(anchor)} holds itself")
            self._add(self._sizes.get(anchor, 1))
            return super().compose_node(parent, index)  # type: ignore[misc]
        before = self._values
        self._add(1)
        self._depth += 1
        if self._depth > DEPTH_MAX:
            raise _LimitError(f"more than {DEPTH_MAX} levels of nesting")
        node = super().compose_node(parent, index)  # type: ignore[misc]
        self._depth -= 1
        if anchor is not None:
            self._sizes[anchor] = self._values - before
        return node

    def _add(self, count: int) -> None:
        self._values += count
        if self._values > VALUES_MAX:
            message = f"more than {VALUES_MAX} values, aliases counted as often as they are used"
            raise _LimitError(message)


class _Values(_Counted, yaml.SafeLoader):
    """Plain values: numbers, texts, booleans, lists, mappings."""


class _Texts(_Counted, yaml.BaseLoader):
    """Texts, lists and mappings: 1e-3 and 0.05 stay as they are written."""


def read_yaml(
    path: str | Path, error: type[SlamFusionError], what: str, *, as_text: bool = False
) -> Any:
    """Return the values of a YAML file; None (as text: empty) if it is empty."""
    data = read_small(Path(path), error, what)
    try:
        loader: Any = _Texts if as_text else _Values
        return yaml.load(data.decode("utf-8-sig"), Loader=loader)  # noqa: S506 - both are safe
    except UnicodeDecodeError:
        message = f"{path}: wanted {what} in UTF-8, found other bytes; save it as UTF-8"
        raise error(message) from None
    except Exception as failure:  # noqa: BLE001 - values that are none fail in PyYAML in many ways
        reason = "a value that is none of its kind"
        if isinstance(failure, (yaml.YAMLError, ValueError)):
            reason = " ".join(str(failure).split())[:200]
        raise error(f"{path}: not YAML ({reason}); fix the file or give {what}") from None
