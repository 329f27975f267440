"""Configuration of the site that `make docs` builds from these pages."""

from __future__ import annotations

import sys
from pathlib import Path

# For the extension beside this file.
sys.path.insert(0, str(Path(__file__).parent))

project = "stereoreg_ros"
extensions = ["myst_parser", "sphinx.ext.autodoc", "reference_tables"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
exclude_patterns = ["examples"]
html_theme = "alabaster"
html_theme_options = {
    "description": "Where is the robot in the CT scanner? A single slice is enough to find out.",
    "page_width": "1100px",
    "fixed_sidebar": True,
}
autodoc_typehints = "description"
autodoc_member_order = "bysource"
