"""Execute the notebooks: every NAME.py here becomes NAME.ipynb with its outputs.

``python notebooks/execute.py`` makes all that are committed; with names only these; ``--small`` takes the settings of
the tests, and ``--out`` another folder. Images that are large as PNG become JPEG.
"""

from __future__ import annotations

import argparse
import base64
import io
import os
import re
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nbformat import NotebookNode

FOLDER = Path(__file__).parent
SOURCES = sorted(FOLDER.glob("[0-9][0-9]_*.py"))
TIMEOUT_S = 900
PNG_MAX_BYTES = 60_000
IMAGE_MAX_PX = 1000

SMALL = {
    "01_first_run": "train_seeds, test_seeds, pool_cameras = range(2), range(5000, 5002), 16",
    "02_how_the_gradient_works": "pose_count, truth_samples, step_count = 10, 2, 5",
    "03_rasteriser": "step_count = 5",
    "04_own_vehicle_and_scenes": "train_seeds, test_seeds = range(3), range(18, 19)\n"
    "fit_seeds, held_out_seeds = range(500000, 500004), range(500050, 500052)",
    "05_own_detector": "train_seeds, test_seeds = range(3), range(5000, 5001)\n"
    "fit_seeds, held_out_seeds = range(500000, 500004), range(500050, 500052)",
    "06_recorded_traffic": "train_seeds, test_seeds, pool_cameras = '0..2', '5000..5001', 16",
    "07_series_car": "train_seeds, test_seeds = range(2), range(5000, 5002)\n"
    "pool_cameras, steps, front_cameras = 16, 4, '2..3'",
    "08_reproduce_table_two": "train_seeds, test_seeds, iterations, runs, samples = '0..3', '[1000]', 2, 1, 2",
    "09_lidars_for_a_shuttle": "train_seeds, test_seeds = range(2), range(5000, 5002)\npool_cameras, steps = 16, 4",
}
"""Settings for tests, by notebook: they follow the cell that is tagged ``parameters``."""


def read_source(source: Path) -> NotebookNode:
    """The notebook of a ``.py`` file, without outputs."""
    import jupytext

    notebook = jupytext.read(source)
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"  # the same every time
    return notebook


def executed(source: Path, *, small: bool = False) -> NotebookNode:
    """The notebook of a ``.py`` file with its outputs.

    Args:
        source: The file; its notebook runs in its folder.
        small: Whether to take the settings of `SMALL`.

    Raises:
        nbclient.exceptions.CellExecutionError: A cell failed.
    """
    from nbclient import NotebookClient
    from nbformat.v4 import new_code_cell

    notebook = read_source(source)
    if small:
        (place,) = [k for k, cell in enumerate(notebook.cells) if "parameters" in cell.metadata.get("tags", [])]
        notebook.cells.insert(place + 1, new_code_cell(SMALL[source.stem]))
    client = NotebookClient(
        notebook,
        timeout=TIMEOUT_S,
        kernel_name="python3",
        resources={"metadata": {"path": str(source.parent)}},
        record_timing=False,
        coalesce_streams=True,
    )
    with tempfile.TemporaryDirectory() as temporary:
        client.execute(env={**os.environ, **_environment(temporary)})
        for cell in notebook.cells:
            for output in cell.get("outputs", []):
                if "text" in output:
                    output["text"] = _without_folder(output["text"], temporary)
                _shrink(output.get("data", {}))
    notebook.metadata.pop("language_info", None)  # holds the version of Python
    return notebook


def _environment(temporary: str) -> dict[str, str]:
    """What kernels get: an empty cache, so that nothing depends on earlier runs, but the compiled kernels."""
    from warpav.core.warp_setup import load_warp

    return {
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]),  # finds warpav
        "TMPDIR": temporary,
        "XDG_CACHE_HOME": f"{temporary}/.cache",
        "WARP_CACHE_PATH": load_warp().config.kernel_cache_dir,
        "PYVISTA_JUPYTER_BACKEND": "static",  # images instead of widgets, which no page can show
    }


def _without_folder(text: str, temporary: str) -> str:
    """A text in which files are named from where the notebook works, and those of the user's cache from home."""
    text = text.replace(f"{temporary}/.cache", "~/.cache")
    return re.sub(re.escape(temporary) + r"/tmp\w+/", "", text)


def _shrink(data: dict[str, str]) -> None:
    """Make a large PNG a JPEG, and keep only what is shown of an output."""
    from PIL import Image

    if "image/png" not in data:
        return
    data.pop("text/plain", None)
    content = base64.b64decode(data["image/png"])
    if len(content) <= PNG_MAX_BYTES:
        return
    image = Image.open(io.BytesIO(content)).convert("RGB")
    image.thumbnail((IMAGE_MAX_PX, IMAGE_MAX_PX), Image.Resampling.LANCZOS)
    encoded = io.BytesIO()
    image.save(encoded, "JPEG", quality=88, optimize=True)
    del data["image/png"]
    data["image/jpeg"] = base64.b64encode(encoded.getvalue()).decode()


def main(argv: Sequence[str] | None = None) -> None:
    """Execute notebooks and write them."""
    import nbformat

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="such as 02_how_the_gradient_works; by default all")
    parser.add_argument("--small", action="store_true", help="take the settings of the tests")
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder for the notebooks")
    given = parser.parse_args(argv)
    chosen = [source for source in SOURCES if not given.names or source.stem in given.names]
    unknown = set(given.names) - {source.stem for source in SOURCES}
    if unknown:
        parser.error(f"expected names out of {', '.join(source.stem for source in SOURCES)}, got {min(unknown)!r}")
    for source in chosen:
        began = time.perf_counter()
        target = given.out / f"{source.stem}.ipynb"
        nbformat.write(executed(source, small=given.small), target)
        print(f"{target.name}: {time.perf_counter() - began:.0f} s, {target.stat().st_size / 1000:.0f} KB")


if __name__ == "__main__":
    main()
