"""Draw the images of README and of the documents again: ``python docs/pictures.py [NAME ...]``.

Each is what a command of warpav writes, or is drawn here, and is kept as WebP. All of them take some minutes, most for
the run that README shows.
"""

from __future__ import annotations

import io
import math
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
from PIL import Image

from warpav.cli.app import main

PICTURES = Path(__file__).resolve().parent / "pictures"
_WIDEST_PX = 1600


def _warpav(*arguments: str) -> None:
    if main(list(arguments)) != 0:
        raise SystemExit(f"failed: warpav {' '.join(arguments)}")


def keep(name: str, drawn: Path) -> None:
    """Write a drawn image as ``docs/pictures/NAME.webp``: without loss where that is smaller."""
    with Image.open(drawn) as image:
        small = image.convert("RGB")
    if small.width > _WIDEST_PX:
        small = small.resize((_WIDEST_PX, round(_WIDEST_PX * small.height / small.width)), Image.Resampling.LANCZOS)
    files = []
    for form in ({"quality": 80, "method": 6}, {"lossless": True}):
        file = io.BytesIO()
        small.save(file, "webp", **form)
        files.append(file.getvalue())
    (PICTURES / f"{name}.webp").write_bytes(min(files, key=len))


def draw_run(folder: Path) -> None:
    """``rig``, ``ground`` and ``detections``: of the first command's run."""
    run = folder / "run"
    _warpav("optimise", f"run.out={run}")
    for name in ("rig", "ground", "detections"):
        shutil.copyfile(run / "figures" / f"{name}.png", folder / f"{name}.png")


def draw_rules(folder: Path) -> None:
    """rules: what the first command finds without the design rules, and with them."""
    halves = []
    for name, options in {"free": ["rules=none", "rig.symmetric=false"], "ruled": []}.items():
        _warpav("optimise", *options, f"run.out={folder / name}")
        with Image.open(folder / name / "figures" / "rig.png") as image:
            halves.append(np.asarray(image.convert("RGB"))[:, image.width // 2 :])
    Image.fromarray(np.hstack(halves)).save(folder / "rules.png")


def draw_coverage(folder: Path) -> None:
    """coverage: where the cameras of nuScenes see a child."""
    _warpav("inspect", "nuscenes", "--show", "coverage", "--out", str(folder / "coverage.png"))


def draw_sheet(folder: Path) -> None:
    """sheet: the cameras of nuScenes on the town's car, to scale."""
    _warpav("inspect", "nuscenes", "--show", "sheet", "--out", str(folder / "sheet.png"))


def draw_mount_drawing(folder: Path) -> None:
    """mount_drawing: where the cameras of nuScenes are mounted on the town's car."""
    _warpav("rig", "drawing", "nuscenes", "--out", str(folder / "mount_drawing.png"))


def draw_fitting(folder: Path) -> None:
    """plot_*: every kind of plot of the rig of a series car on its vehicle."""
    rig = Path(__file__).parent / "surround_rig.yaml"
    for kind in FITTING:
        image = folder / f"plot_{kind}.png"
        _warpav("plot", str(rig), "--config", "surround", "--kind", kind, "--out", str(image))
        with Image.open(image) as drawn:
            small = drawn.convert("RGB").resize((1080, round(1080 * drawn.height / drawn.width)))
        small.save(image)


FITTING = ("plan", "range", "near_field", "redundancy", "resolution", "contact")
"""Kinds of plots of a rig on its vehicle."""


def draw_vehicle(folder: Path) -> None:
    """vehicle: what of the embedded vehicle can carry cameras."""
    _warpav("scenes", "make", "--seeds", "3", "--out", str(folder))
    _warpav("vehicle", "check", str(folder / "scene_3.glb"), "--image", str(folder / "vehicle.png"))


def draw_zones(folder: Path) -> None:
    """zones: where on the body of the embedded vehicle cameras may stand."""
    _warpav("scenes", "make", "--seeds", "3", "--out", str(folder))
    image = str(folder / "zones.png")
    _warpav("vehicle", "zones", str(folder / "scene_3.glb"), "--out", str(folder / "zones.yaml"), "--image", image)


def draw_behind_glass(folder: Path) -> None:
    """behind_glass: what a camera behind the windscreen sees, in the embedded car, the bus and the pickup truck."""
    import warpav as wa
    from warpav.optimisation import X_M, Y_M, CameraMount
    from warpav.rig import chart_of, parts_of
    from warpav.scene import read_vehicle

    [town], images = wa.town([3]), []
    for scene in (town, town.around(read_vehicle("bus")), town.around(read_vehicle("truck"))):
        surface = chart_of(parts_of(scene.ego).panes[:1], scene.ego)
        model = wa.CameraModel(420, 300, math.radians(110.0), near_m=0.01)
        mount = CameraMount(surface, camera=model, height_offset_m=0.0)
        cell_m = surface.origin_m + surface.cell_m * np.argwhere(surface.is_mountable)
        point_m = surface.point_m(cell_m, surface.height_at_m(cell_m))
        wanted_m = [point_m[:, 0].mean(), 0.0, np.quantile(point_m[:, 2], 0.85)]  # in the middle, near the upper edge
        place_m = cell_m[np.linalg.norm((point_m - wanted_m) * [0.0, 1.0, 1.0], axis=1).argmin()]
        pose = np.zeros((1, 7), np.float32)
        pose[0, [X_M, Y_M]], pose[0, 3] = place_m, 0.1
        [image] = wa.render(mount.rig(mount.clipped(pose)), scene, supersampling=3).values()
        images.append(image.rgb)
    gap = np.full((images[0].shape[0], 8, 3), 255, np.uint8)
    row = np.concatenate([images[0], gap, images[1], gap, images[2]], axis=1)
    Image.fromarray(row).save(folder / "behind_glass.png")


def draw_gain(folder: Path) -> None:
    """gain: what one more camera would bring to a rig of a quick search among all zones, on the body."""
    run, zones = folder / "run", folder / "zones.yaml"
    _warpav("scenes", "make", "--seeds", "3", "--out", str(folder))
    _warpav("vehicle", "zones", str(folder / "scene_3.glb"), "--out", str(zones), "--image", str(folder / "zones.png"))
    _warpav("optimise", "quick", f"mount.zones={zones}", f"run.out={run}")
    _warpav("inspect", str(run), "--show", "gain", "--out", str(folder / "gain.png"))


def draw_front(folder: Path) -> None:
    """front: the best rigs of two to eight cameras out of three modules."""
    modules = "rig.modules={side_2mp_100: 0..8, surround_1_4mp_70: 0..8, fisheye_1_3mp_190: 0..8}"
    _warpav("front", "quick", modules, "rig.cameras=2..8", "--out", str(folder / "front"))
    shutil.copyfile(folder / "front" / "front.png", folder / "front.png")


def draw_requirements(folder: Path) -> None:
    """requirements: what of the ground within 5 m the cameras of EDGAR see on the embedded vehicle."""
    _warpav("rig", "requirements", "edgar", "--image", str(folder / "requirements.png"))


def draw_lidar(folder: Path) -> None:
    """lidar: one scan of a roof LiDAR and of one for the blind spot on the left, in dense streets."""
    import warpav as wa

    places = {"lidar_32": ([1.2, 0.0, 1.8], 0.0), "lidar_blind_spot": ([1.6, 0.98, 0.8], 0.5 * math.pi)}
    known = wa.read_modules()
    lidars = [
        wa.Camera(name, place, yaw, model=known[name].camera_model(), module=name)
        for name, (place, yaw) in places.items()
    ]
    scene = wa.town([5000], level="dense")[0].targeting(("vehicle", "pedestrian", "cyclist"))
    wa.plot(wa.Rig(lidars), kind="points", scene=scene, out=folder / "lidar.png")


def draw_series_car(folder: Path) -> None:
    """series_car: what of the ground within 5 m the rig that ``warpav optimise surround`` found sees."""
    rig = Path(__file__).parent / "surround_rig.yaml"
    _warpav("rig", "requirements", str(rig), "--image", str(folder / "series_car.png"))


def draw_sensitivity(folder: Path) -> None:
    """sensitivity: what errors of mounting and the loss of each camera of the series car cost."""
    _warpav("optimise", "surround", f"run.out={folder / 'run'}", "run.pictures=all")
    shutil.copyfile(folder / "run" / "figures" / "sensitivity.png", folder / "sensitivity.png")


def draw_any_camera(folder: Path) -> None:
    """any_camera: how well the fit of the detection probability for any camera is calibrated."""
    _warpav("detector", "fit", "quick", "--any-camera", "--again", "--out", str(folder))
    shutil.copyfile(next(folder.glob("*_reliability.png")), folder / "any_camera.png")


def draw_weights(folder: Path) -> None:
    """weights: weights of road users by place, as the page on the configuration sets them."""
    import matplotlib.pyplot as plt

    from warpav.optimisation import Importance
    from warpav.runs.config import load_config

    table = (
        "{category: {pedestrian: 2, bus: 0.5}, distance_m: {0: 2, 20: 1, 50: 0.5}, "
        "sector_deg: [{from: -30, to: 30, weight: 2}]}"
    )
    importance = Importance(
        load_config("quick", ["scenes.targets=[vehicle, pedestrian]", f"importance={table}"]).importance
    )
    edge_m = np.linspace(-60.0, 60.0, 481)
    middle_m = 0.5 * (edge_m[1:] + edge_m[:-1])
    place_m = np.stack(np.meshgrid(middle_m, middle_m, indexing="ij"), axis=-1).reshape(-1, 2)  # x forward, y left
    figure, axes = plt.subplots(1, 3, figsize=(12.5, 4.2), sharey=True, layout="constrained")
    for axis, (category, kind) in zip(
        axes, (("pedestrian", "pedestrian"), ("car", "vehicle"), ("bus", "vehicle")), strict=True
    ):
        weight = importance.weights_at([category] * len(place_m), [kind] * len(place_m), place_m)
        drawn = axis.pcolormesh(edge_m, edge_m, weight.reshape(480, 480), cmap="YlOrRd", vmin=0.0, vmax=8.0)
        axis.set(aspect="equal", title=f"a {category}", xlabel="y, left [m]", xlim=(60.0, -60.0))
        axis.plot(0.0, 0.0, "k^", markersize=9)
    axes[0].set_ylabel("x, forward [m]")
    figure.colorbar(drawn, ax=axes, label="weight")
    figure.savefig(folder / "weights.png", dpi=90)
    plt.close(figure)


def draw_town_levels(folder: Path) -> None:
    """town_levels: the levels of the town, one a row: ahead, to the left, behind, and from above."""
    import warpav as wa
    from warpav.detection import render_images

    rows = []
    for level, seed, height_m in (("easy", 3, 60.0), ("urban", 3, 120.0), ("dense", 1, 120.0), ("motorway", 6, 170.0)):
        [scene] = wa.town([seed], level=level)
        x_m = float(scene.ego.bounds_m()[:, 0].mean())
        model = wa.CameraModel(420, 270, math.radians(90.0))
        cameras = [
            wa.Camera(f"yaw_{yaw_deg}", np.array([x_m, 0.0, 1.8]), math.radians(yaw_deg), 0.0, 0.0, model)
            for yaw_deg in (0, 90, 180)
        ]
        above = wa.CameraModel(270, 270, math.radians(60.0))
        cameras.append(wa.Camera("above", np.array([x_m, 0.0, height_m]), 0.0, math.radians(89.9), 0.0, above))
        images = [image.rgb for image in render_images(scene, cameras, supersampling=3)]
        gap = np.full((270, 6, 3), 255, np.uint8)
        rows += [np.concatenate([images[0], gap, images[1], gap, images[2], gap, images[3]], axis=1)]
        rows += [np.full((6, rows[-1].shape[1], 3), 255, np.uint8)]
    image = Image.fromarray(np.concatenate(rows[:-1]))
    image.save(folder / "town_levels.png")


def draw_traffic_vehicles(folder: Path) -> None:
    """traffic_vehicles: the same streets, the town's vehicles above, others in all places they fit below."""
    import warpav as wa
    from warpav.detection import render_images
    from warpav.scene import fleet_of, level_scene
    from warpav.scene.traffic.files import shipped_recordings
    from warpav.scene.traffic.moments import moment_of, moments_of
    from warpav.scene.traffic.traffic_scene import TrafficSource

    model = wa.CameraModel(420, 270, math.radians(75.0))
    moment = moment_of(moments_of(shipped_recordings(), wa.town([0])[0].ego.bounds_m()), 8)
    gap = np.full((270, 6, 3), 255, np.uint8)
    rows = []
    for fleet in (None, fleet_of(["shipped"], 1.0)):
        row = []
        scenes = (
            (level_scene(3, "easy", fleet), 0),
            (level_scene(1, "dense", fleet), 90),
            (level_scene(6, "motorway", fleet), 180),
            (TrafficSource(moment, 8, fleet).scene(), 90),
        )
        for scene, yaw_deg in scenes:
            place_m = np.array([float(scene.ego.bounds_m()[:, 0].mean()), 0.0, 1.9])
            [image] = render_images(
                scene, [wa.Camera("camera", place_m, math.radians(yaw_deg), 0.0, 0.0, model)], supersampling=3
            )
            row += [image.rgb, gap]
        rows += [np.concatenate(row[:-1], axis=1)]
    image = Image.fromarray(np.concatenate([rows[0], np.full((6, rows[0].shape[1], 3), 255, np.uint8), rows[1]]))
    image.save(folder / "traffic_vehicles.png")


def draw_stages(folder: Path) -> None:
    """stages: from images to triangle meshes."""
    _warpav("scenes", "figure", "5", "--seed", "3", "--out", str(folder / "stages.png"))


def draw_gradient(folder: Path) -> None:
    """gradient: how the derivative of an area follows from a hard render (kernels/README.md).

    The body is convex, so that its outline is the convex hull of its corners' images; all else is what the kernels do.
    """
    import matplotlib.pyplot as plt
    import trimesh
    from matplotlib.collections import LineCollection, PolyCollection
    from scipy.spatial import ConvexHull

    width, height, focal_px = 16, 12, 14.0
    body = trimesh.creation.icosphere(2, 1.0)
    lengthwise = np.array([[np.cos(0.6), -np.sin(0.6), 0.0], [np.sin(0.6), np.cos(0.6), 0.0], [0.0, 0.0, 1.0]])
    corner_m = body.vertices * (1.75, 1.15, 1.2) @ lengthwise.T + (-0.12, 0.0, 4.6)

    def image_px(point_m: np.ndarray) -> np.ndarray:
        return focal_px * point_m[:, :2] / point_m[:, 2:] + (width / 2, height / 2)

    def hull(point_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the outline in turn, and the normals and offsets of its sides."""
        found = ConvexHull(point_px)
        return found.vertices, found.equations

    def reach_px(start_px: np.ndarray, direction: np.ndarray, side: np.ndarray) -> float:
        """How far the body goes on from a point inside it."""
        along = side[:, :2] @ direction
        distance = -(side[:, :2] @ start_px + side[:, 2])
        return float((distance[along > 0.0] / along[along > 0.0]).min())

    corner_px = image_px(corner_m)
    rim, side = hull(corner_px)
    shift_m = np.array([0.3, 0.04, 0.0])  # of the camera
    after_px = image_px(corner_m - shift_m)[hull(image_px(corner_m - shift_m))[0]]
    centre_px = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    covered = (centre_px @ side[:, :2].T + side[:, 2]).max(axis=-1) < 0.0

    def crossing_px(row: int, column: int, down: int, right: int) -> np.ndarray | None:
        """Where the outline crosses between a sample and its neighbour; None where both are on one side of it."""
        if covered[row, column] == covered[row + down, column + right]:
            return None
        inside, sign = ((row, column), 1.0) if covered[row, column] else ((row + down, column + right), -1.0)
        direction = sign * np.array([right, down], float)
        return centre_px[inside] + reach_px(centre_px[inside], direction, side) * direction

    reaches, segments = [], []
    for row in range(height - 1):
        for column in range(width - 1):
            for down, right in ((0, 1), (1, 0)):
                crossing = crossing_px(row, column, down, right)
                if crossing is not None:
                    inside = (row, column) if covered[row, column] else (row + down, column + right)
                    reaches.append((centre_px[inside], crossing))
            around = ((0, 0, 0, 1), (0, 0, 1, 0), (1, 0, 0, 1), (0, 1, 1, 0))  # the sides of a cell of four samples
            ends = [crossing_px(row + i, column + j, down, right) for i, j, down, right in around]
            met = [end for end in ends if end is not None]
            if len(met) == 2:
                segments.append(met)

    pieces = []
    for start, end in segments:  # cut where they pass from one pixel to the next
        cuts = {0.0, 1.0}
        for axis in range(2):
            low, high = sorted((start[axis], end[axis]))
            for line in range(int(np.ceil(low)), int(np.floor(high)) + 1):
                if high > low:
                    cuts.add(float((line - start[axis]) / (end[axis] - start[axis])))
        ordered = sorted(cut for cut in cuts if 0.0 <= cut <= 1.0)
        pieces += [(start + a * (end - start), start + b * (end - start)) for a, b in pairwise(ordered)]

    # the outline's points are points of the body: each moves as the surface there does
    middle_px = np.array([0.5 * (start + end) for start, end in segments])
    nearest = rim[np.argmin(np.linalg.norm(middle_px[:, None] - corner_px[rim], axis=2), axis=1)]
    flow_px = -focal_px * shift_m[:2] / corner_m[nearest, 2:]

    figure, axes = plt.subplots(1, 3, figsize=(16.6, 5.1), layout="constrained")
    titles = (
        "1  Decide: what covers each sample,\nand how far it goes on towards the next one",
        "2  Outline: a closed polygon through the crossings,\ncut where it enters another pixel",
        "3  Flow: area that each piece sweeps when the camera\nmoves; blue is gained, red is lost",
    )
    for axis, title in zip(axes, titles, strict=True):
        axis.set(title=title, aspect="equal", xticks=range(width), yticks=range(height))
        axis.set(xlim=(0, width), ylim=(height, 0))
        axis.tick_params(length=0, labelbottom=False, labelleft=False)
        axis.grid(color="0.9")
        axis.set_axisbelow(True)
        axis.spines[:].set_color("0.8")
    decide, outline, flow = axes

    facing = np.linalg.det(np.diff(corner_px[body.faces], axis=1)) < 0.0
    triangle_px = corner_px[body.faces[facing]]
    decide.add_collection(PolyCollection(triangle_px, facecolor="#dce7f3", edgecolor="#a9c4de", lw=0.8))
    decide.scatter(*centre_px[covered].T, s=36, color="#1f4e80", label="covered", zorder=3)
    decide.scatter(*centre_px[~covered].T, s=20, facecolor="none", edgecolor="0.55", label="not covered", zorder=3)
    for number, (start, end) in enumerate(reaches):
        label = "reach" if number == 0 else None
        decide.plot(*np.stack([start, end]).T, "-o", color="#d0455c", lw=2, ms=5, markevery=[1], label=label, zorder=4)
    for axis, points, label in ((outline, corner_px[rim], "true outline"), (flow, after_px, "true outline afterwards")):
        axis.fill(*points.T, facecolor="none", edgecolor="0.45", ls="--", lw=1.0, label=label)
    colour = plt.get_cmap("tab20")(np.arange(len(pieces)) % 20)
    outline.add_collection(LineCollection(pieces, colors=colour, lw=3.5, label="piece in one pixel"))
    outline.scatter(*np.concatenate(segments).T, s=24, color="black", zorder=3)

    for (start, end), motion in zip(segments, flow_px, strict=True):
        outward = np.array([(end - start)[1], -(end - start)[0]])
        outward *= np.sign(outward @ (0.5 * (start + end) - centre_px[covered].mean(axis=0)))
        swept = [start, end, end + motion, start + motion]
        flow.add_collection(PolyCollection([swept], facecolor="#7aa3dc" if outward @ motion > 0.0 else "#e79fa4"))
        middle = 0.5 * (start + end)
        flow.annotate("", middle + motion, middle, arrowprops={"arrowstyle": "-|>", "color": "0.2", "lw": 1.0})
    flow.add_collection(LineCollection(segments, colors="black", lw=2.0, label="outline now"))
    for axis in axes:
        axis.legend(loc="lower left", fontsize=9)
    figure.savefig(folder / "gradient.png", dpi=100, bbox_inches="tight")
    plt.close(figure)


def draw_traffic(folder: Path) -> None:
    """traffic: scenes of recorded traffic, from above and as a camera sees them."""
    import pyvista as pv

    import warpav as wa

    _warpav("scenes", "traffic", "--seeds", "[0,2,8]", "--out", str(folder))
    rows = []
    for scene in wa.read_scenes(folder):
        plotter = pv.Plotter(off_screen=True, window_size=(420, 420))
        for mesh in (scene.environment, scene.ego, *(user.mesh for user in scene.road_users)):
            surface = pv.PolyData.from_regular_faces(mesh.vertex_m, mesh.triangle)
            surface["rgb"] = mesh.vertex_rgb
            plotter.add_mesh(surface, scalars="rgb", rgb=True, lighting=False)
        plotter.camera_position = [(8.0, 0.0, 140.0), (8.0, 0.0, 0.0), (1.0, 0.0, 0.0)]
        plotter.camera.parallel_projection, plotter.camera.parallel_scale = True, 36.0
        images = [np.asarray(plotter.screenshot())]
        plotter.close()
        seen = wa.render(wa.preset("nuscenes"), scene, supersampling=2)
        for name in ("CAM_FRONT", "CAM_FRONT_LEFT"):
            image = Image.fromarray(seen[name].rgb)
            images.append(np.asarray(image.resize((round(420 * image.width / image.height), 420))))
        rows.append(np.concatenate(images, axis=1))
    Image.fromarray(np.concatenate(rows)).resize((1280, round(1280 * 1260 / rows[0].shape[1]))).save(
        folder / "traffic.png"
    )


def draw_places(folder: Path) -> None:
    """places: what rigs miss in other streets that were chosen on few or many, from the rows of ``results.csv``."""
    import matplotlib.pyplot as plt

    from warpav.experiments import read_rows

    rows = [row for row in read_rows(PICTURES.parent / "results.csv") if row["study"] == "places" and row["seed"]]
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.4), sharey=True, layout="constrained")
    for axis, first, label in zip(axes, ("streets", "scenes"), (_STREETS, _MOMENTS), strict=True):
        missed: dict[int, list[float]] = {}
        for row in rows:
            kind, number = row["arm"].split("_")
            count = {"scenes": 6, "streets": 8}[first] if row["arm"] == "streets_8" else int(number)
            if kind == first or row["arm"] == "streets_8":
                missed.setdefault(count, []).append(float(row["misses_at_equal_false_alarms"]))
        counts = sorted(missed)
        for count in counts:
            axis.plot([count] * len(missed[count]), missed[count], "o", color="tab:blue", alpha=0.4)
        axis.plot(counts, [np.mean(missed[count]) for count in counts], "_-", color="black", markersize=14)
        axis.set_xscale("log", base=2)
        axis.set_xticks(counts, [str(count) for count in counts])
        axis.minorticks_off()
        axis.set_xlabel(label)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("missed of 100 vehicles\nat half a false alarm an image")
    figure.savefig(folder / "places.png", dpi=110)
    plt.close(figure)


def draw_costs(folder: Path) -> None:
    """costs: what known layouts, rigs by hand and found ones cost and miss, from the rows of ``results.csv``."""
    import matplotlib.pyplot as plt

    from warpav.experiments import read_rows

    studies: dict[str, list[dict[str, str]]] = {}
    for row in read_rows(PICTURES.parent / "results.csv"):
        if row["study"].startswith("at_cost_"):
            studies.setdefault(row["study"].removeprefix("at_cost_"), []).append(row)
    figure, axes = plt.subplots(1, 3, figsize=(13.0, 4.2), layout="constrained")
    for axis, traffic in zip(axes, ("dense", "sind", "motorway"), strict=True):
        found = []
        for study in sorted(each for each in studies if traffic in each.split("_")):
            places = {arm: _cost_and_misses(studies[study], arm) for arm, *_ in _AT_COST}
            found.append(places["default"])
            for arm, label, marker, colour in _AT_COST:
                x, y = places[arm]
                axis.plot(x, y, marker, color=colour, label=label if len(found) == 1 else None)
                for row in studies[study]:
                    if row["arm"] == arm and row["of"] and row["low"]:  # of the difference, at what is compared
                        ends = [found[-1][1] + float(row[end]) for end in ("low", "high")]
                        axis.plot([x, x], ends, color=colour, lw=1.2, alpha=0.6)
            name = study.replace("_quick", "").removesuffix(f"_{traffic}").replace("_", " + ")
            axis.annotate(name, places["as_built"], (4, 4), textcoords="offset points", fontsize=7)
        if found:
            front = pareto_front(np.array(found))
            axis.step(*front.T, where="post", color=_AT_COST[-1][-1], lw=1.0)
            for knee in front[knee_of(front)][None][: len(front) - 2]:  # of two there is none
                axis.plot(*knee, "o", markersize=15, markerfacecolor="none", color="black")
                axis.annotate("knee", knee, (10, -14), textcoords="offset points", fontsize=9)
        axis.margins(x=0.25)
        axis.set_xlim(left=0.0)
        axis.set(title=traffic, xlabel="cost of all modules (1: a side camera of 2 MP)")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("missed of 100 road users,\nas many false alarms a scene")
    axes[0].legend(fontsize=8)
    figure.savefig(folder / "costs.png", dpi=110)
    plt.close(figure)


_AT_COST = (
    ("as_built", "as built", "s", "tab:red"),
    ("by_hand", "best by hand, same modules", "^", "tab:orange"),
    ("default", "warpav, at most that cost; line: its front", "o", "tab:blue"),
)


def _cost_and_misses(rows: list[dict[str, str]], arm: str) -> tuple[float, float]:
    runs = [row for row in rows if row["arm"] == arm and row["seed"]]
    cost, missed = ([float(run[name]) for run in runs] for name in ("cost", "misses_at_equal_false_alarms"))
    return float(np.mean(cost)), float(np.mean(missed))


def pareto_front(point: np.ndarray) -> np.ndarray:
    """Those of points [point, 2] that no other is below in both, by the first number."""
    point = point[np.lexsort(point.T[::-1])]
    return point[point[:, 1] < np.minimum.accumulate(np.r_[np.inf, point[:-1, 1]])]


def knee_of(front: np.ndarray) -> int:
    """The point of a front that is farthest below the line between its ends, both axes scaled to them."""
    span = np.maximum(np.ptp(front, axis=0), 1e-12)
    share = (front - front[0]) / span
    return int(np.argmin(share.sum(axis=1)))


_STREETS = "streets that 48 scenes show (a dot: a draw of streets)"
_MOMENTS = "scenes of each of 8 streets"

DRAWN: dict[str, Callable[[Path], None]] = {
    "rig": draw_run,
    "ground": draw_run,
    "detections": draw_run,
    "rules": draw_rules,
    "coverage": draw_coverage,
    "sheet": draw_sheet,
    "mount_drawing": draw_mount_drawing,
    **{f"plot_{kind}": draw_fitting for kind in FITTING},
    "places": draw_places,
    "costs": draw_costs,
    "vehicle": draw_vehicle,
    "front": draw_front,
    "zones": draw_zones,
    "behind_glass": draw_behind_glass,
    "gain": draw_gain,
    "requirements": draw_requirements,
    "series_car": draw_series_car,
    "lidar": draw_lidar,
    "sensitivity": draw_sensitivity,
    "any_camera": draw_any_camera,
    "weights": draw_weights,
    "traffic_vehicles": draw_traffic_vehicles,
    "town_levels": draw_town_levels,
    "stages": draw_stages,
    "gradient": draw_gradient,
    "traffic": draw_traffic,
}
"""By name in docs/pictures; each writes NAME.png to the folder that it is handed."""


if __name__ == "__main__":
    os.environ["SOURCE_DATE_EPOCH"] = "1790000000"  # the date on sheets, the same in every picture
    wanted = sys.argv[1:] or list(DRAWN)
    unknown = sorted(set(wanted) - set(DRAWN))
    if unknown:
        raise SystemExit(f"{', '.join(unknown)}: expected images out of {', '.join(DRAWN)}")
    for draw in dict.fromkeys(DRAWN[name] for name in wanted):
        with tempfile.TemporaryDirectory() as folder:
            draw(Path(folder))
            for name in wanted:
                if DRAWN[name] is draw:
                    keep(name, Path(folder) / f"{name}.png")
