"""Notebooks: a cell that is handed to the shell is shown as the shell's."""

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform


class ShellCells(SphinxTransform):
    """Cells that begin with ``%%bash`` are no Python."""

    default_priority = 400

    def apply(self, **_: object) -> None:
        """Say so to the highlighter."""
        for block in self.document.findall(nodes.literal_block):
            if block.astext().startswith("%%bash"):
                block["language"] = "bash"


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the transform."""
    app.add_transform(ShellCells)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
