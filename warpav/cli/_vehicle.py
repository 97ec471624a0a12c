"""Commands about the user's own vehicle."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from warpav.cli._arguments import DEFAULT_CONFIG, Config, FileAxis, Overrides, complain, say, with_flags

vehicle_app = App(name="vehicle", help="Your own vehicle.")


@vehicle_app.command(name="list")
def _vehicle_list() -> None:
    """List the vehicles that ship with warpav, which scenes.ego takes by name, with their sources."""
    from warpav.runs import shipped_vehicles

    for line in shipped_vehicles():
        say(line)
    say("null: the scene's own vehicle, which in the town is a saloon of 4.70 x 2.22 x 1.55 m")


@vehicle_app.command(name="check")
def _vehicle_check(
    file: Annotated[Path, Parameter(help="Mesh of the vehicle: GLB, glTF, OBJ, DAE, PLY or STL.")],
    /,
    *overrides: Overrides,
    up: Annotated[
        FileAxis | None,
        Parameter(
            help="The file's axis that points up; by default what the file says, or z.", allow_leading_hyphen=True
        ),
    ] = None,
    forward: Annotated[
        FileAxis | None,
        Parameter(
            help="The file's axis that points to the front; by default what a model.sdf says, or x.",
            allow_leading_hyphen=True,
        ),
    ] = None,
    scale: Annotated[
        float | None,
        Parameter(help="Metres for each unit of the file, 0.01 for centimetres; by default what the file says."),
    ] = None,
    rear_axle: Annotated[
        float | None,
        Parameter(help="Metres from the vehicle's rear end to its rear axle; by default read from the wheels."),
    ] = None,
    out: Annotated[Path | None, Parameter(help="GLB to write the corrected vehicle to, for scenes.ego.")] = None,
    image: Annotated[Path | None, Parameter(help="PNG to draw it into, with the zone for cameras.")] = None,
    config: Config = DEFAULT_CONFIG,
) -> int:
    """Check whether a vehicle can carry the cameras: units, axes, ground, origin, faces, zone for cameras.

    Status 0: scenes.ego takes it as it is, or the file of --out; 2: something has to be corrected, and how.
    """
    from warpav.runs import check_vehicle
    from warpav.runs.config import placed_config

    with placed_config(config, overrides) as settings:
        report = check_vehicle(
            file, settings, up=up, forward=forward, scale=scale, rear_axle_m=rear_axle, out=out, image=image
        )
    for line in report.lines:
        say(with_flags(line))
    for problem in report.problems:
        complain(with_flags(problem))
    if report.fix is None:
        return 2 if report.problems else 0
    target = out or Path(f"{file.stem}_ego.glb")
    words = [word for name, value in report.fix.items() for word in (f"--{name.replace('_', '-')}", value)]
    command = shlex.join(["warpav", "vehicle", "check", str(file), *words, "--out", str(target)])
    complain(f"{file}: to fix it: {command}")
    return 2


@vehicle_app.command(name="zones")
def _vehicle_zones(
    file: Annotated[Path, Parameter(help="Mesh of the vehicle as scenes.ego takes it, see warpav vehicle check.")],
    /,
    *overrides: Overrides,
    out: Annotated[Path, Parameter(help="YAML to write the zones to, for mount.zones.")] = Path("zones.yaml"),
    image: Annotated[Path | None, Parameter(help="PNG to draw them into.")] = None,
    config: Config = DEFAULT_CONFIG,
) -> int:
    """Propose zones anywhere on a body, where cameras may stand, in a YAML file to edit."""
    from warpav.runs import propose
    from warpav.runs.config import placed_config

    with placed_config(config, overrides) as settings:
        for line in propose(file, settings, out=out, image=image):
            say(line)
    return 0
