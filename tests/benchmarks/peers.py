"""Other renderers on the embedded workload of `warpav bench`, beside warpav in the same run.

A program, not a test: ``pip install deodr mitsuba`` (and an LLVM library for Mitsuba), then
``python tests/benchmarks/peers.py [--repeat N]``; on a GPU, with PyTorch and DRTK built from its sources, with
``--device cuda:0``. Each line is JSON: item, peer, median and least time [ms] over all 16 views, threads, and how far
the result is from the truth. The scene is given before the time begins; what a peer derives from it for a view is
timed.
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from warpav.experiments.bench._items import Bench, time_embree, view_rays
from warpav.experiments.bench._scores import ImageScores, gradient_scores
from warpav.experiments.bench._workload import (
    ROTATION_COUNT,
    WEIGHT_NAMES,
    Workload,
    embedded_truth,
    embedded_workload,
    pack_workload,
)


def main() -> None:
    """Measure every peer that is installed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=7)
    parser.add_argument("--device", default="cpu")
    given = parser.parse_args()
    workload = embedded_workload()
    peers = (measure_embree, measure_mitsuba, measure_deodr) if given.device == "cpu" else (measure_drtk,)
    for measure in (functools.partial(measure_warpav, device=given.device), *peers):
        try:
            for row in measure(workload, given.repeat):
                sys.stdout.write(json.dumps(row) + "\n")
        except ImportError as error:
            left_out = {"left out": str(error)}
            sys.stdout.write(json.dumps(left_out) + "\n")


@dataclass(frozen=True)
class Peer:
    """A renderer whose rows are made."""

    name: str
    threads: int
    workload: Workload
    repeat: int

    def row(self, item: str, times_ms: Sequence[float], **scores: object) -> dict[str, object]:
        """The line of an item."""
        times = {"median_ms": round(float(np.median(times_ms)), 2), "min_ms": round(min(times_ms), 2)}
        return {"item": item, "peer": self.name, "threads": self.threads, **times, **scores}

    def timed(self, item: str, run: Callable[[], object], **scores: object) -> dict[str, object]:
        """The line of an item whose call is timed, after one that is not."""
        run()
        times_ms = []
        for _ in range(self.repeat):
            began = time.perf_counter()
            run()
            times_ms.append(1000.0 * (time.perf_counter() - began))
        return self.row(item, times_ms, **scores)

    def silhouettes(self, gradient: Callable[[np.ndarray, int, str], np.ndarray], step: Callable[[], object]) -> dict:
        """The line of W1 by the gradient of a pose of a camera with a weight image, and all of a step's."""
        scored = {
            which: np.array(
                [gradient(pose, i % len(self.workload.pose), which) for i, pose in enumerate(self.workload.scored_pose)]
            )
            for which in WEIGHT_NAMES
        }
        errors = gradient_scores(scored, embedded_truth(self.workload).gradient)
        parts = {f"{which} {part}": errors[which][part] for which in ("smooth", "white") for part in ("xzyaw", "xz")}
        return self.timed("w1", step, **parts)


def image_scores(workload: Workload, object_index: np.ndarray, depth_m: np.ndarray) -> dict[str, float]:
    """Share of pixels with the true object, and the depth's median error."""
    scores = ImageScores(embedded_truth(workload))
    size = workload.size_px
    scores.add(0, object_index.reshape(-1, size, size), depth_m.reshape(-1, size, size))
    result = scores.result()
    return {name: result[name] for name in ("id_share", "depth_median_m")}


def measure_warpav(workload: Workload, repeat: int, *, device: str) -> Iterator[dict]:
    """This project, as `warpav bench` measures it."""
    bench = Bench(workload, pack_workload(workload, device=device), device=device)
    for item, timing in (
        ("w1", bench.time_silhouettes(1, repeat=repeat)),
        ("w2", bench.time_depth_and_object(repeat=repeat)),
        ("w3", bench.time_rgb(repeat=repeat)),
    ):
        yield Peer("warpav", timing.threads, workload, repeat).row(item, timing.times_ms)


def measure_embree(workload: Workload, repeat: int) -> Iterator[dict]:
    """Embree through embreex, one thread."""
    for item, times_ms in time_embree(workload, repeat=repeat).items():
        yield Peer("embreex", 1, workload, repeat).row(item, times_ms)


def measure_mitsuba(workload: Workload, repeat: int) -> Iterator[dict]:
    """Mitsuba 3, llvm_ad_rgb: the preliminary intersections of all pixels in one wavefront."""
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    mesh = mi.Mesh("all", len(workload.vertex_m), len(workload.triangle))
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(workload.vertex_m.ravel())
    params["faces"] = mi.UInt32(workload.triangle.astype(np.uint32).ravel())
    params.update()
    scene = mi.load_dict({"type": "scene", "mesh": mesh})
    origin_m, direction = (np.concatenate(each).astype(np.float32) for each in zip(*view_rays(workload), strict=True))
    ray = mi.Ray3f(mi.Point3f(origin_m.T), mi.Vector3f(direction.T))
    colour = mi.Float(workload.vertex_rgb.ravel())
    face = mi.UInt32(workload.triangle.astype(np.uint32).ravel())
    index = mi.Int32(workload.triangle_object)
    near_m = mi.Float(np.repeat(workload.near_m, ROTATION_COUNT * workload.size_px**2).astype(np.float32))
    dr.eval(ray, colour, face, index, near_m)
    dr.sync_thread()

    def hits() -> tuple:
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        return hit, hit.is_valid()

    def depths() -> tuple:
        hit, is_hit = hits()
        depth_m = dr.select(is_hit, hit.t + near_m, -1.0)
        found = dr.select(is_hit, dr.gather(mi.Int32, index, hit.prim_index, is_hit), -1)
        dr.eval(depth_m, found)
        dr.sync_thread()
        return depth_m, found

    def colours() -> object:
        hit, is_hit = hits()
        corners = dr.gather(mi.Vector3u, face, hit.prim_index, is_hit)
        b1, b2 = hit.prim_uv.x, hit.prim_uv.y
        rgb = (1.0 - b1 - b2) * dr.gather(mi.Color3f, colour, corners.x, is_hit)
        rgb += b1 * dr.gather(mi.Color3f, colour, corners.y, is_hit)
        rgb += b2 * dr.gather(mi.Color3f, colour, corners.z, is_hit)
        rgb = dr.select(is_hit, rgb, 0.0)
        dr.eval(rgb)
        dr.sync_thread()
        return rgb

    peer = Peer(f"Mitsuba {mi.__version__}", dr.thread_count(), workload, repeat)
    depth_m, found = depths()
    scores = image_scores(workload, np.array(found), np.array(depth_m))
    yield peer.timed("w2", depths, **scores)
    yield peer.timed("w3", colours)


def measure_deodr(workload: Workload, repeat: int) -> Iterator[dict]:
    """DEODR, one thread: its C++ renderer on projected vertices, and its adjoint with antialiased silhouettes."""
    from importlib.metadata import version

    from deodr.triangulated_mesh import TriMesh

    peer = Peer(f"DEODR {version('deodr')}", 1, workload, repeat)
    object_index = np.repeat(np.arange(len(workload.vertex_end)), np.diff(workload.vertex_end, prepend=0))
    size = workload.size_px
    views = [
        (pose, workload.height_m[c], workload.fov_deg[c], workload.near_m[c], turn)
        for c, pose in enumerate(workload.pose)
        for turn in range(ROTATION_COUNT)
    ]

    def draw(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        images, depths = [], []
        for pose, height_m, fov_deg, near_m, turn in views:
            place_px, point_m, _ = projected(workload.vertex_m, pose, height_m, fov_deg, turn, size)
            front = workload.triangle[(point_m[workload.triangle, 2] > near_m).all(axis=1)]
            image, depth_m = deodr_image(front, place_px, point_m[:, 2], value, None, 0.0, size)
            images.append(image)
            depths.append(depth_m)
        return np.stack(images), np.stack(depths)

    index_value = object_index[:, None].astype(np.float64)
    image, depth_m = draw(index_value)
    is_hit = np.isfinite(depth_m)
    scores = image_scores(
        workload, np.where(is_hit, np.rint(image[..., 0]), -1).astype(int), np.where(is_hit, depth_m, -1.0)
    )
    yield peer.timed("w2", lambda: draw(index_value), **scores)
    rgb = workload.vertex_rgb.astype(np.float64)
    yield peer.timed("w3", lambda: draw(rgb))

    first_vertex = np.r_[0, workload.vertex_end[:-1]]
    first_triangle = np.r_[0, np.cumsum(workload.triangle_count)[:-1]]
    meshes = []
    for k in range(workload.vehicle_count):
        triangle = workload.triangle[first_triangle[k] :][: workload.triangle_count[k]] - first_vertex[k]
        meshes.append(TriMesh(triangle.astype(np.uint32), workload.vertex_m[first_vertex[k] : workload.vertex_end[k]]))

    def gradient(pose: np.ndarray, camera: int, which: str) -> np.ndarray:
        total = np.zeros(3)
        for turn in range(ROTATION_COUNT):
            for k, mesh in enumerate(meshes):
                place_px, point_m, change = projected(
                    mesh.vertices, pose, workload.height_m[camera], workload.fov_deg[camera], turn, size
                )
                is_front = point_m[:, 2] > workload.near_m[camera]
                seen = is_front & (place_px > 0.0).all(axis=1) & (place_px < size).all(axis=1)
                if not seen.any():
                    continue
                kept = is_front[mesh.faces].all(axis=1)
                outline = mesh.edge_on_silhouette(place_px)[kept]
                place_gradient = deodr_image(
                    mesh.faces[kept], place_px, point_m[:, 2], np.ones((len(place_px), 1)), outline, 1.0, size,
                    workload.vehicle_weight[k] * workload.weight[which][..., None].astype(np.float64),
                )  # fmt: skip
                total += np.einsum("vi,vij->j", place_gradient, change)
        return total

    yield peer.silhouettes(gradient, lambda: [gradient(pose, c, "white") for c, pose in enumerate(workload.pose)])


def measure_drtk(workload: Workload, repeat: int) -> Iterator[dict]:
    """DRTK on a GPU: all views in one batch, and its gradients at edges for a batch of silhouettes for every camera."""
    import drtk
    import torch

    size, device = workload.size_px, torch.device("cuda")
    vertex_m = torch.tensor(workload.vertex_m, dtype=torch.float32, device=device)
    triangle = torch.tensor(workload.triangle.astype(np.int32), device=device)
    triangle_object = torch.tensor(workload.triangle_object.astype(np.int64), device=device)
    rgb = torch.tensor(workload.vertex_rgb, dtype=torch.float32, device=device)
    turns = 0.5 * np.pi * torch.arange(ROTATION_COUNT, device=device)

    def placed(pose: torch.Tensor, camera: int) -> torch.Tensor:
        """Places [px] and depths [m] of all vertices in the views of a camera, [turn, vertex, 3]."""
        angle = pose[2] + turns
        sine, cosine, zero = torch.sin(angle), torch.cos(angle), torch.zeros_like(turns)
        rows = [
            torch.stack(row, dim=-1) for row in ((-cosine, zero, sine), (zero, zero - 1.0, zero), (sine, zero, cosine))
        ]
        height_m = torch.tensor(workload.height_m[camera], dtype=torch.float32, device=device)
        offset_m = vertex_m - torch.stack([pose[0], height_m, pose[1]])
        point_m = torch.einsum("tij,vj->tvi", torch.stack(rows, dim=1), offset_m)
        focal_px = 0.5 * size / np.tan(0.5 * np.radians(workload.fov_deg[camera]))
        depth_m = point_m[..., 2:]
        # pixel centres are whole numbers; what is nearer than the cut is behind the camera
        is_near = depth_m <= workload.near_m[camera]
        place_px = focal_px * point_m[..., :2] / torch.where(is_near, 1.0, depth_m) + 0.5 * size - 0.5
        return torch.cat([place_px, torch.where(is_near, -1.0, depth_m)], dim=-1)

    poses = torch.tensor(workload.pose, dtype=torch.float32, device=device)
    vertices = torch.cat([placed(pose, c) for c, pose in enumerate(poses)]).contiguous()

    def synchronised(run: Callable[[], object]) -> Callable[[], object]:
        def both() -> object:
            result = run()
            torch.cuda.synchronize()
            return result

        return both

    @synchronised
    def depths() -> tuple[torch.Tensor, torch.Tensor]:
        depth_m, index = drtk.rasterize_with_depth(vertices, triangle, size, size)
        return depth_m, torch.where(index >= 0, triangle_object[index.clamp(min=0).long()], -1)

    @synchronised
    def colours() -> torch.Tensor:
        index = drtk.rasterize(vertices, triangle, size, size)
        _, weight = drtk.render(vertices, triangle, index)
        image = drtk.interpolate(rgb.expand(len(vertices), -1, -1), triangle, index, weight)
        return image * (index >= 0)[:, None]

    peer = Peer(f"DRTK {drtk.__version__}", 1, workload, repeat)
    depth_m, found = depths()
    scores = image_scores(workload, found.cpu().numpy(), torch.where(found >= 0, depth_m, -1.0).cpu().numpy())
    yield peer.timed("w2", depths, **scores)
    yield peer.timed("w3", colours)

    # a batch has one silhouette for every turn and vehicle; those of fewer triangles are filled up with empty ones
    ends = np.cumsum(workload.triangle_count)
    most = int(max(workload.triangle_count[: workload.vehicle_count]))
    alone = torch.zeros((workload.vehicle_count, most, 3), dtype=torch.int32, device=device)
    for k in range(workload.vehicle_count):
        count = workload.triangle_count[k]
        alone[k, :count] = triangle[ends[k] - count : ends[k]]
    alone = alone.repeat(ROTATION_COUNT, 1, 1).contiguous()
    vehicle_weight = torch.tensor(workload.vehicle_weight, dtype=torch.float32, device=device)
    weights = {which: torch.tensor(workload.weight[which], device=device).float() for which in WEIGHT_NAMES}

    def gradient(pose: torch.Tensor, camera: int, which: str) -> torch.Tensor:
        pose = pose.clone().requires_grad_()
        vertex = placed(pose, camera).repeat_interleave(workload.vehicle_count, dim=0)
        with torch.no_grad():
            index = drtk.rasterize(vertex, alone, size, size)
            _, share = drtk.render(vertex, alone, index)
        mask = drtk.edge_grad_estimator(vertex, alone, share, (index >= 0).float()[:, None], index)
        area = (mask[:, 0] * weights[which]).sum(dim=(1, 2)).reshape(ROTATION_COUNT, -1)
        (area * vehicle_weight).sum().backward()
        return pose.grad

    @synchronised
    def step() -> list[torch.Tensor]:
        return [gradient(pose, c, "white") for c, pose in enumerate(poses)]

    def on_host(pose: np.ndarray, camera: int, which: str) -> np.ndarray:
        return gradient(torch.tensor(pose, device=device).float(), camera, which).cpu().numpy()

    yield peer.silhouettes(on_host, step)


def projected(
    vertex_m: np.ndarray, pose: np.ndarray, height_m: float, fov_deg: float, turn: int, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places in the image [px], points in camera coordinates [m], and derivatives of the places to x, z and yaw."""
    angle = pose[2] + turn * 0.5 * np.pi
    sine, cosine = np.sin(angle), np.cos(angle)
    rotation = np.array([[-cosine, 0.0, sine], [0.0, -1.0, 0.0], [sine, 0.0, cosine]])
    rotation_change = np.array([[sine, 0.0, cosine], [0.0, 0.0, 0.0], [cosine, 0.0, -sine]])
    offset_m = vertex_m - np.array([pose[0], height_m, pose[1]])
    point_m = offset_m @ rotation.T
    focal_px = 0.5 * size / np.tan(0.5 * np.radians(fov_deg))
    with np.errstate(divide="ignore", invalid="ignore"):
        place_px = focal_px * point_m[:, :2] / point_m[:, 2:] + 0.5 * size
        moved = np.empty((len(vertex_m), 3, 3))
        moved[..., 0], moved[..., 1] = -rotation[:, 0], -rotation[:, 2]
        moved[..., 2] = offset_m @ rotation_change.T
        share = point_m[:, :2, None] / point_m[:, 2, None, None]
        change = focal_px * (moved[:, :2] - share * moved[:, 2:]) / point_m[:, 2, None, None]
    return place_px, point_m, change


def deodr_image(
    triangle: np.ndarray,
    place_px: np.ndarray,
    depth_m: np.ndarray,
    value: np.ndarray,
    outline: np.ndarray | None,
    sigma: float,
    size: int,
    image_gradient: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray] | np.ndarray:
    """DEODR's image and depths; with the gradient to the image, that to the places instead."""
    from deodr.differentiable_renderer import Scene2D, renderScene, renderSceneB

    count, is_drawn = len(triangle), np.isfinite(place_px).all(axis=1)
    faces = np.ascontiguousarray(triangle, np.uint32)
    scene = Scene2D(
        faces=faces,
        faces_uv=faces,
        ij=np.where(is_drawn[:, None], place_px, 0.0),
        depths=np.ascontiguousarray(depth_m, np.float64),
        textured=np.zeros(count, bool),
        uv=np.zeros((len(place_px), 2)),
        shade=np.zeros(len(place_px)),
        colors=value,
        shaded=np.zeros(count, bool),
        edgeflags=np.zeros((count, 3), bool) if outline is None else np.ascontiguousarray(outline),
        height=size,
        width=size,
        nb_colors=value.shape[1],
        texture=np.zeros((0, 0)),
        background_color=np.zeros(value.shape[1]),
        clockwise=False,
        backface_culling=True,
        perspective_correct=outline is None,
        integer_pixel_centers=False,
    )
    image, nearest_m = np.zeros((size, size, value.shape[1])), np.full((size, size), np.inf)
    renderScene(scene, sigma, image, nearest_m)
    if image_gradient is None:
        return image, nearest_m
    renderSceneB(scene, sigma, image, nearest_m, image_gradient.copy())
    return scene.ij_b


if __name__ == "__main__":
    main()
