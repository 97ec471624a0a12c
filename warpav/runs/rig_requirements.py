"""A rig on its vehicle against requirements: printed, written and drawn."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from warpav.core.files import atomic_write, writing
from warpav.core.warp_setup import checked_device
from warpav.requirements.check import check_requirements
from warpav.requirements.read import read_requirements
from warpav.runs.config import Config
from warpav.runs.rig_source import check_rig_source, find_rig
from warpav.runs.scene_set import load_scenes


def check_rig(
    source: str,
    config: Config,
    *,
    requirements: str,
    json_file: Path | None = None,
    image: Path | None = None,
) -> Iterator[str]:
    """Check a rig against requirements; lines that say what it meets."""
    from warpav.view.figures.requirements import requirement_map
    from warpav.view.figures.style import checked_png

    if image is not None:
        checked_png(image)
    wanted = read_requirements(requirements)
    check_rig_source(source)
    ego = next(load_scenes(config, config.scenes.test_seeds[:1])).ego
    rig = find_rig(source, config, ego)
    result = check_requirements(
        rig, ego, wanted, supersampling=config.camera.supersampling, device=checked_device(config.device)
    )
    yield from result.table().splitlines()
    unmet = [
        f"{each.requirement.name} (largest gap: {each.gap.area_m2:.2f} m², {each.gap.sector})"
        for each in result.outcomes
        if not each.is_met and each.gap is not None
    ]
    yield f"not met: {', '.join(unmet)}" if unmet else "all requirements are met"
    if json_file is not None:
        with writing(json_file), atomic_write(json_file) as draft:
            draft.write_text(json.dumps(result.to_json(), indent=1) + "\n", encoding="utf-8")
        yield f"wrote {json_file}"
    if image is not None:
        requirement_map(image, result=result, rig=rig, ego=ego)
        yield f"wrote {image}"
