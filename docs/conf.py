"""Sphinx's settings of the documentation, which `make docs` builds; see CONTRIBUTING.md."""

import sys
from importlib.metadata import version as installed_version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

project = "tcmrl"
author = "the tcmrl authors"
version = release = installed_version("tcmrl")
language = "en"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "commands",
    "public_names",
    "repository_pages",
]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
highlight_language = "text"
default_role = "code"
smartquotes = False  # `--option` in a help text is no dash
myst_heading_anchors = 4

# Pages that show a file of the repository; their own text follows it.
repository_pages = {
    "index": "README.md",
    "changelog": "CHANGELOG.md",
    "contributing": "CONTRIBUTING.md",
    "measured": "results/README.md",
    "how-to/pendulum": "examples/pendulum/README.md",
}
# Pages that links to folders of the repository lead to.
repository_links = {"examples/pendulum": "how-to/pendulum.md"}

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
maximum_signature_line_length = 88
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_attr_annotations = False

html_theme = "furo"
html_title = f"tcmrl {version}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_copyright = False

linkcheck_anchors = False
linkcheck_timeout = 20
linkcheck_workers = 2
