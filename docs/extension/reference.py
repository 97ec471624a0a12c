"""Directives ``options`` and ``commands``: the configuration from its schema, the command line from its own help."""

import re
from collections.abc import Iterator

from cyclopts.docs.markdown import generate_markdown_docs
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from warpav.cli.app import app as warpav_app
from warpav.runs.config import config_dir, config_names, described_options, load_config, option_values


class Options(SphinxDirective):
    """One section for each of the configuration's, one entry for each option."""

    def run(self) -> list[nodes.Node]:
        """The sections, parsed as Markdown."""
        for file in config_dir().glob("*.yaml"):
            self.env.note_dependency(str(file))
        return self.parse_text_to_nodes("\n".join(_option_lines()), allow_section_headings=True)


class Commands(SphinxDirective):
    """One section for each command: single ones, then those that come in groups."""

    def run(self) -> list[nodes.Node]:
        """The sections, parsed as Markdown."""
        return self.parse_text_to_nodes(_command_text(), allow_section_headings=True)


def _option_lines() -> Iterator[str]:
    shipped = {name: option_values(load_config(name)) for name in config_names()}
    section = None
    for option in described_options():
        if option.section != section:
            section = option.section
            yield from ("", f"## {section or 'Of the whole run'}", "", option.section_description, "")
        differing = {
            name: values[option.name] for name, values in shipped.items() if values[option.name] != option.default
        }
        others = "".join(f"; `{_written(value)}` in `{name}.yaml`" for name, value in differing.items())
        yield f"```{{confval}} {option.name}"
        yield f":type: {option.expected}"
        yield f":default: `{_written(option.default)}`{others}"
        yield from ("", option.description.replace("<", r"\<"), "```", "")


def _written(value: object) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list):
        return f"[{', '.join(map(_written, value))}]"
    return str(value)


def _command_text() -> str:
    text = generate_markdown_docs(warpav_app, generate_toc=False)
    text = text.replace(" *[default: False]*", "").replace("```console", "```text")
    _, *commands = re.split(r"^(?=## )", text, flags=re.MULTILINE)
    return "\n".join(sorted(commands, key=lambda each: "### " in each))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives."""
    app.add_directive("options", Options)
    app.add_directive("commands", Commands)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
