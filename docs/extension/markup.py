"""Formulas as MathML, which browsers draw themselves, and shell cells of notebooks highlighted as the shell's."""

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform
from sphinx.writers.html5 import HTML5Translator


class ShellCells(SphinxTransform):
    """Cells that begin with ``%%bash`` are no Python."""

    default_priority = 400

    def apply(self, **_: object) -> None:
        """Say so to the highlighter."""
        for block in self.document.findall(nodes.literal_block):
            if block.astext().startswith("%%bash"):
                block["language"] = "bash"


def _visit_inline(self: HTML5Translator, node: nodes.math) -> None:
    self.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def _visit_block(self: HTML5Translator, node: nodes.math_block) -> None:
    self.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer ``mathml`` and the transform."""
    app.add_html_math_renderer("mathml", (_visit_inline, None), (_visit_block, None))
    app.add_transform(ShellCells)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
