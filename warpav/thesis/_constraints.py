"""The thesis's constraints: the mount surface's bounding rectangle and the spacing (Eqs. 5 to 9)."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpav.core.errors import OptionError
from warpav.optimisation import Constraints, PlacedViews, do_not_fit
from warpav.rig import MountSurface
from warpav_kernels.thesis import losses as kernels


class BoundsAndSpacing(Constraints):
    """The thesis's: inside the mount surface's bounding rectangle, and apart; one loss for each, over all cameras."""

    are_inequalities = False

    def __init__(self, surface: MountSurface, *, min_spacing_m: float = 0.2) -> None:
        """As in `Constraints`; the thesis keeps 0.2 m."""
        super().__init__(surface, min_spacing_m=min_spacing_m)

    @property
    def names(self) -> tuple[str, ...]:
        return ("out_of_bounds", "camera_spacing")

    def losses_of(self, views: PlacedViews, rotation_count: int) -> wp.array:
        """Out-of-bounds and camera-spacing loss (thesis Eqs. 5 to 9), as in `Constraints`."""
        device = views.mount_pose.device
        loss = wp.zeros(len(self.names), dtype=float, device=device, requires_grad=True)
        low_m, high_m = self.surface.bounds_m
        wp.launch(
            kernels.out_of_bounds_loss_kernel,
            dim=1,
            inputs=[views.mount_pose, wp.vec2(*low_m), wp.vec2(*high_m)],
            outputs=[loss],
            device=device,
        )
        wp.launch(
            kernels.camera_spacing_loss_kernel,
            dim=1,
            inputs=[views.position_ego_m, rotation_count, self.min_spacing_m],
            outputs=[loss],
            device=device,
        )
        return loss

    def contains(self, place_m: np.ndarray) -> np.ndarray:
        low_m, high_m = self.surface.bounds_m
        place_m = np.asarray(place_m, np.float64)
        return ((place_m >= low_m) & (place_m <= high_m)).all(axis=-1)

    def do_not_fit(self, camera_count: int) -> OptionError:
        size = np.diff(self.surface.bounds_m, axis=0)[0]
        return do_not_fit(f"the mount surface of {size[0]:.2f} m x {size[1]:.2f} m", self.min_spacing_m, camera_count)

    def _border_distance_m(self, place: np.ndarray) -> np.ndarray:
        low_m, high_m = self.surface.bounds_m
        inside_m = np.minimum(place - low_m, high_m - place)
        beyond_m = np.minimum(inside_m, 0.0).sum(axis=-1)  # of both axes together
        return np.where(beyond_m < 0.0, beyond_m, inside_m.min(axis=-1))

    def _brought_in(self, place: np.ndarray, module: np.ndarray | None = None) -> np.ndarray:
        low_m, high_m = self.surface.bounds_m
        return np.clip(place, low_m + 1e-6, high_m - 1e-6)

    def _drawn(self, camera_count: int, rng: np.random.Generator) -> np.ndarray:
        return rng.uniform(*self.surface.bounds_m, size=(camera_count, 2))
