"""How Sphinx builds these pages, without network: ``python -m sphinx -W -b html docs out/docs``."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from slamfusion import config, io
from slamfusion.version import __version__

# autodoc lists what a package holds, and these load their names on first use.
for package in (config, io):
    for name in package.__all__:
        getattr(package, name)

# pandas loads it where it is installed, and it says with how many threads it works.
logging.getLogger("numexpr").setLevel(logging.WARNING)

project = "SLAMfusion"
author = "The SLAMfusion developers"
copyright = author  # noqa: A001  # Sphinx asks for this name
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "generate"]
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]

toc_object_entries = False
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_mock_imports = ["rclpy"]
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_custom_sections = [("Source", "params_style"), "Units"]

html_theme = "furo"
html_title = f"SLAMfusion {release}"
html_copy_source = False
html_show_sourcelink = False
