"""Configuration of Sphinx: ``make docs`` writes the manual to ``out/docs``."""

import inspect
import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

import generated  # noqa: E402 - it lies beside this file
from docutils import nodes  # noqa: E402
from sphinx.util.inspect import TypeAliasForwardRef  # noqa: E402

from omsm_ros import __version__  # noqa: E402

project = "omsm_ros"
author = "The omsm_ros developers"
version = release = __version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
autodoc_member_order = "bysource"
add_module_names = False
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_type_aliases = dict.fromkeys(("ArrayLike", "FloatArray"), "array")
TypeAliasForwardRef.__repr__ = lambda alias: alias.name  # else a union shows the class
# Typographic dashes would change the text of options such as --fit.
smartquotes = False
# Notebooks run when the manual is made; one that fails is a warning, which fails the make.
nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "out" / ".jupyter_cache")
# Results of former code are removed, so that the pages show those of this code.
_cache = Path(nb_execution_cache_path)
_changed = max(path.stat().st_mtime for path in (ROOT / "omsm_ros").rglob("*.py"))
if _cache.exists() and _cache.stat().st_mtime < _changed:
    shutil.rmtree(_cache)
nb_execution_timeout = 300
nb_execution_in_temp = True
nb_execution_raise_on_error = True
html_theme = "furo"
html_title = f"omsm_ros {release}"
html_show_copyright = False
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


def parameters_as_fields(app, what, name, obj, options, lines):
    """Make fields of the lines of a docstring that say ``name: meaning;  other: meaning``."""
    try:
        known = set(inspect.signature(obj).parameters)
    except (TypeError, ValueError):
        return
    made, field = [], None
    for line in lines:
        parts = [re.fullmatch(r"(\w+(?:, \w+)*): (.+)", part) for part in line.split(";  ")]
        if all(part and known >= set(part[1].split(", ")) for part in parts):
            fields = [(name, part[2]) for part in parts for name in part[1].split(", ")]
            made += ["" if field is None else None, *(f":param {n}: {text}" for n, text in fields)]
            field = made[-1]
        elif raised := re.fullmatch(r"Raises? (\w+(?:(?:, | or )\w+)*) (for .+)", line):
            made += ["", f":raises {raised[1]}: {raised[2]}"]
            field = made[-1]
        elif field is not None and line.strip():
            made.append(f"    {line}")
        else:
            made.append(line)
            field = None
    lines[:] = [line for line in made if line is not None]


def colons(app, page):
    """Replace the two hyphens after the name of a parameter by a colon."""
    for text in list(page.findall(lambda node: isinstance(node, nodes.Text) and node == " -- ")):
        text.parent.replace(text, nodes.Text(": "))


def setup(app):
    """Write the generated pages before Sphinx reads any page."""
    generated.write(ROOT / "docs" / "reference")
    app.connect("source-read", outside_as_text)
    app.connect("autodoc-process-docstring", parameters_as_fields)
    app.connect("doctree-read", colons)
