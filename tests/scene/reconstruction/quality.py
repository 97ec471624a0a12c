"""How near reconstructed vehicles come to the town's own: distances of surfaces, silhouettes from the roof."""

import math
from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.spatial import KDTree

from tests.scene.reconstruction.test_point_cloud import surface_points

SIZE_PX = 256


@dataclass(frozen=True)
class Quality:
    """Distances [m] of one vehicle's surfaces, and silhouettes' intersection over union."""

    recall_m: np.ndarray
    precision_m: np.ndarray
    iou: np.ndarray


class Caster:
    """First hits of rays on a mesh."""

    def __init__(self, mesh):
        self.mesh = mesh
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, mesh.vertex_m[mesh.triangle].astype(np.float32))

    def hits(self, origin, direction):
        """Where rays from one origin hit [m], and how many times their length away; inf where they do not."""
        direction = np.ascontiguousarray(direction, np.float32)
        origins = np.broadcast_to(np.asarray(origin, np.float32), direction.shape).copy()
        found = self._scene.run(origins, direction, output=True)
        return origins + found["tfar"][:, None] * direction, np.where(found["primID"] >= 0, found["tfar"], np.inf)


def roof_places(rng, count, ego_box):
    """Places above the roof and the bonnet [m]."""
    share = rng.uniform(-0.5, 0.5, (count, 3)) * [0.9, 0.8, 0.0]
    return ego_box.center_m + share * ego_box.size_m + [0.0, 0.0, 0.5 * ego_box.size_m[2] + 0.25]


def towards(place_m, box):
    """Directions of the pixels of an image that a box fills, [pixel, 3]."""
    forward = box.center_m - place_m
    distance_m = np.linalg.norm(forward)
    forward = forward / distance_m
    left = np.array([-forward[1], forward[0], 0.0])
    left /= np.linalg.norm(left)
    up = np.cross(forward, left)
    half = min(math.tan(math.radians(60.0)), 0.6 * np.linalg.norm(box.size_m) / distance_m)
    across, along = np.meshgrid(*(np.linspace(-half, half, SIZE_PX),) * 2)
    return forward + across.reshape(-1, 1) * left + along.reshape(-1, 1) * up


def quality(mesh, truth, hidden_by, box, places_m):
    """Compare a reconstructed vehicle with its truth as it is seen between the other vehicles.

    Recall is the distance of the truth's points that can be seen from the places to the reconstruction; precision the
    distance of the reconstruction's points to the truth. Silhouettes are what the others leave visible of the vehicle.
    """
    ours, theirs, others = Caster(mesh), Caster(truth), Caster(hidden_by)
    visible, iou = [], []
    for place_m in places_m:
        direction = towards(place_m, box)
        front = others.hits(place_m, direction)[1]
        point_m, distance = theirs.hits(place_m, direction)
        in_truth = distance < front
        in_ours = ours.hits(place_m, direction)[1] < front
        if np.count_nonzero(in_truth) < 100:
            continue  # hidden from here
        seen_m = point_m[in_truth]
        visible.append(seen_m[:: max(1, len(seen_m) // 400)])
        iou.append(np.count_nonzero(in_truth & in_ours) / np.count_nonzero(in_truth | in_ours))
    recall_m = KDTree(surface_points(mesh, 0.01)).query(np.concatenate(visible))[0]
    precision_m = KDTree(surface_points(truth, 0.01)).query(surface_points(mesh, 0.05))[0]
    return Quality(recall_m, precision_m, np.array(iou))
