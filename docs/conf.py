"""How Sphinx builds the documentation (`bash scripts/docs.sh`)."""

from __future__ import annotations

import re
import sys
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs" / "_extensions")]

project = "lp_framework"
author = "the authors of lp_framework"
copyright = "the authors of lp_framework; Apache License 2.0"

extensions = [
    "myst_nb",  # Markdown and notebooks
    "sphinx.ext.autodoc",
    "sphinx_copybutton",
    "sphinx_design",  # the cards of the first page
    "choices",  # ours: the catalogue, from conf/
    "mathml",  # ours: equations without a script
]
exclude_patterns = ["_extensions", "examples"]

# Every reference has to resolve, except those to other packages.
nitpicky = True
nitpick_ignore_regex = [
    (r"py:.*", r"(torch|numpy|np|pathlib|collections|trimesh|PIL)\..*"),
    (r"py:.*", r"Tensor|NDArray|ArrayLike|lp_framework\.registry\._Class"),
]

html_theme = "furo"
html_title = "lp_framework"
html_static_path = ["_static"]
html_css_files = ["lp.css"]
html_math_renderer = "mathml"
html_show_sphinx = False
pygments_style, pygments_dark_style = "friendly", "monokai"

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = (
    "force"  # the notebook holds no outputs; they are made when the site is built
)
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_output_stderr = "remove"  # warnings of the kernel about widgets

copybutton_prompt_text = r"\$ |>>> "
copybutton_prompt_is_regexp = True

default_role = (
    "code"  # docstrings write code as Markdown does, between single backticks
)
autodoc_member_order = "bysource"
autodoc_type_aliases = {"ArrayLike": "ArrayLike", "NDArray": "NDArray"}
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 80


def plain_aliases(
    app: Sphinx,
    what: str,
    name: str,
    obj: object,
    options: object,
    signature: str | None,
    result: str,
):
    """`ArrayLike` instead of `TypeAliasForwardRef('ArrayLike')` (Sphinx 9.0)."""
    return signature and re.sub(
        r"TypeAliasForwardRef\('(\w+)'\)", r"\1", signature
    ), result


def setup(app: Sphinx) -> None:
    """Connect to autodoc."""
    app.connect("autodoc-process-signature", plain_aliases)
