"""Reports: one self-contained HTML file, and its pictures as PNG in the same folder.

Needs matplotlib, an extra; without it the import of this package says what to install.
"""

from __future__ import annotations

from slamfusion.errors import SlamFusionError

try:
    import matplotlib as _matplotlib  # noqa: F401, ICN001, TID251
except ImportError as _error:
    _message = "the report needs matplotlib; pip install 'slamfusion[report]'"
    raise SlamFusionError(_message) from _error
