"""A long run: whether memory, open files and time a step stay what they are, and the run folder stays bounded.

A program, not a test: ``python tests/benchmarks/load.py --scenes 1000 --cameras 16 --steps 10000``. It optimises by the
descent with small images and eight scenes a step, so that every scene has been seen in the first tenth, writes every
step as ``warpav optimise`` does, and prints memory [MB], open files and time a step [ms] as it goes, then what the
folder and the report take [MB].
"""

from __future__ import annotations

import argparse
import gc
import os
import tempfile
import time
from pathlib import Path

import warpav as wa
from warpav.core.progress import NullProgress
from warpav.runs.config import load_config
from warpav.runs.optimise import Optimisation
from warpav.runs.report.report import write_report
from warpav.runs.run_folder import RunFolder


def main() -> None:
    """Run and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--cameras", type=int, default=16)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--every", type=int, default=500, help="steps between two lines")
    parser.add_argument("--device", default="cpu")
    settings = parser.parse_args()
    options = [
        *("optimiser.search=descent", f"rig.cameras={settings.cameras}", "rig.min_spacing_m=0.05"),
        *(f"device={settings.device}", "camera.width_px=64", "camera.height_px=64", "run.batch_size=8"),
        *(f"run.iterations={settings.steps}", f"optimiser.check_every={settings.steps}", "optimiser.starts=1"),
        *("losses.probability=visible_share", "requirements=null", f"scenes.train_seeds=0..{settings.scenes - 1}"),
        "scenes.validation_seeds=0..3",
    ]
    with tempfile.TemporaryDirectory() as folder:
        config = load_config(load_config("quick"), [*options, f"run.out={folder}/run"], origin=None)
        optimisation = Optimisation.begin(wa.Placement.from_config(config).prepare(NullProgress()))
        written = RunFolder.create(config, name="run")
        print(f"{'steps':>7} {'memory MB':>10} {'files':>6} {'ms a step':>10}", flush=True)  # noqa: T201
        measured = []
        began = time.perf_counter()
        for step in range(1, settings.steps + 1):
            written.append_event(optimisation.descent.step())
            if step % settings.every == 0:
                gc.collect()
                step_ms = 1e3 * (time.perf_counter() - began) / settings.every
                measured.append((memory_mb(), len(os.listdir("/proc/self/fd"))))
                print(f"{step:7d} {measured[-1][0]:10.1f} {measured[-1][1]:6d} {step_ms:10.2f}", flush=True)  # noqa: T201
                began = time.perf_counter()
        size = sum(each.stat().st_size for each in Path(folder).rglob("*") if each.is_file()) / 1e6
        (first_mb, first_files), (last_mb, last_files) = measured[len(measured) // 10], measured[-1]
        print(f"memory {last_mb / first_mb - 1:+.2%}, files {last_files - first_files:+d} over the last nine tenths")  # noqa: T201
        report = write_report(written).stat().st_size / 1e6
        print(f"run folder {size:.1f} MB, report {report:.1f} MB")  # noqa: T201


def memory_mb() -> float:
    """Memory that the process holds, without files that are mapped [MB]."""
    resident, shared = map(int, Path("/proc/self/statm").read_text(encoding="utf-8").split()[1:3])
    return (resident - shared) * os.sysconf("SC_PAGE_SIZE") / 2**20


if __name__ == "__main__":
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    main()
