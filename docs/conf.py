"""Configuration of the manual. Build it with `make docs`."""

import re
import shutil
from pathlib import Path

import torchmask

project = "torchmask"
author = "The torchmask authors"
project_copyright = author
release = torchmask.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "sphinx-mathjax-offline",
]

# Notebooks are shown with the outputs they were committed with: `make notebooks` renews those.
nb_execution_mode = "off"
nb_render_markdown_format = "myst"  # tables that a cell shows
myst_enable_extensions = ["amsmath", "attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

autodoc_typehints = "signature"
autodoc_mock_imports = ["deepinv"]  # an extra, whose torchvision may not suit the torch that is installed
autodoc_member_order = "bysource"
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
add_module_names = False
# A reference to what the manual does not hold is an error; types in signatures and names of others are not looked up.
nitpicky = True
nitpick_ignore_regex = [("py:.*", r"(?!torchmask\.).*"), ("py:class", ".*")]
python_use_unqualified_type_names = True
python_display_short_literal_types = True
maximum_signature_line_length = 88

html_theme = "furo"
html_title = f"torchmask {release}"
html_static_path = ["_static"]
html_css_files = ["tables.css"]
exclude_patterns = ["_build", "**.ipynb_checkpoints", "notebooks/*.md"]


PUBLIC = {name: f"{getattr(torchmask, name).__module__}.{name}" for name in torchmask.__all__}


def plain_text(app, what, name, obj, options, lines):
    """Docstrings are written to be read as they are: formulas hold bars and asterisks, dataclasses list their fields.

    So outside of code a bar is a bar and an asterisk an asterisk; what stands in backticks is code, and a link if it is
    a public name or a module; and lines "field : what it is" before the first section are parameters of the class.
    """
    if what == "class":
        lines[:] = _fields(lines)
    in_example = False
    for number, line in enumerate(lines):
        in_example = bool(line.strip()) and (in_example or line.lstrip().startswith(">>>"))
        if in_example:
            continue
        parts = re.split(r"(``.*?``|`.*?`)", line)
        parts[::2] = [re.sub(r"[|*]", r"\\\g<0>", part) for part in parts[::2]]
        parts[1::2] = [_code(part.strip("`")) for part in parts[1::2]]
        lines[number] = "".join(parts)


def _fields(lines):
    headings = (k - 1 for k, line in enumerate(lines) if k and re.fullmatch(r"-{3,}", line))
    end = next(headings, len(lines))
    introduction = re.sub(r"(?<=\S)\n {4}(?=\S)", " ", "\n".join(lines[:end]))  # one line a field
    parsed = []
    for line in introduction.split("\n"):
        field = re.match(r"([a-z]\w*(?:, [a-z]\w*)*) : (.*)", line)
        parsed += [f":param {name}: {field[2]}" for name in field[1].split(", ")] if field else [line]
    return parsed + lines[end:]


def _code(text):
    if text in PUBLIC:
        return f":py:obj:`{text} <{PUBLIC[text]}>`"
    return f":py:obj:`{text}`" if re.fullmatch(r"torchmask(\.\w+)+", text) else f"``{text}``"


def copy_notebooks(app):
    """Sphinx reads below its own folder only."""
    target = Path(app.srcdir) / "notebooks"
    target.mkdir(exist_ok=True)
    for notebook in (Path(app.srcdir).parent / "notebooks").glob("*.ipynb"):
        shutil.copy2(notebook, target)


def setup(app):
    app.connect("builder-inited", copy_notebooks, priority=0)
    app.connect("autodoc-process-docstring", plain_text, priority=400)  # before napoleon
