"""Commands about rigs and files of other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from warpav.cli._arguments import (
    FileFormat,
    FileOrigin,
    FileTurn,
    Overrides,
    Requirements,
    RigConfig,
    RigSource,
    complain,
    of_rig,
    say,
    with_flags,
)

rig_app = App(name="rig", help="Known camera rigs; rig files of other tools; what is in a rig.")


@rig_app.command(name="presets")
def _rig_presets() -> None:
    """List the rigs that ship with warpav, with their sources."""
    from warpav.rig import preset_about, preset_names, preset_rig

    for name in preset_names():
        about = preset_about(name)
        say(f"{name}: {len(preset_rig(name).cameras)} cameras. {about.title}")
        say(f"  source: {about.source}")
        say(f"  licence: {about.licence}")
    say("highest: the thesis's baseline, cameras around the highest point of your vehicle's roof, as the run says")


@rig_app.command(name="import")
def _rig_import(
    file: Annotated[Path, Parameter(help="File or folder of another tool.")],
    /,
    *,
    format_name: FileFormat,
    out: Annotated[Path | None, Parameter(help="Rig YAML to write; by default it is printed.")] = None,
    origin_m: FileOrigin = None,
    origin_rpy_deg: FileTurn = (0.0, 0.0, 0.0),
    width_px: Annotated[int | None, Parameter(help="Image width, where the file has none.")] = None,
    height_px: Annotated[int | None, Parameter(help="Image height, where the file has none.")] = None,
    fov_deg: Annotated[float | None, Parameter(help="Horizontal field of view, where the file has no lens.")] = None,
    intrinsics: Annotated[Path | None, Parameter(help="camera_info YAML, or a folder of such, for the lenses.")] = None,
    part: Annotated[str | None, Parameter(help="Which rig: scene of nuScenes, vehicle of the ros-bridge.")] = None,
    accept_mirrored: Annotated[
        bool, Parameter(help="Accept cameras called left that lie or point to the right, and vice versa.", negative="")
    ] = False,
    mirror_y: Annotated[bool, Parameter(help="The file's y points to the right: turn it round.", negative="")] = False,
    approximate: Annotated[
        bool, Parameter(help="Take lenses that warpav's nearest is off by more than .25 px.", negative="")
    ] = False,
    lidar: Annotated[str | None, Parameter(help="Module for LiDARs whose beams the file lacks: lidar_32.")] = None,
    overwrite: Annotated[bool, Parameter(help="Replace the file that is there.", negative="")] = False,
) -> None:
    """Make a rig YAML of another tool's file, and say in which frame it was read."""
    from warpav.rig import ImportOptions, check_target, import_rig_with_notes, rig_text, write_rig

    if out is not None:
        check_target(out, overwrite=overwrite)
    lens = (width_px, height_px, fov_deg, intrinsics)
    options = ImportOptions(origin_m, origin_rpy_deg, *lens, part, accept_mirrored, mirror_y, approximate, lidar)
    rig, notes = import_rig_with_notes(file, format_name, options)
    for note in notes:
        (complain if out is None else say)(with_flags(note))  # what is printed is the rig, and nothing else
    if out is None:
        say(*rig_text(rig).splitlines())
    else:
        write_rig(rig, out)
        say(f"wrote {out}")


@rig_app.command(name="export")
def _rig_export(
    rig: RigSource,
    /,
    *overrides: Overrides,
    format_name: FileFormat,
    out: Annotated[Path, Parameter(help="File or folder to write.")],
    origin_m: FileOrigin = None,
    origin_rpy_deg: FileTurn = (0.0, 0.0, 0.0),
    approximate: Annotated[
        bool, Parameter(help="Leave out what the format cannot hold, and say what.", negative="")
    ] = False,
    overwrite: Annotated[bool, Parameter(help="Replace files that are there.", negative="")] = False,
    with_vehicle: Annotated[
        bool, Parameter(help="usd: the vehicle as well, that of the run or of scenes.ego=.", negative="")
    ] = False,
    config: RigConfig = None,
) -> None:
    """Write a rig for another tool."""
    from warpav.core.errors import ArgumentError
    from warpav.rig import export_rig_with_notes
    from warpav.runs import rig_to_export, rig_with_vehicle

    placed, vehicle = None, None
    if with_vehicle:
        with of_rig(rig, config, overrides) as settings:
            placed, vehicle = rig_with_vehicle(rig, settings)
    elif overrides or config is not None:
        raise ArgumentError("with_vehicle", "expected it beside options of a run, which say which vehicle; add it")
    files, notes = export_rig_with_notes(
        placed or rig_to_export(rig),
        format_name,
        out,
        origin_m=origin_m,
        origin_rpy_deg=origin_rpy_deg,
        approximate=approximate,
        overwrite=overwrite,
        vehicle=vehicle,
    )
    for line in (*notes, *(f"wrote {file}" for file in files)):
        say(with_flags(line))


@rig_app.command(name="check")
def _rig_check(
    rig: RigSource,
    /,
    *,
    accept_mirrored: Annotated[
        bool, Parameter(help="Accept cameras called left that lie or point to the right, and vice versa.", negative="")
    ] = False,
) -> int:
    """List the cameras of a rig, what is wrong or odd about them, and the formats that hold them all."""
    from warpav.rig import description, formats_for, mirrored_cameras, oddities
    from warpav.runs import is_run_folder, rig_to_export

    found = rig_to_export(rig)
    for camera in found.cameras:
        say(description(camera))
    for text in oddities(found):
        say(f"odd: {text}")
    fit, unfit = formats_for(found)
    say(f"can be exported as {', '.join(fit) or 'no format without loss'}")
    for name, reason in unfit.items():
        say(with_flags(f"not as {name}: {reason}"))
    mirrored = [] if accept_mirrored else list(mirrored_cameras(found.cameras))
    if is_run_folder(rig):  # the optimiser knows no names
        for text in mirrored:
            say(f"odd: {text}; the run moved it there, so it needs another name")
        return 0
    for text in mirrored:
        complain(f"{rig}: {text}; was it made of a left-handed file? --accept-mirrored takes it as it is")
    return 2 if mirrored else 0


@rig_app.command(name="requirements")
def _rig_requirements(
    rig: RigSource,
    /,
    *overrides: Overrides,
    requirements: Requirements = "near_field",
    json: Annotated[Path | None, Parameter(help="JSON file to write.")] = None,
    image: Annotated[Path | None, Parameter(help="PNG to draw the ground into, seen from above.")] = None,
    config: RigConfig = None,
) -> None:
    """Check which requirements on the ground around the vehicle a rig meets: how much of each, and where not.

    Status 0 whether or not they are met. Templates are no proof of compliance with a regulation.
    """
    from warpav.runs import check_rig

    with of_rig(rig, config, overrides) as settings:
        for line in check_rig(rig, settings, requirements=requirements, json_file=json, image=image):
            say(line)


@rig_app.command(name="drawing")
def _rig_drawing(
    rig: RigSource,
    /,
    *overrides: Overrides,
    out: Annotated[
        Path,
        Parameter(
            help="PDF, SVG or PNG (A3); DXF at 1:1 in mm, which needs the extra cad; CSV with the numbers of every "
            "camera; GLB with vehicle, housings and frustums; else a folder for all of them."
        ),
    ],
    config: RigConfig = None,
) -> None:
    """Draw a rig on its vehicle for the workshop: three views to scale, coordinates from datums, angles, a table."""
    from warpav.core.errors import install_text
    from warpav.runs import write_mount_drawing

    with of_rig(rig, config, overrides) as settings:
        files = write_mount_drawing(rig, settings, out)
        for file in files:
            say(f"wrote {file}")
        if len(files) > 1 and not any(file.suffix == ".dxf" for file in files):
            say(f"without mounts.dxf, which needs ezdxf; {install_text('cad')}")
