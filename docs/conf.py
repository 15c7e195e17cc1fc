"""Configuration of Sphinx: ``make docs`` writes the manual to ``out/docs``."""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

import generated  # noqa: E402 - it lies beside this file

from omsm_ros import __version__  # noqa: E402

project = "omsm_ros"
author = "The omsm_ros developers"
version = release = __version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
autodoc_member_order = "bysource"
autodoc_typehints = "description"
# Notebooks run when the manual is made; one that fails is a warning, which fails the make.
nb_execution_mode = "cache"
nb_execution_timeout = 300
nb_execution_in_temp = True
nb_execution_raise_on_error = True
html_theme = "furo"
html_title = f"omsm_ros {release}"
html_static_path = ["_static"]
html_css_files = ["tables.css"]
exclude_patterns = ["_*"]
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
# Pygments does not know our YAML comments and G-code; such a block is shown without colours.
suppress_warnings = ["misc.highlighting_failure", "myst-nb.lexer"]  # the latter without a kernel


def outside_as_text(app, name, source):
    """Replace links to files outside of docs/, which serve in the repository, by text."""
    source[0] = re.sub(
        r"\[([^\]]+)\]\((?:\.\./)+(?:README|CHANGELOG|config)[^)]*\)", r"\1", source[0]
    )


def setup(app):
    """Write the generated pages before Sphinx reads any page."""
    generated.write(ROOT / "docs" / "reference")
    app.connect("source-read", outside_as_text)
