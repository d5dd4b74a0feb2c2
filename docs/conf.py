"""Sphinx configuration. Build with ``make docs``."""

import os
import sys
from importlib.metadata import version as installed_version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# The tutorials run in kernels of their own, and take the ignition chemistry from examples/.
sys.path.insert(0, str(ROOT))
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))

project = "torchcal"
author = "The torchcal authors"
copyright = "The torchcal authors"
version = release = installed_version("torchcal")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build", "_generated"]
default_role = "py:obj"

# --- pages -----------------------------------------------------------------------------------------------

html_theme = "furo"
html_title = f"torchcal {release}"
myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

# Only pages that declare a kernel are executed: the tutorials. A cache would not notice changes of torchcal.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_merge_streams = True
nb_render_text_lexer = "none"
nb_render_markdown_format = "myst"  # the tables of terms; CommonMark has none
nb_output_stderr = "remove"  # warnings name files of the machine that built the page; results print them too

# --- reference -------------------------------------------------------------------------------------------

autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
maximum_signature_line_length = 88
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
