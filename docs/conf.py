"""The documentation site: Sphinx, pydata theme, executed notebooks. `make docs` builds it.

Warnings are errors there. Nothing is fetched from the network.
"""

from __future__ import annotations

import contextlib
import os
import sys
from importlib.metadata import version as installed
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_ext"))
# Notebooks call `flexdt` and `python` as a user would: those of this environment.
os.environ["PATH"] = os.pathsep.join(
    [str(Path(sys.executable).parent), os.environ["PATH"]]
)
os.environ.setdefault("MPLBACKEND", "module://matplotlib_inline.backend_inline")

# Imported before autodoc does: its models cannot be built under autodoc's eyes.
with contextlib.suppress(ImportError):
    import ophyd_async.core  # noqa: F401

project = "flexdt"
author = copyright = "The flexdt developers"
version = release = installed("flexdt")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "generated_pages",
    "made_figures",
    "plain_docstrings",
    "links_outside",
]
exclude_patterns = [
    "_build",
    "_ext",
    "_static",
    "tools",
    "**/.ipynb_checkpoints",
]
source_suffix = {".md": "myst-nb", ".rst": "restructuredtext"}
master_doc = "index"
nitpicky = True
# Types of other packages, and of ours that the reference leaves out, are text, not links.
nitpick_ignore_regex = [("py:.*", ".*")]
default_role = "code"

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "attrs_inline"]
myst_heading_anchors = 4
# A page that no list names yet is built and found by search.
suppress_warnings = ["misc.highlighting_failure", "toc.not_included", "ref.python"]

nb_execution_mode = "force"
# The story is kept with its outputs: a weekly job executes it, from the wheel.
nb_execution_excludepatterns = ["story/*"]
nb_execution_raise_on_error = True
nb_execution_timeout = 180
nb_execution_show_tb = True
nb_merge_streams = True

autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": False}
napoleon_google_docstring = True
napoleon_numpy_docstring = False

html_theme = "pydata_sphinx_theme"
html_title = "flexdt"
html_logo = "_static/logo.svg"
html_favicon = "_static/logo.svg"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {
    "logo": {"text": "flexdt"},
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "secondary_sidebar_items": {
        "**": ["page-toc"],
        "_generated/evidence/peers": [],
        "index": [],
    },
    "footer_start": ["copyright"],
    "footer_end": [],
    "header_links_before_dropdown": 6,
    "navbar_end": ["theme-switcher"],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
html_sidebars = {"index": [], "limits": [], "_generated/evidence/peers": []}
