"""Reports: one self-contained HTML file, and its pictures as PNG in the same folder.

Needs matplotlib, an extra; without it the import of this package says what to install.
"""

from __future__ import annotations

from slamfusion.errors import extra_needed

with extra_needed("report", "the report needs"):
    import matplotlib as _matplotlib  # noqa: F401, ICN001, TID251
