"""Short words for whole scenes."""

import hashlib

import numpy as np


def digest_of(scene):
    """Of all that is a whole number or a word: the last bits of floats depend on the processor."""
    found = hashlib.sha256(f"{scene.name} {scene.source}".encode())
    for mesh in (scene.environment, scene.ego, *(user.mesh for user in scene.road_users)):
        found.update(repr(mesh.vertex_m.shape).encode())
        found.update(np.ascontiguousarray(mesh.triangle).tobytes())
    for user in scene.road_users:
        found.update(repr((user.instance_id, user.category)).encode())
    return found.hexdigest()


def bytes_digest(scene):
    """Of every byte: the same on one machine."""
    digest = hashlib.sha256()
    for mesh in (scene.environment, scene.ego, *(user.mesh for user in (*scene.vehicles, *scene.others))):
        for array in (mesh.vertex_m, mesh.triangle, mesh.vertex_rgb):
            digest.update(np.ascontiguousarray(array).tobytes())
    users = (*scene.vehicles, *scene.others)
    digest.update(repr([(user.instance_id, user.category, user.box.yaw_rad) for user in users]).encode())
    return digest.hexdigest()
