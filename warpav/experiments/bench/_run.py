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
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.cores import available_cores
from warpav.core.errors import ArgumentError
from warpav.core.files import atomic_write, write_json
from warpav.core.progress import Progress
from warpav.core.warp_setup import checked_device, load_warp
from warpav.experiments.bench._scores import ImageScores, bench_table, gradient_scores, peer_note, sweep_table
from warpav.experiments.bench._workload import (
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
    from warpav.experiments.bench._items import Bench, Timing

_SCHEMA = "warpav-bench-1"
_ITEMS = ("w1", "w2", "w3")
_SWEEP = (1, 2, 4, 8)
# Above these sizes, embree's minutes are not worth the comparison.
_MAX_EMBREE_RAYS, _MAX_EMBREE_TRIANGLES = 1 << 24, 1_000_000
_MAX_EMBREE_REPEAT = 5


@dataclass(frozen=True)
class BenchOptions:
    device: str = "cpu"
    lens: str = "pinhole"
    items: str = "w1,w2,w3"
    supersampling: int = 1  # of W1, samples per pixel along each axis
    repeat: int = 7
    with_embree: bool | None = None  # None: where its minutes are worth the comparison
    with_sweep: bool = False  # W1 with every supersampling as well


def run_bench(
    workload_file: Path | None,
    truth_file: Path | None,
    options: BenchOptions,
    *,
    json_file: Path | None,
    progress: Progress,
) -> dict[str, Any]:
    """Measure, print the tables, write the files, and return what the JSON file holds."""
    wanted = [name.strip() for name in options.items.split(",")]
    unknown = [name for name in wanted if name not in _ITEMS]
    if unknown:
        raise ArgumentError("items", f"expected some of {','.join(_ITEMS)}, got {unknown[0]!r}")
    if options.repeat < 1:
        raise ArgumentError("repeat", f"expected at least 1, got {options.repeat}")
    if json_file is not None:
        _check_target(json_file)
    load_warp()
    device = checked_device(options.device)
    workload, truth = _read_work(workload_file, truth_file, options.lens)

    from warpav.experiments.bench._items import Bench

    progress.stage(f"packing {workload.name}: {len(workload.triangle)} triangles, {workload.view_count} views")
    began = time.perf_counter()
    bench = Bench(workload, pack_workload(workload, device=device), device=device)
    pack_ms = 1000.0 * (time.perf_counter() - began)
    content = _described(bench, options)
    with contextlib.ExitStack() as files:  # they appear when everything is measured
        _measure(bench, truth, options, content, pack_ms, partial(_written, content, json_file, files), progress)
    if json_file is not None:
        write_json(json_file, content)
    is_embedded = workload.is_same_work(embedded_workload())
    progress.show(bench_table(content, with_peers=is_embedded))
    for line in peer_note().splitlines() if is_embedded else ():
        progress.say(line)
    if options.with_sweep:
        progress.show(sweep_table(content, truth if truth is not None and truth.gradient else None))
    return content


def _read_work(workload_file: Path | None, truth_file: Path | None, lens: str) -> tuple[Workload, Truth | None]:
    """The workload through a lens, and its truth where that is known."""
    workload = embedded_workload() if workload_file is None else read_workload(workload_file)
    if lens not in LENSES:
        raise ArgumentError("lens", f"expected one of {', '.join(LENSES)}, got {lens!r}")
    if lens != "pinhole":
        if truth_file is not None:
            raise ArgumentError("truth", f"expected none with the lens {lens}, as truths are those of pinholes")
        from warpav.experiments.bench._items import embree_truth

        workload = dataclasses.replace(workload, lens=lens)
        return workload, embree_truth(workload)
    if truth_file is not None:
        return workload, read_truth(truth_file, workload)
    return workload, embedded_truth(workload) if workload_file is None else None


def _described(bench: Bench, options: BenchOptions) -> dict[str, Any]:
    """What the JSON file says of a run before anything is measured."""
    workload = bench.workload
    return {
        "schema": _SCHEMA,
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
        "options": {"supersample": options.supersampling, "w2_w3_supersample": 1, "lens": options.lens},
        "items": {},
        "scores": {},
    }


_Arrays = Mapping[str, tuple[tuple[int, ...], np.dtype]]


def _written(
    content: dict[str, Any], json_file: Path | None, files: contextlib.ExitStack, item: str, arrays: _Arrays
) -> Callable[..., None] | None:
    """Appends to the arrays of an item beside the JSON file; None where there is none."""
    if json_file is None:
        return None
    file = json_file.with_name(f"{json_file.name.removesuffix('.json')}.{item}.npz")
    content["items"][item]["arrays"] = file.name
    return files.enter_context(array_file(file, arrays))


def _measure(
    bench: Bench,
    truth: Truth | None,
    options: BenchOptions,
    content: dict[str, Any],
    pack_ms: float,
    written: Callable[[str, _Arrays], Callable[..., None] | None],
    progress: Progress,
) -> None:
    """Measure what is asked for into the content of the JSON file."""
    from warpav.experiments.bench._items import object_type

    workload, repeat, found, scores = bench.workload, options.repeat, content["items"], content["scores"]
    image = (workload.view_count, workload.size_px, workload.size_px)

    def silhouettes(supersampling: int) -> tuple[dict[str, Any], dict[str, Any]]:
        progress.stage(f"W1, supersampling x{supersampling}")
        # the entry of W1 and its scores
        timing = bench.time_silhouettes(supersampling, repeat=repeat)
        gradient, loss = bench.score_silhouettes(supersampling)
        entry = {
            **_entry(timing, bench, pack_ms),
            "grad": {name: values.tolist() for name, values in gradient.items()},
            "value": {name: values.tolist() for name, values in loss.items()},
        }
        return entry, {"w1": gradient_scores(gradient, truth.gradient)} if truth is not None and truth.gradient else {}

    if "w1" in options.items:
        found["w1"], of_w1 = silhouettes(options.supersampling)
        scores.update(of_w1)
    if "w2" in options.items:
        progress.stage("W2")
        found["w2"] = _entry(bench.time_depth_and_object(repeat=repeat), bench, pack_ms)
        number = object_type(len(workload.triangle_count))
        append = written("w2", {"ids": (image, number), "depth": (image, np.dtype(np.float32))})
        scores.update(_collect_images(bench, truth, append))
    if "w3" in options.items:
        progress.stage("W3")
        found["w3"] = _entry(bench.time_rgb(repeat=repeat), bench, pack_ms)
        append = written("w3", {"rgb": ((*image, 3), np.dtype(np.float32))})
        if append is not None:
            for _, rgb in bench.rgb():
                append("rgb", rgb)
    if options.with_sweep:
        content["sweep"] = []
        for level in _SWEEP:
            entry, level_scores = silhouettes(level)
            del entry["grad"], entry["value"]
            content["sweep"].append({"supersample": level, **entry, "scores": level_scores})
    is_small = workload.view_count * workload.size_px**2 <= _MAX_EMBREE_RAYS
    is_worth_it = bench.device.is_cpu and is_small and len(workload.triangle) <= _MAX_EMBREE_TRIANGLES
    if {"w2", "w3"} & found.keys() and (is_worth_it if options.with_embree is None else options.with_embree):
        progress.stage("embree")
        content["reference"] = {"embreex": _measure_embree(workload, found, repeat)}


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


def _measure_embree(workload: Workload, found: Mapping[str, Any], repeat: int) -> dict[str, Any]:
    from warpav.experiments.bench._items import time_embree

    times_ms = time_embree(workload, repeat=min(repeat, _MAX_EMBREE_REPEAT))
    result: dict[str, Any] = {"version": metadata.version("embreex"), "threads": 1}
    for name in sorted(found.keys() & times_ms.keys()):
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
    name = platform.processor() or platform.machine()
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line for line in lines if line.startswith("model name")).partition(":")[2].strip()
    return {"kind": "cpu", "name": name, "cores": available_cores()}


@contextlib.contextmanager
def array_file(file: Path, arrays: _Arrays) -> Iterator[Callable[[str, np.ndarray], None]]:
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
