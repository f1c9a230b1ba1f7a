"""Sphinx configuration of the site; `make docs` copies it beside the pages (scripts/docs_pages.py)."""

project = "scsr-opt"
author = "scsr-opt contributors"
copyright = "scsr-opt contributors"  # noqa: A001  the name that Sphinx asks for
extensions = ["myst_nb", "sphinx_copybutton"]
exclude_patterns = ["docs/site", "**.ipynb_checkpoints"]
html_theme = "furo"
html_title = "scsr-opt"
html_copy_source = False
html_show_sourcelink = False
nitpicky = True

# Notebooks are saved with their pictures, and run by the tests.
nb_execution_mode = "off"
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3
copybutton_exclude = ".linenos, .gp, .go"
# Tables of figures are wider than a phone: they scroll.
html_static_path = []
# ```sh with remarks, and code in docstrings that is a part of a program, need not parse.
suppress_warnings = ["misc.highlighting_failure", "mystnb.unknown_mime_type"]
