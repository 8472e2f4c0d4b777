"""The one configuration tree: frozen dataclasses, all defaults here and nowhere else.

Every field carries its help text, unit, range and level (``public`` or ``expert``) as metadata.
The command line builds its options from them, the nodes their parameters, the documentation its
tables. ``__init__.pyi`` lists the names; a module is loaded when one of its names is asked for.
"""

from __future__ import annotations

from slamfusion.lazy_names import lazy_names

__all__, __getattr__ = lazy_names(__name__, __file__)
