"""The producers of maps, each in a folder of its own, and what they have in common.

``tinyslam``, ``gmapping`` and ``graph`` are one SLAM each; ``common`` holds the ``Mapper`` protocol
that they keep, the scan matcher, the tiled maps and the run over a log; ``registry`` knows them by
name and ``side_by_side`` runs several on one log.
"""

from __future__ import annotations

from slamfusion.lazy_names import lazy_names

__all__, __getattr__ = lazy_names(__name__, __file__)
