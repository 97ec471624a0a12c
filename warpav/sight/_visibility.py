"""What cameras see of test objects: each alone in a world of the ego vehicle, in which no ghost hides another.

The ground is flat and below everything, so it hides nothing that stands on it and is not drawn.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
import warp as wp

from warpav.core.errors import InputError
from warpav.raster.areas import VISIBLE_AREA
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.chunks import KeptRenderers, chunk_view_count
from warpav.raster.decide import Occlusion
from warpav.raster.frame import Frame
from warpav.raster.mesh import Mesh
from warpav.raster.renderer import Renderer
from warpav.raster.scene import Scene
from warpav.rig import Rig
from warpav.sight._requirement import Ghosts

_GHOSTS_AT_ONCE = 256  # objects of one scene; a render of a chunk of views holds this many silhouettes in each

RENDER_WIDTH_PX = 640  # wider images are drawn smaller, in proportion: shares and areas of test objects need no more

_PAIRS_AT_ONCE = 8192  # of which solid angles are computed


@dataclass(frozen=True, eq=False)
class Visibility:
    """What each camera sees of each ghost."""

    # Solid angle of what is in the image and not hidden over that of the whole object alone, 0..1, float64 [camera,
    # ghost]
    visible_share: np.ndarray
    pixels: np.ndarray  # area of what is seen [px^2], float64 [camera, ghost]

    def meets(self, ghosts: Ghosts) -> np.ndarray:
        """Whether each camera sees as much as each ghost's requirement wants of one camera, bool [camera, ghost]."""
        return (self.visible_share >= ghosts.of_each("visible_share")) & (self.pixels >= ghosts.of_each("pixels"))

    def closeness(self, ghosts: Ghosts) -> np.ndarray:
        """The lesser of share and pixels over what is needed, 1 where a camera meets it, float64 [camera, ghost]."""
        needed = np.maximum(ghosts.of_each("pixels"), 1e-9)
        share = self.visible_share / ghosts.of_each("visible_share")
        return np.minimum(np.minimum(share, self.pixels / needed), 1.0)


@dataclass(frozen=True, eq=False)
class VisibilityJacobian:
    """What each camera sees of each ghost, and how that changes as it moves.

    The last axis of Jacobians is that of `warpav.raster.areas.Areas.jacobian`: the camera's centre in the ego frame
    [1/m], a small rotation about its own axes [1/rad], the logarithm of its focal lengths.
    """

    visible_share: np.ndarray
    pixels: np.ndarray
    jac_visible_share: np.ndarray  # float64 [camera, ghost, 7]
    jac_pixels: np.ndarray  # in px^2, float64 [camera, ghost, 7]


def poses_of(rig: Rig) -> tuple[np.ndarray, list[CameraModel]]:
    """Poses [camera, 4, 4] and models of a rig's cameras, as `GhostWorld` takes them."""
    return np.stack([each.ego_from_camera for each in rig.cameras]), [each.model for each in rig.cameras]


_VIEWS_AT_ONCE = 8  # with as many ghosts as one scene holds a view of 640 x 480 pixels takes up to 50 MB


@dataclass(eq=False)
class GhostWorld:
    """Ghosts around a vehicle on a device; what is drawn of them is kept, so who asks often keeps this."""

    ghosts: Ghosts
    ego: Mesh
    render_width_px: int = RENDER_WIDTH_PX
    supersampling: int = 1
    device: str = "cpu"
    renderers: KeptRenderers = field(default_factory=KeptRenderers)

    @cached_property
    def scenes(self) -> Sequence[tuple[np.ndarray, Scene]]:
        """Which ghosts, and what is drawn of them."""
        count = len(self.ghosts)
        chunks = np.array_split(np.arange(count), -(-count // _GHOSTS_AT_ONCE))
        meshes = [{str(g): self.ghosts.mesh(g) for g in which} for which in chunks]
        scenes = [Scene(each, foreground=self.ego, device=self.device) for each in meshes]
        return list(zip(chunks, scenes, strict=True))

    def visibility(self, ego_from_camera: np.ndarray, models: Sequence[CameraModel]) -> Visibility:
        """What cameras at poses [camera, 4, 4] see; no gradient."""
        share = np.zeros((len(models), len(self.ghosts)))
        pixels = np.zeros_like(share)
        for cameras, which, frame in self._frames(ego_from_camera, models, Content.COVERAGE):
            found = frame.coverage()
            count = len(cameras)
            value = found.value.numpy()[:count].astype(np.float64)
            alone_sr = found.solid_angle_sr.numpy()[:count, :, 0].astype(np.float64)
            seen_sr = found.visible_sr.numpy()[:count, :, 0].astype(np.float64)
            at = np.ix_(cameras, which)
            pixels[at] = value[:, :, VISIBLE_AREA] * _px2_per_px2(models, cameras, frame)[:, None]
            whole_sr = self._whole_sr(ego_from_camera, models, cameras, which, alone_sr)
            share[at] = np.divide(seen_sr, whole_sr, out=np.zeros_like(seen_sr), where=whole_sr > 0.0)
        return Visibility(share, pixels)

    def jacobians(self, ego_from_camera: np.ndarray, models: Sequence[CameraModel]) -> VisibilityJacobian:
        """As `visibility`, with Jacobians."""
        share = np.zeros((len(models), len(self.ghosts)))
        pixels = np.zeros_like(share)
        jac_share, jac_pixels = np.zeros((*share.shape, 7)), np.zeros((*share.shape, 7))
        for cameras, which, frame in self._frames(ego_from_camera, models, Content.MEASURES):
            count, at = len(cameras), np.ix_(cameras, which)
            areas = frame.areas()
            scale = _px2_per_px2(models, cameras, frame)
            pixels[at] = areas.visible.numpy()[:count] * scale[:, None]
            jac_pixels[at] = areas.jacobian.numpy()[:count] * scale[:, None, None]
            seen, alone = (frame.window_area(visible=visible) for visible in (True, False))
            seen_sr, alone_sr = (each.value.numpy()[:count, :, 0].astype(np.float64) for each in (seen, alone))
            jac_seen, jac_whole = (each.jacobian.numpy()[:count, :, 0].astype(np.float64) for each in (seen, alone))
            whole_sr = self._whole_sr(ego_from_camera, models, cameras, which, alone_sr)
            # what is partly outside of the image has the Jacobian of the closed form, to the centre alone
            camera, ghost = np.nonzero((alone_sr > 0.0) & (whole_sr != alone_sr))
            jac_whole[camera, ghost] = 0.0
            centre_m = np.asarray(ego_from_camera)[np.asarray(cameras)[camera], :3, 3]
            for axis in range(3):
                step = 1e-4 * np.eye(3)[axis]
                ends = [whole_solid_angle_sr(centre_m + sign * step, self.ghosts, which[ghost]) for sign in (1.0, -1.0)]
                jac_whole[camera, ghost, axis] = (ends[0] - ends[1]) / 2e-4
            inverse = np.divide(1.0, whole_sr, out=np.zeros_like(whole_sr), where=whole_sr > 0.0)
            share[at] = seen_sr * inverse
            jac_share[at] = inverse[..., None] * (jac_seen - (seen_sr * inverse)[..., None] * jac_whole)
        return VisibilityJacobian(share, pixels, jac_share, jac_pixels)

    def _frames(
        self, ego_from_camera: np.ndarray, models: Sequence[CameraModel], content: Content
    ) -> Iterator[tuple[np.ndarray, np.ndarray, Frame]]:
        """Renders of chunks of cameras and ghosts: which cameras, which ghosts, the frame (its first views)."""
        pose = np.asarray(ego_from_camera, np.float64).reshape(-1, 4, 4)
        if len(pose) != len(models):
            raise InputError(f"ego_from_camera: expected one pose for each of {len(models)} models, got {len(pose)}")
        drawn = [_drawn(model, self.render_width_px) for model in models]
        position = pose[:, :3, 3].astype(np.float32)
        rotation = pose[:, :3, :3].transpose(0, 2, 1).astype(np.float32)
        for size in dict.fromkeys((model.width_px, model.height_px) for model in drawn):
            group = np.flatnonzero([(model.width_px, model.height_px) == size for model in drawn])
            most = min(chunk_view_count(drawn[group[0]], supersampling=self.supersampling), _VIEWS_AT_ONCE, len(group))
            for first in range(0, len(group), most):
                cameras = group[first : first + most]
                # a last chunk that is not full is filled up with its last camera
                views = cameras[np.minimum(np.arange(most), len(cameras) - 1)]
                lenses = [drawn[v] for v in views]
                (renderer,) = self.renderers.of(("ghosts", *size, most), partial(self._renderer, lenses))
                renderer.set_lenses(lenses)
                for which, scene in self.scenes:
                    yield (
                        cameras,
                        which,
                        renderer.render(
                            scene,
                            wp.array(position[views], dtype=wp.vec3, device=self.device),
                            wp.array(rotation[views], dtype=wp.mat33, device=self.device),
                            content=content,
                        ),
                    )

    def _renderer(self, lenses: Sequence[CameraModel]) -> list[Renderer]:
        options = {"supersampling": self.supersampling, "device": self.device}
        return [Renderer(lenses, occlusion=Occlusion.OCCLUDERS, **options)]

    def _whole_sr(
        self,
        ego_from_camera: np.ndarray,
        models: Sequence[CameraModel],
        cameras: np.ndarray,
        which: np.ndarray,
        alone_sr: np.ndarray,
    ) -> np.ndarray:
        """Solid angle of whole ghosts [sr], [camera, ghost]; 0 where nothing of one is in the image.

        That of one which is in the image with all corners is ``alone_sr``, so nothing seen whole counts as less.
        """
        whole = alone_sr.copy()
        cut: list[tuple[np.ndarray, np.ndarray]] = []
        for k, c in enumerate(cameras):
            asked = np.flatnonzero(alone_sr[k] > 0.0)
            pose = np.asarray(ego_from_camera[c], np.float64)
            is_inside = np.zeros(len(asked), bool)
            for r in np.unique(self.ghosts.requirement[which[asked]]):
                of_r = np.flatnonzero(self.ghosts.requirement[which[asked]] == r)
                corner_m = np.unique(self.ghosts.requirements[r].test_object.hull_m.reshape(-1, 3), axis=0)
                foot_m = np.pad(self.ghosts.position_m[which[asked[of_r]]], ((0, 0), (0, 1)))
                in_camera = (foot_m[:, None] + corner_m - pose[:3, 3]) @ pose[:3, :3]
                with np.errstate(invalid="ignore", divide="ignore"):
                    place = models[c].project(in_camera)
                    inside = ((place >= 0.0) & (place <= [models[c].width_px, models[c].height_px])).all(axis=-1)
                depth = np.linalg.norm(in_camera, axis=-1) if models[c].shape.has_unit_rays else in_camera[..., 2]
                is_inside[of_r] = (inside & (depth > models[c].near_m)).all(axis=-1)
            cut.append((np.full(int((~is_inside).sum()), k), asked[~is_inside]))
        camera, ghost = (np.concatenate(each) for each in zip(*cut, strict=True))
        centre_m = np.asarray(ego_from_camera, np.float64)[cameras[camera], :3, 3]
        exact = whole_solid_angle_sr(centre_m, self.ghosts, which[ghost])
        # pixels may cover a little more than there is
        whole[camera, ghost] = np.maximum(exact, np.nextafter(alone_sr[camera, ghost], np.inf))
        return whole


def whole_solid_angle_sr(centre_m: np.ndarray, ghosts: Ghosts, which: np.ndarray) -> np.ndarray:
    """Solid angle of the convex hulls of whole ghosts, each from a point [pair, 3]; float64 [pair].

    The triangles' solid angles (Van Oosterom and Strackee 1983) add up to twice that of a convex body: rays go in and
    out.
    """
    whole = np.zeros(len(which))
    of_pair = ghosts.requirement[which]
    for r, requirement in enumerate(ghosts.requirements):
        pairs = np.flatnonzero(of_pair == r)
        for first in range(0, len(pairs), _PAIRS_AT_ONCE):
            pair = pairs[first : first + _PAIRS_AT_ONCE]
            foot_m = np.pad(ghosts.position_m[which[pair]], ((0, 0), (0, 1)))
            a, b, c = np.moveaxis(requirement.test_object.hull_m + (foot_m - centre_m[pair])[:, None, None], 2, 0)
            la, lb, lc = (np.linalg.norm(each, axis=-1) for each in (a, b, c))
            volume = np.abs(np.einsum("...i,...i", a, np.cross(b, c)))
            ab, bc, ca = (np.einsum("...i,...i", one, other) for one, other in ((a, b), (b, c), (c, a)))
            whole[pair] = np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=-1)
    return whole


def _drawn(model: CameraModel, width_px: int) -> CameraModel:
    """The camera with the image that is drawn of it."""
    if model.width_px <= width_px:
        return model
    return model.resized(width_px, max(8, round(model.height_px * width_px / model.width_px)))


def _px2_per_px2(models: Sequence[CameraModel], cameras: np.ndarray, frame: Frame) -> np.ndarray:
    """Pixels of the cameras' own images for each that is drawn, [camera of the chunk]."""
    drawn = frame.width_px * frame.height_px
    return np.array([models[c].width_px * models[c].height_px / drawn for c in cameras])
