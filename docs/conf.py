"""How Sphinx makes the pages: `make docs`. They open from a folder, without a server and without a network."""

import importlib.metadata
import re

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.domains.python import PyClasslike

project = "ehsvjax"
author = "the authors of ehsvjax"
release = importlib.metadata.version("ehsvjax")
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = f"ehsvjax {release}"
html_static_path = ["style"]
html_css_files = ["own.css"]
html_copy_source = html_show_sourcelink = html_show_copyright = False
# A name in backticks is code, as in Markdown.
default_role = "code"
highlight_language = "none"
pygments_style = "friendly"

# Notebooks are shown as they were committed; pages that ask for it by themselves are run, and an error ends the build.
nb_execution_mode = "off"
nb_execution_raise_on_error = True
nb_execution_timeout = 900
nb_merge_streams = True
# Bars are of the run, not of the page.
nb_output_stderr = "remove"
myst_enable_extensions = ["amsmath", "colon_fence", "dollarmath"]
myst_heading_anchors = 3
myst_update_mathjax = False

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
napoleon_google_docstring, napoleon_numpy_docstring = True, False
napoleon_use_ivar, napoleon_use_rtype = True, False

# Browsers draw MathML themselves.
html_math_renderer = "mathml"


def _inline(writer, node):
    writer.body.append(tex2mathml(node.astext(), as_block=False))
    raise nodes.SkipNode


def _block(writer, node):
    writer.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def _with_formulas_apart(app, what, name, obj, options, lines):
    """Make literal blocks of what is indented in a docstring but belongs to none of its sections."""
    outside, made = True, []
    for line in lines:
        line = re.sub(r"\|(\w+)\|", r"\\|\1\\|", line)  # a magnitude is no substitution
        indented, before = line.startswith("    "), made[-1] if made else ""
        if line and not indented:
            outside = not re.fullmatch(r"(Args|Attributes|Returns|Raises|Yields):", line)
        elif indented and outside and not before and any(made):
            last = next(earlier for earlier in reversed(made) if earlier)
            if not last.startswith("    "):
                made += ["::", ""]
        made.append(line)
    lines[:] = made


def _without_fields(app, what, name, obj, skip, options):
    """Leave out the fields of a NamedTuple, which its docstring tells of."""
    return True if type(obj).__name__ == "_tuplegetter" else None


def setup(app):
    """Take part in Sphinx."""
    next(field for field in PyClasslike.doc_field_types if field.name == "variable").label = "Fields"
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))
    # Before napoleon, which reads the sections.
    app.connect("autodoc-process-docstring", _with_formulas_apart, priority=400)
    app.connect("autodoc-skip-member", _without_fields)
