"""What a run may go on with: options that may change, and hashes of all that it depends on besides its options."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.metadata import version

import numpy as np
import warp as wp

from warpav.core.cache import digest, fingerprint
from warpav.core.errors import InputError
from warpav.optimisation import single_cameras_of
from warpav.runs._networks import model_path
from warpav.runs._placement import Placement
from warpav.runs.config import KEPT_FILES, Config, option_values, with_absolute_paths

_MAY_CHANGE = (
    "run.iterations",
    "run.checkpoint_every",
    "run.pictures",
    "optimiser.pool_rounds",
    "optimiser.pool_refinements",
    "optimiser.pool_gap",
    "optimiser.selection_time_s",
    "optimiser.patience",
    "executor",
)
"""Options, or sections of them, that a run may go on with other values of: they change nothing of what it has done."""
_FILES = (
    "scenes.folder",
    "scenes.ego",
    "scenes.vehicles",
    "scenes.recordings",
    "scenes.test_recordings",
    "scenes.places",
    "scenes.selection_places",
    "scenes.test_places",
    "detector.model",
)
"""Options that name files, which may lie elsewhere now: what they hold counts, see `identity_of`."""
_MEANING = {
    "scenes": "the scenes of the run, got others",
    "start": "the rig that the run starts from, got another",
    "objective": "the losses and requirements of the run, got others",
    "vehicle": "the vehicle of the run, got another",
    "cameras": "the cameras of the run, got others",
    "detector": "the detector of the run, got another",
    "version": "the version of warpav, of its packages and the kind of device of the run, got others",
}


def check_options(before: Config, after: Config, *, of: Placement | None = None) -> None:
    """Make sure that a run can go on with a configuration; that of a placement has objects beside it."""
    known, given = option_values(before), option_values(with_absolute_paths(after))
    free, where = (*_MAY_CHANGE, *_FILES), "command line"
    if of is not None:  # what these mean is compared by `check_identity`
        free, where = (*free, *KEPT_FILES, "run.out", "rig.freeze", *["scenes"] * of.parts.has_own_scenes), "placement"
    differ = [
        name
        for name, value in given.items()
        if value != known[name] and not any(name == each or name.startswith(f"{each}.") for each in free)
    ]
    if differ:
        raise InputError(
            f"{where} ({', '.join(differ)}): expected the values of the run, as others change what has been "
            f"computed; may change: {', '.join(_MAY_CHANGE)}, and where files lie"
            + (f"; {before.run.out} holds the run, choose another folder" if of is not None else "")
        )


def identity_of(placement: Placement) -> dict[str, str]:
    """Hashes of what a run depends on besides its options, by what it is."""
    mount, objective, config = placement.mount, placement.objective, placement.config
    surface, single = mount.surface, single_cameras_of(objective)
    single_identity = {} if single is None else single.identity
    frozen = b"" if mount.frozen is None else mount.frozen.mount_pose.tobytes()
    own, start = placement.own_detector, placement.start_rig
    losses = [(weight, loss.name) for weight, loss in objective.losses]
    return {
        "scenes": digest(*(each.scene.fingerprint for each in placement.search_scenes)),
        "start": digest(
            *(np.round(each.ego_from_camera, 6) + 0.0 for each in ([] if start is None else start.cameras))
        ),
        "objective": digest(losses, placement.requirements),
        "vehicle": digest(
            np.asarray(surface.origin_m, np.float64).tobytes(),
            float(surface.cell_m),
            surface.height_m.tobytes(),
            float(mount.height_offset_m),
            single_identity.get("vehicle"),
        ),
        "cameras": digest(*mount.cameras, frozen, single_identity.get("camera")),
        "detector": digest(own or digest(model_path(config).read_bytes()), single_identity.get("detector")),
        "version": _version(wp.get_device(mount.device).is_cuda),
    }


def check_identity(found: Mapping[str, str], expected: Mapping[str, str]) -> None:
    """Make sure that a run goes on with what it began with."""
    for name, text in _MEANING.items():
        if found.get(name) != expected[name]:
            raise InputError(f"checkpoint: {name}: expected {text}; put back what it was, or begin another run")


@cache
def _version(is_cuda: bool) -> str:
    packages = [version(name) for name in ("warp-lang", "numpy", "scipy")]
    code = ("warpav.thesis._descent", "warpav.optimisation._pool_run")
    return fingerprint(*packages, is_cuda, code=code)
