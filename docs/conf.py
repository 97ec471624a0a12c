"""The documentation site: ``pip install -e ".[docs]" && sphinx-build docs build/docs``.

Pages are Markdown that reads well without the site too: links between files are relative, as on any host of the
repository. So the site's source is the whole repository; pages, records and notebooks are taken from where they are.
"""

import os
import pkgutil
import sys
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "kernels"), str(ROOT / "docs")]

import warpav  # noqa: E402 (the paths above lead there)

project = "warpav"
author = copyright = "The warpav authors"
release = version = warpav.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "extension.kernels",
    "extension.markup",
    "extension.reference",
    "extension.repository",
]
root_doc = "docs/index"
include_patterns = [
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "README.md",
    "docs/**.md",
    "docs/**.rst",
    "kernels/README.md",
    "notebooks/*.ipynb",
    "warpav/**.md",
]
exclude_patterns = ["**/.*", ".*", "build", "dist", "docs/_*", "runs", "scenes", "tests"]

myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # notebooks are shown with the outputs that they were committed with
nb_merge_streams = True

default_role = "code"
autodoc_member_order = "bysource"
autodoc_mock_imports = ["onnx", "torch"]
autodoc_use_type_comments = False
autodoc_typehints_format = "short"
autosummary_generate = True
autosummary_context = {
    "packages": [found.name for found in pkgutil.walk_packages(warpav.__path__, "warpav.") if found.ispkg]
}
napoleon_google_docstring, napoleon_numpy_docstring, napoleon_use_ivar = True, False, True
add_module_names = False
smartquotes = False
viewcode_follow_imported_members = False
toc_object_entries = False  # hundreds of names in every sidebar
python_maximum_signature_line_length = 88
python_use_unqualified_type_names = True
suppress_warnings = ["ref.python"]  # two classes of one name; neither is linked from an annotation then
html_math_renderer = "mathml"  # drawn by the browser: nothing to load

html_theme = "furo"
html_title = f"warpav {version}"
html_additional_pages = {"index": "redirect.html"}
html_sidebars = {
    "**": [
        *(f"sidebar/{part}.html" for part in ("brand", "search", "scroll-start", "navigation")),
        "versions.html",
        *(f"sidebar/{part}.html" for part in ("ethical-ads", "scroll-end", "variant-selector")),
    ]
}
html_context = {  # of `docs/versions.py`, which builds several beside each other
    "versions": os.environ.get("WARPAV_DOCS_VERSIONS", "").split(),
    "shown_version": os.environ.get("WARPAV_DOCS_VERSION", ""),
}
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_use_index = html_domain_indices = False  # the search finds the same
html_show_sourcelink = html_copy_source = False
templates_path = [str(ROOT / "docs" / "_templates")]
pygments_style, pygments_dark_style = "friendly", "github-dark"


def setup(app: Sphinx) -> None:
    """Take pages from the whole repository, whatever folder the command named, and give the first one its contents."""
    app.srcdir = type(app.srcdir)(ROOT)
    app.connect("source-read", add_contents)


def add_contents(_app: Sphinx, page: str, text: list[str]) -> None:
    """Append the tables of contents to the first page; they are of no use to who reads it without the site."""
    if page == root_doc:
        text[0] += (ROOT / "docs" / "_toctrees.md").read_text()
