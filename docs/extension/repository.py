"""Links of the repository's pages to its files: source code gets pages of its own, so that no link leaves the site.

At the end every link within the site is followed; one that leads nowhere is a warning.
"""

import posixpath
import re
from collections.abc import Iterator
from html import unescape
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.highlighting import PygmentsBridge
from sphinx.transforms import SphinxTransform
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util import logging

LEXERS = {".py": "python", ".toml": "toml", ".yaml": "yaml"}
"""What is read; data, such as the numbers of experiments, remains a download."""
_log = logging.getLogger(__name__)


class FindSources(SphinxTransform):
    """Sphinx would offer linked files for download; source code is to be read."""

    default_priority = 400

    def apply(self, **_: object) -> None:
        """Replace downloads by references to pages that are made below."""
        for node in list(self.document.findall(addnodes.download_reference)):
            file = (Path(self.env.doc2path(self.env.docname)).parent / node["reftarget"]).resolve()
            if file.suffix not in LEXERS:
                continue
            reference = nodes.reference("", "", *node.children, internal=True)
            reference["source"] = file.relative_to(self.env.srcdir).as_posix()
            node.replace_self(reference)


class LinkSources(SphinxPostTransform):
    """References to source files lead to viewcode's pages, or to pages of :func:`source_pages`."""

    default_priority = 5

    def run(self, **_: object) -> None:
        """Fill in where the pages are."""
        for node in self.document.findall(nodes.reference):
            source = node.get("source")
            if source:
                page = _page_of(self.env, source)
                node["refuri"] = self.app.builder.get_relative_uri(self.env.docname, page)


def _page_of(env: BuildEnvironment, source: str) -> str:
    module = re.sub(r"(/__init__)?\.py$", "", source.removeprefix("kernels/"))
    if getattr(env, "_viewcode_modules", {}).get(module.replace("/", ".")):
        return f"_modules/{module}"
    env.linked_sources = {*getattr(env, "linked_sources", ()), source}
    return f"_files/{source}"


def source_pages(app: Sphinx) -> Iterator[tuple[str, dict[str, Any], str]]:
    """A page for every file that is linked and that viewcode does not show."""
    bridge = PygmentsBridge("html", app.config.pygments_style)
    for source in sorted(getattr(app.env, "linked_sources", ())):
        file = Path(app.srcdir, source)
        code = bridge.highlight_block(file.read_text(), LEXERS[file.suffix])
        yield f"_files/{source}", {"title": source, "body": f"<h1>{source}</h1>{code}"}, "page.html"


def check_links(app: Sphinx, error: Exception | None) -> None:
    """Follow every link within the site."""
    if error or app.builder.name != "html":
        return
    beside = tuple(f"../{version}/" for version in app.config.html_context.get("versions", ()))
    files = {file.relative_to(app.outdir).as_posix() for file in Path(app.outdir).rglob("*") if file.is_file()}
    texts = {name: Path(app.outdir, name).read_text() for name in files if name.endswith(".html")}
    anchors = {name: {unescape(each) for each in re.findall(r' id="([^"]+)"', text)} for name, text in texts.items()}
    for name, text in texts.items():
        for link in set(re.findall(r' (?:href|src)="([^"]+)"', text)):
            path, _, anchor = unquote(unescape(link)).partition("#")
            if re.match(r"[a-z]+:", path):
                continue
            target = (
                posixpath.normpath(posixpath.join(posixpath.dirname(name), path.partition("?")[0])) if path else name
            )
            if target.startswith(beside):  # another version
                continue
            if target not in files or (anchor and anchor not in anchors.get(target, (anchor,))):
                _log.warning("%s: the link %s leads nowhere", name, link)


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect all of it."""
    app.add_transform(FindSources)
    app.add_post_transform(LinkSources)
    app.connect("html-collect-pages", source_pages)
    app.connect("build-finished", check_links)
    return {"parallel_read_safe": True, "parallel_write_safe": False}
