"""Commands about catalogues of camera modules."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from warpav.cli.arguments import say

modules_app = App(name="modules", help="Catalogues of camera modules.")


@modules_app.command(name="list")
def modules_list(
    file: Annotated[Path | None, Parameter(help="Catalogue, YAML; by default the one that ships with warpav.")] = None,
    /,
) -> None:
    """List camera modules: sensor, image of the network, lens, field of view, resolution, price, power, zones, source.

    Field of view and pixels per degree are those of the image that the network gets.
    """
    from warpav.rig.catalogue import builtin_modules, module_table, read_modules

    say(*module_table(builtin_modules() if file is None else read_modules(file)).splitlines())


@modules_app.command(name="check")
def modules_check(file: Annotated[Path, Parameter(help="Catalogue, YAML.")], /) -> None:
    """Check a catalogue: one line per problem with file, line, field, what was expected, what came, how to fix it.

    Status 0: every module can be used; 2: something has to be corrected.
    """
    from warpav.rig.catalogue import read_modules

    modules = read_modules(file)
    say(f"{file}: {len(modules)} module{'' if len(modules) == 1 else 's'}, no problems")
