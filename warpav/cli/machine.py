"""Commands about this machine: doctor, bench."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter


def doctor(*, json: Annotated[Path | None, Parameter(help="File to write the findings to.")] = None) -> int:
    """Check this machine: versions, devices, OpenGL, execution providers, cache, a self-test of the renderer."""
    from warpav.runs.doctor import examine

    return examine(json_file=json)


def bench(
    *,
    workload: Annotated[Path | None, Parameter(help="Workload (.npz of format 1); by default the embedded.")] = None,
    truth: Annotated[Path | None, Parameter(help="Truth of the workload (.npz), to score the results.")] = None,
    lens: Annotated[
        Literal["pinhole", "brown_conrady", "fisheye", "eucm", "double_sphere", "panorama", "equirectangular"],
        Parameter(help="What the cameras look through: fields of view of 100, 190 or 360 degrees but for a pinhole."),
    ] = "pinhole",
    device: Annotated[str, Parameter(help="cpu or cuda:0.")] = "cpu",
    items: Annotated[str, Parameter(help="W1 silhouettes, W2 depth and objects, W3 colours.")] = "w1,w2,w3",
    supersample: Annotated[Literal[1, 2, 4, 8], Parameter(help="Samples per pixel along each axis for W1.")] = 1,
    repeat: Annotated[int, Parameter(help="Measured runs of every item.")] = 7,
    json: Annotated[Path | None, Parameter(help="File to write; W2's and W3's arrays go beside it.")] = None,
    embree: Annotated[
        bool | None, Parameter(help="Measure embree too; by default on the CPU, unless the workload is very large.")
    ] = None,
    sweep: Annotated[bool, Parameter(help="Measure W1 with supersampling x1, x2, x4 and x8 as well.")] = False,
) -> None:
    """Measure the renderer on a benchmark, score its gradient, and set it beside other renderers."""
    from warpav.experiments.bench.run import run_bench
    from warpav.runs.progress import RunDisplay

    with RunDisplay() as display:
        run_bench(
            workload,
            truth,
            lens=lens,
            device=device,
            items=items,
            supersampling=supersample,
            repeat=repeat,
            json_file=json,
            with_embree=embree,
            with_sweep=sweep,
            progress=display,
        )
