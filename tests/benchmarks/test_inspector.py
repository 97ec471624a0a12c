"""Time until the inspector shows a scene of 200,000 triangles, and of one move of the mouse while a camera is dragged.

Left out of the ordinary run; ``pytest tests/benchmarks/test_inspector.py --benchmark-only`` runs it, off screen.
"""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
import trimesh

from tests.view.stand_ins import needs_opengl
from warpav.raster.mesh import Mesh
from warpav.rig import write_rig
from warpav.runs import find_rig
from warpav.runs._inspect import inspector
from warpav.runs.config import load_config
from warpav.scene import town_scene, write_scene
from warpav.view._picture import project_px

pytestmark = needs_opengl

TRIANGLES = 200_000
SCENES = ["scenes.source=folder", "scenes.train_seeds=2..5", "scenes.test_seeds=[0]", "device=cpu"]
OPEN = """
import sys
from warpav.runs._inspect import inspector
from warpav.runs import config_for
with config_for(sys.argv[1], None, sys.argv[2:], default="quick") as config:
    inspector(sys.argv[1], config, off_screen=True).plotter.show(auto_close=False, interactive=False)
"""


def finer(mesh):
    colour = {"rgb": mesh.vertex_rgb.astype(float)}
    vertex_m, triangle, attribute = trimesh.remesh.subdivide(mesh.vertex_m, mesh.triangle, vertex_attributes=colour)
    return Mesh.create(vertex_m, triangle, np.clip(attribute["rgb"].round(), 0, 255))


@pytest.fixture(scope="module")
def arguments(tmp_path_factory):
    """A rig of four cameras, and what makes the inspector show it in the large scene."""
    folder, scene = tmp_path_factory.mktemp("large"), town_scene(1000)
    environment, users = finer(scene.environment), list(scene.vehicles)
    count = len(environment.triangle) + len(scene.ego.triangle) + sum(len(user.mesh.triangle) for user in users)
    for k, user in enumerate(users):
        if count < TRIANGLES:
            users[k] = dataclasses.replace(user, mesh=finer(user.mesh))
            count += len(users[k].mesh.triangle) - len(user.mesh.triangle)
    assert count >= TRIANGLES
    large = dataclasses.replace(scene, environment=environment, vehicles=tuple(users), others=())
    write_scene(large, folder / "scene_0.glb")
    write_rig(find_rig("highest", load_config("quick", []), scene.ego), folder / "four.yaml")
    return [str(folder / "four.yaml"), f"scenes.folder={folder}", *SCENES]


@pytest.fixture
def opened(arguments):
    """Opens the inspector up to its first picture; what is opened is closed at the end."""
    config, plotters = load_config("quick", arguments[1:]), []

    def show(**options):
        found = inspector(arguments[0], config, off_screen=True, **options)
        plotters.append(found.plotter)
        found.plotter.show(auto_close=False, interactive=False)
        return found

    yield show
    for plotter in plotters:
        plotter.close()


def test_open_from_the_shell(benchmark, arguments):
    """From the start of the process to the first picture: most of it is the import of libraries."""
    command = [sys.executable, "-c", OPEN, *arguments]
    benchmark.pedantic(lambda: subprocess.run(command, check=True), rounds=3, warmup_rounds=1)


def test_open(benchmark, opened):
    """From the files of scene, rig and detector to the first picture, in a Python that has done so before."""
    benchmark.pedantic(lambda: opened().plotter.close(), rounds=5, warmup_rounds=1)


@pytest.mark.parametrize("begin_with", ["coverage", "visibility"])
def test_drag(benchmark, opened, begin_with):
    """One move of the mouse with the ball of a camera held: camera, coverage of four cameras, numbers, picture."""
    shown = opened(begin_with=begin_with)
    before, plotter = shown.state.rig.cameras[0].position_m, shown.plotter
    column, row = project_px(plotter, before[None])[0]
    row = plotter.window_size[1] - row
    plotter.iren._mouse_move(int(column), int(row))
    plotter.iren._mouse_left_button_press(int(column), int(row))
    step = iter(range(1, 10_000))

    def move():
        k = next(step)
        plotter.iren._mouse_move(int(column + 60.0 * np.sin(0.3 * k)), int(row + 20.0 * np.cos(0.3 * k)))

    benchmark.pedantic(move, rounds=40, warmup_rounds=5)
    assert (shown.state.rig.cameras[0].position_m != before).any()
