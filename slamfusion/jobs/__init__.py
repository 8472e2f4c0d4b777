"""The work behind the commands: plain functions that return records; none parses or prints.

A second function of each module writes the files of the first, all or none, and returns the JSON
document of the command. A module in ``__init__.pyi`` is loaded when it is first asked for, so that
the help of a command needs none of them.
"""

from __future__ import annotations

from slamfusion.lazy_names import lazy_names

__all__, __getattr__ = lazy_names(__name__, __file__)
