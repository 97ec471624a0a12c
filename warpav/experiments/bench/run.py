"""``warpav bench``: measure the renderer on a workload, score it, and set it beside other renderers."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import platform
import shutil
import statistics
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import ArgumentError
from warpav.core.files import atomic_write, write_json
from warpav.core.progress import Progress
from warpav.core.warp_setup import checked_device, load_warp
from warpav.experiments.bench.scores import ImageScores, gradient_scores
from warpav.experiments.bench.table import bench_table, peer_note, sweep_table
from warpav.experiments.bench.workload import (
    LENSES,
    Truth,
    Workload,
    embedded_truth,
    embedded_workload,
    pack_workload,
    read_truth,
    read_workload,
)

if TYPE_CHECKING:
    from warpav.experiments.bench.items import Bench, Timing

SCHEMA = "warpav-bench-1"
_ITEMS = ("w1", "w2", "w3")
_SWEEP = (1, 2, 4, 8)
# Above these sizes, embree's minutes are not worth the comparison.
MAX_EMBREE_RAYS, MAX_EMBREE_TRIANGLES = 1 << 24, 1_000_000
_MAX_EMBREE_REPEAT = 5


def run_bench(
    workload_file: Path | None,
    truth_file: Path | None,
    *,
    lens: str = "pinhole",
    device: str,
    items: str,
    supersampling: int,
    repeat: int,
    json_file: Path | None,
    with_embree: bool | None,
    with_sweep: bool,
    progress: Progress,
) -> dict[str, Any]:
    """Measure, print the tables, write the files, and return what the JSON file holds."""
    wanted = _checked_items(items)
    if repeat < 1:
        raise ArgumentError("repeat", f"expected at least 1, got {repeat}")
    if json_file is not None:
        _check_target(json_file)
    load_warp()
    device = checked_device(device)
    workload = embedded_workload() if workload_file is None else read_workload(workload_file)
    if lens not in LENSES:
        raise ArgumentError("lens", f"expected one of {', '.join(LENSES)}, got {lens!r}")
    if lens != "pinhole":
        if truth_file is not None:
            raise ArgumentError("truth", f"expected none with the lens {lens}, as truths are those of pinholes")
        workload = dataclasses.replace(workload, lens=lens)
        from warpav.experiments.bench.reference import embree_truth

        truth = embree_truth(workload)
    elif truth_file is not None:
        truth = read_truth(truth_file, workload)
    else:
        truth = embedded_truth(workload) if workload_file is None else None

    from warpav.experiments.bench.items import Bench, object_type

    progress.stage(f"packing {workload.name}: {len(workload.triangle)} triangles, {workload.view_count} views")
    began = time.perf_counter()
    bench = Bench(workload, pack_workload(workload, device=device), device=device)
    pack_ms = 1000.0 * (time.perf_counter() - began)
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "versions": {
            "warpav": metadata.version("warpav"),
            "warp": metadata.version("warp-lang"),
            "python": platform.python_version(),
            "numpy": np.__version__,
        },
        "device": _device(bench),
        "workload": {
            "file": workload.name,
            "seed": workload.seed,
            "faces": len(workload.triangle),
            "views": workload.view_count,
            "res": workload.size_px,
            "visible": int(workload.is_visible),
        },
        "options": {"supersample": supersampling, "w2_w3_supersample": 1, "lens": lens},
        "items": {},
        "scores": {},
    }
    found, scores = content["items"], content["scores"]
    image = (workload.view_count, workload.size_px, workload.size_px)
    with contextlib.ExitStack() as stack:  # the files appear when everything is measured

        def written(item: str, arrays: Mapping[str, tuple[tuple[int, ...], np.dtype]]) -> Callable[..., None] | None:
            if json_file is None:
                return None
            file = json_file.with_name(f"{json_file.name.removesuffix('.json')}.{item}.npz")
            found[item]["arrays"] = file.name
            return stack.enter_context(array_file(file, arrays))

        if "w1" in wanted:
            progress.stage(f"W1, supersampling x{supersampling}")
            found["w1"], of_w1 = _measure_silhouettes(bench, truth, supersampling, repeat=repeat, pack_ms=pack_ms)
            scores.update(of_w1)
        if "w2" in wanted:
            progress.stage("W2")
            found["w2"] = _entry(bench.time_depth_and_object(repeat=repeat), bench, pack_ms)
            number = object_type(len(workload.triangle_count))
            append = written("w2", {"ids": (image, number), "depth": (image, np.dtype(np.float32))})
            scores.update(_collect_images(bench, truth, append))
        if "w3" in wanted:
            progress.stage("W3")
            found["w3"] = _entry(bench.time_rgb(repeat=repeat), bench, pack_ms)
            append = written("w3", {"rgb": ((*image, 3), np.dtype(np.float32))})
            for _, rgb in bench.rgb() if append else ():
                append("rgb", rgb)
        if with_sweep:
            content["sweep"] = []
            for level in _SWEEP:
                progress.stage(f"W1, supersampling x{level}")
                entry, level_scores = _measure_silhouettes(bench, truth, level, repeat=repeat, pack_ms=pack_ms)
                del entry["grad"], entry["value"]
                content["sweep"].append({"supersample": level, **entry, "scores": level_scores})
        if with_embree is None:
            with_embree = (
                bench.device.is_cpu
                and workload.view_count * workload.size_px**2 <= MAX_EMBREE_RAYS
                and len(workload.triangle) <= MAX_EMBREE_TRIANGLES
            )
        if with_embree and {"w2", "w3"} & wanted:
            progress.stage("embree")
            content["reference"] = {"embreex": _measure_embree(workload, wanted, found, repeat)}
    if json_file is not None:
        write_json(json_file, content)

    is_embedded = workload.is_same_work(embedded_workload())
    progress.show(bench_table(content, with_peers=is_embedded))
    if is_embedded:
        for line in peer_note().splitlines():
            progress.say(line)
    if with_sweep:
        progress.show(sweep_table(content, truth if truth is not None and truth.gradient else None))
    return content


def _measure_silhouettes(
    bench: Bench, truth: Truth | None, supersampling: int, *, repeat: int, pack_ms: float
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The entry of W1 and its scores."""
    timing = bench.time_silhouettes(supersampling, repeat=repeat)
    gradient, loss = bench.score_silhouettes(supersampling)
    entry = {
        **_entry(timing, bench, pack_ms),
        "grad": {name: values.tolist() for name, values in gradient.items()},
        "value": {name: values.tolist() for name, values in loss.items()},
    }
    return entry, {"w1": gradient_scores(gradient, truth.gradient)} if truth is not None and truth.gradient else {}


def _collect_images(bench: Bench, truth: Truth | None, append: Callable[..., None] | None) -> dict[str, Any]:
    """Write W2's arrays, and return its scores."""
    image_scores = ImageScores(truth) if truth is not None else None
    for first, index, depth_m in bench.depth_and_object() if truth or append else ():
        if append is not None:
            append("ids", index)
            append("depth", depth_m)
        if image_scores is not None:
            image_scores.add(first, index, depth_m)
    return {"w2": image_scores.result()} if image_scores is not None else {}


def _measure_embree(workload: Workload, wanted: set[str], found: Mapping[str, Any], repeat: int) -> dict[str, Any]:
    from warpav.experiments.bench.reference import time_embree

    times_ms = time_embree(workload, repeat=min(repeat, _MAX_EMBREE_REPEAT))
    result: dict[str, Any] = {"version": metadata.version("embreex"), "threads": 1}
    for name in sorted(wanted & set(times_ms)):
        median_ms = statistics.median(times_ms[name])
        result[name] = {**_spread(times_ms[name]), "ratio": found[name]["median_ms"] / median_ms}
    return result


def _entry(timing: Timing, bench: Bench, pack_ms: float) -> dict[str, Any]:
    return {
        **_spread(timing.times_ms),
        "threads": timing.threads,
        "setup_ms": pack_ms + timing.setup_ms,
        "compile_ms": timing.compile_ms,
        "peak_rss_mib" if bench.device.is_cpu else "peak_device_mib": timing.peak_mib,
    }


def _spread(times_ms: list[float]) -> dict[str, float | int]:
    return {
        "median_ms": statistics.median(times_ms),
        "min_ms": min(times_ms),
        "max_ms": max(times_ms),
        "n": len(times_ms),
    }


def _device(bench: Bench) -> dict[str, Any]:
    if bench.device.is_cuda:
        return {"kind": "cuda", "name": bench.device.name}
    has_affinity = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    return {"kind": "cpu", "name": _processor_name(), "cores": cores}


def _processor_name() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _checked_items(items: str) -> set[str]:
    names = [name.strip() for name in items.split(",")]
    unknown = [name for name in names if name not in _ITEMS]
    if unknown:
        raise ArgumentError("items", f"expected some of {','.join(_ITEMS)}, got {unknown[0]!r}")
    return set(names)


@contextlib.contextmanager
def array_file(
    file: Path, arrays: Mapping[str, tuple[tuple[int, ...], np.dtype]]
) -> Iterator[Callable[[str, np.ndarray], None]]:
    """Appends rows to arrays of an ``.npz`` file, which need not fit into memory; it appears whole at the end."""
    with contextlib.ExitStack() as stack:
        parts = {name: stack.enter_context(tempfile.TemporaryFile(dir=file.absolute().parent)) for name in arrays}
        size = dict.fromkeys(arrays, 0)

        def append(name: str, rows: np.ndarray) -> None:
            assert (rows.dtype, rows.shape[1:]) == (arrays[name][1], arrays[name][0][1:]), name
            parts[name].write(np.ascontiguousarray(rows).data)
            size[name] += rows.nbytes

        yield append
        with atomic_write(file) as draft, zipfile.ZipFile(draft, "w", zipfile.ZIP_STORED) as archive:
            for name, (shape, dtype) in arrays.items():
                assert size[name] == np.prod(shape, dtype=np.int64) * dtype.itemsize, name
                header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
                parts[name].seek(0)
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array_header_1_0(member, header)
                    shutil.copyfileobj(parts[name], member, 1 << 22)


def _check_target(json_file: Path) -> None:
    folder, text = json_file.absolute().parent, ""
    if not folder.is_dir():
        text = f"expected an existing folder to write to, got {str(folder)!r}"
    elif json_file.is_dir():
        text = "expected a file to write, got a folder"
    elif not os.access(folder, os.W_OK):
        text = f"expected a folder that can be written, got {str(folder)!r}"
    if text:
        raise ArgumentError(place=json_file, option="json", text=text)
