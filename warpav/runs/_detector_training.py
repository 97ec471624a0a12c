"""Train the shipped detector, and measure any detector on images of town scenes: the model card's figures."""

from __future__ import annotations

import importlib.util
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from warpav.core.errors import ArgumentError, InputError, install_text
from warpav.core.files import write_json
from warpav.detection import ROAD_USERS, TEST_SUBSETS, TrainingOptions, evaluate, load_images, write_images
from warpav.runs._networks import load_detector
from warpav.runs.config import Config

_MIN_CONFIDENCE = 0.01
"""Detections from here on take part in the average precision."""

_FIGURES = {
    "objects": "objects",
    "objects_headline": "of these in the headline",
    "ap50_headline": "**AP50, headline**",
    "ap50_moderate": "AP50, moderate",
    "ap50": "AP50, all",
    "recall": "recall",
    "precision": "precision",
    "false_alarms_per_image": "false alarms per image",
    "right_label": "right label, of those found",
}
_TABLES = {
    "ap50_by_height_px": ("AP50 by the height of the visible box", "px"),
    "ap50_by_visible_fraction": ("AP50 of the headline by the share of the object that nothing hides", ""),
    "ap50_by_distance_m": ("AP50 of the headline by distance", "m"),
    "recall_by_visible_fraction": ("Recall by the share of the object that nothing hides", ""),
    "recall_by_distance_m": ("Recall by distance", "m"),
}


def train_detector(out: Path, *, image_folder: Path | None, say: Callable[[str], None], **given: Any) -> None:  # noqa: ANN401
    """Make the images, train, write ``detector.onnx``; an interrupted training continues from its checkpoint.

    The images are in ``images`` in ``out``, or in ``image_folder``, and made where they are missing; what else is given
    is of `TrainingOptions`.
    """
    options = TrainingOptions(**given)
    missing = [name for name in ("torch", "onnx") if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"detector train: expected the package{'s' if len(missing) > 1 else ''} {' and '.join(missing)}, got no "
            f"such module; {install_text('train')}"
        )
    for option, value, minimum in (
        ("processes", options.processes, 1),
        ("steps", options.steps, 1),
        ("batch-size", options.batch_size, 1),
        ("seed", options.seed, 0),
    ):
        if value < minimum:
            raise InputError(f"command line (--{option}): expected at least {minimum}, got {value}")
    import torch  # pyright: ignore[reportMissingImports]

    from warpav.detection import train_detector as train

    devices = ("cpu", *(f"cuda:{k}" for k in range(torch.cuda.device_count())))
    if options.device not in devices:
        raise ArgumentError(
            "device", f"expected one of {', '.join(devices)}, which PyTorch finds, got {options.device!r}"
        )
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    say(f"wrote {train(out, options, image_folder=_made_folders(out, image_folder))}")


def measure_detector(
    config: Config,
    out: Path,
    *,
    image_folder: Path | None,
    processes: int,
    image_count: int | None,
    say: Callable[[str], None],
) -> None:
    """Measure the configured detector on the test images, and write ``evaluation.json`` and ``evaluation.md``."""
    for option, value in (("processes", processes), ("images", image_count)):
        if value is not None and value < 1:
            raise InputError(f"command line (--{option}): expected at least 1, got {value}")
    found = config.model_copy(
        update={"detector": config.detector.model_copy(update={"confidence_min": _MIN_CONFIDENCE})}
    )
    detector = load_detector(found, every_road_user=True)
    folder = _made_folders(out, image_folder)
    report: dict[str, dict[str, dict[str, Any]]] = {}
    for name, subset in TEST_SUBSETS.items():
        title = name.removeprefix("test_")
        say(f"{title} scenes: {len(subset.seeds)} from seed {subset.first_seed} on")
        write_images(subset, folder / name, processes=processes)
        report[title] = {
            str(side_px): evaluate(detector, each.first(image_count))
            for side_px, each in load_images(folder / name).items()
        }
    write_json(out / "evaluation.json", report)
    text = tables(report)
    (out / "evaluation.md").write_text(text, encoding="utf-8")
    for line in text.splitlines():
        say(line)
    say(f"wrote {out / 'evaluation.json'} and {out / 'evaluation.md'}")


def tables(report: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """The figures of a report as Markdown, a row for every kind of scene and size of image."""
    images = [(f"{kind}, {side} px", each) for kind, by_side in report.items() for side, each in by_side.items()]
    lines = []
    for road_user in ROAD_USERS:
        held = {text: each for text, each in images if road_user in each}
        if not held:
            continue
        figures = {text: each[road_user] for text, each in held.items()}
        lines += [f"### {road_user.title()}s", "", *_table(
            ["images", *_FIGURES.values()],
            {text: [held[text]["images"], *(each[name] for name in _FIGURES)] for text, each in figures.items()},
        )]  # fmt: skip
        for name, (title, unit) in _TABLES.items():
            bins = next(iter(figures.values()))[name]
            rows = {text: [each[name][key] for key in bins] for text, each in figures.items()}
            lines += [f"{title}:", "", *_table([_bin_text(key, unit) for key in bins], rows)]
    return "\n".join(lines).rstrip() + "\n"


def _table(heads: Sequence[str], rows: Mapping[str, Sequence[float | None]]) -> list[str]:
    lines = [f"| | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|"]
    lines += [f"| {name} | {' | '.join(map(_number, values))} |" for name, values in rows.items()]
    return [*lines, ""]


def _bin_text(key: str, unit: str) -> str:
    low, high = key.split("-")
    unit = f" {unit}" if unit else ""
    return f"from {low}{unit}" if high == "inf" else f"{low} to {high}{unit}"


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:,}" if isinstance(value, int) else f"{value:.3f}"


def _made_folders(out: Path, image_folder: Path | None) -> Path:
    folders = {"out": out, "image-folder": out / "images" if image_folder is None else image_folder}
    for option, folder in folders.items():
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"command line (--{option}): expected a folder to write to, got {str(folder)!r} ({error.strerror})"
            ) from None
        if not os.access(folder, os.W_OK):
            raise InputError(
                f"command line (--{option}): expected a folder to write to, got {str(folder)!r}, which is read-only"
            )
    return folders["image-folder"]
