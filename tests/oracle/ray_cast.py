"""What a camera sees, by embree rays through the sample centres. Shares no code with the rasteriser."""

import functools
from dataclasses import dataclass

import numpy as np
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from warpav.raster.mesh import merge


@dataclass
class RayImage:
    """Per sample: triangle (-1: none), object, depth as the lens counts it [m], interpolated colour 0..1.

    Colours are black where the lens sees nothing.
    """

    triangle: np.ndarray
    object_index: np.ndarray
    depth_m: np.ndarray
    rgb: np.ndarray


@functools.lru_cache(maxsize=2)
def _rays(model, supersampling):
    """Directions of an image's samples, row by row, [sample, 3]."""
    column, row = np.meshgrid(*(np.arange(count * supersampling) + 0.5 for count in (model.width_px, model.height_px)))
    return model.rays(np.stack([column, row], axis=-1) / supersampling).reshape(-1, 3)


class RayCaster:
    """Embree over some meshes; mesh k is object ``first_object + k``."""

    def __init__(self, meshes, *, first_object=0, sky=None):
        whole = merge(meshes)
        self.vertex_m = whole.vertex_m.astype(np.float64)
        self.triangle = whole.triangle
        self.vertex_rgb = whole.vertex_rgb / 255.0
        self.object_of_triangle = np.repeat(
            np.arange(len(meshes)) + first_object, [len(mesh.triangle) for mesh in meshes]
        )
        self.sky = sky
        mesh = trimesh.Trimesh(self.vertex_m, self.triangle, process=False)
        self._embree = RayMeshIntersector(mesh, scale_to_box=False)

    def look(self, ego_from_camera, model, supersampling=1):
        """The image; surfaces with a depth below the near plane are cut away by starting the rays there."""
        width, height = model.width_px * supersampling, model.height_px * supersampling
        # depth times ray is a point, whether the ray has z = 1 or unit length
        ray = _rays(model, supersampling)
        blind = np.isnan(ray[:, 0])
        direction = np.where(blind[:, None], [0.0, 0.0, 1.0], ray) @ ego_from_camera[:3, :3].T
        origin = ego_from_camera[:3, 3] + model.near_m * direction
        hit = np.where(blind, -1, self._embree.intersects_first(origin, direction))
        seen = hit >= 0
        depth = np.full(len(ray), np.inf)
        index = np.full(len(ray), -1)
        rgb = np.where(blind[:, None], 0.0, self._sky_rgb(direction))
        index[seen] = self.object_of_triangle[hit[seen]]
        corner = self.vertex_m[self.triangle[hit[seen]]]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        to_plane = np.einsum("ij,ij->i", normal, corner[:, 0] - ego_from_camera[:3, 3])
        with np.errstate(divide="ignore", invalid="ignore"):
            depth[seen] = to_plane / np.einsum("ij,ij->i", normal, direction[seen])
        point = ego_from_camera[:3, 3] + depth[seen, None] * direction[seen]
        share = trimesh.triangles.points_to_barycentric(corner, point)
        rgb[seen] = np.einsum("ij,ijk->ik", share, self.vertex_rgb[self.triangle[hit[seen]]])
        return RayImage(
            hit.reshape(height, width),
            index.reshape(height, width),
            depth.reshape(height, width),
            rgb.reshape(height, width, 3),
        )

    def _sky_rgb(self, direction):
        if self.sky is None:
            return np.zeros((len(direction), 3))
        sine = np.clip(direction[:, 2] / np.linalg.norm(direction, axis=1), 0.0, 1.0)[:, None]
        share = 1.0 - (1.0 - sine) ** 2
        return ((1.0 - share) * self.sky.horizon_rgb + share * self.sky.zenith_rgb) / 255.0


def cast_scene(scene):
    """A caster over the whole scene: object 0 is the environment with people, 1 the ego vehicle, 2 + k vehicle k."""
    surroundings = merge([scene.environment, *(other.mesh for other in scene.others)])
    return RayCaster([surroundings, scene.ego, *(v.mesh for v in scene.vehicles)], sky=scene.sky)


class Silhouettes:
    """Casts every vehicle of a scene alone, and the ego vehicle alone."""

    def __init__(self, scene):
        self._vehicles = [RayCaster([vehicle.mesh]) for vehicle in scene.vehicles]
        self._ego = RayCaster([scene.ego])

    def look(self, ego_from_camera, model, supersampling=1):
        """Depth of every vehicle [m], inf outside, [vehicle, row, column]; and the ego vehicle's, [row, column]."""
        alone = [caster.look(ego_from_camera, model, supersampling).depth_m for caster in self._vehicles]
        return np.array(alone), self._ego.look(ego_from_camera, model, supersampling).depth_m
