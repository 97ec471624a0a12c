"""The front door: what `warpav.view.plot` shows and writes of the objects of lower rooms."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.view.stand_ins import ego, needs_opengl, pixels, rig, scene, vehicle
from warpav.core.errors import InputError
from warpav.core.progress import NullProgress
from warpav.raster.mesh import Mesh
from warpav.rig import Rig, mount_surface_from_mesh
from warpav.scene import Scene
from warpav.view import ANIMATION_PX, Canvas, Picture, drawing_of, draws, kinds_of, plot, rig_plotter
from warpav.view._output import Animation
from warpav.view._picture import project_px

SMALL = (160, 100)


@needs_opengl
@pytest.mark.parametrize("name", ["rig", "scene", "mesh", "mount_surface"])
def test_every_class_has_an_image_of_its_own(tmp_path, name):
    surface = mount_surface_from_mesh(ego(), cell_m=0.05)
    objects = {"rig": rig(), "scene": scene(vehicle(1, 9.0, 3.4)), "mesh": ego(), "mount_surface": surface}
    path = tmp_path / "new" / f"{name}.png"
    assert plot(objects[name], out=path, window_size=SMALL) == path
    assert pixels(path).shape == (100, 160, 3)
    assert pixels(path).std() > 5.0
    assert all(next(iter(kinds_of(cls))) == "view" for cls in (Rig, Scene, Mesh, type(surface)))


@needs_opengl
def test_methods_go_through_the_front_door(tmp_path):
    street = scene(vehicle(1, 9.0, 3.4))
    rig().plot(tmp_path / "rig.png", scene=street, window_size=SMALL)
    street.plot(tmp_path / "scene.png", rig=rig(), window_size=SMALL)
    plot(rig(), out=tmp_path / "plot.png", scene=street, window_size=SMALL)
    assert (pixels(tmp_path / "rig.png") == pixels(tmp_path / "plot.png")).all()
    assert (pixels(tmp_path / "scene.png") == pixels(tmp_path / "plot.png")).all()
    street.plot(tmp_path / "above.png", rig=rig(), window_size=SMALL, cpos="xy")
    assert np.abs(pixels(tmp_path / "above.png") - pixels(tmp_path / "plot.png")).mean() > 5.0


@needs_opengl
def test_visibility_is_shown_from_farther_away_and_without_sectors():
    street = scene(vehicle(1, 9.0, 3.4))
    near, wide = (
        drawing_of(street, Canvas(window_size=SMALL, off_screen=True), rig=rig(), visibility=shown)
        for shown in (False, True)
    )
    try:
        reach_m = [np.linalg.norm(np.subtract(one.camera.position, one.camera.focal_point)) for one in (near, wide)]
        assert reach_m[1] / reach_m[0] == pytest.approx(1.0 / 0.62)
        assert "rig/cam_0/sector" in near.actors
        assert "rig/cam_0/sector" not in wide.actors
        assert "visibility/cam_0" in wide.actors
    finally:
        near.close()
        wide.close()


@needs_opengl
def test_without_a_file_it_is_shown(tmp_path, monkeypatch):
    shown = rig().plot(off_screen=True, screenshot=tmp_path / "shot.png", return_img=True, window_size=SMALL)
    assert shown.shape == (100, 160, 3)
    assert (tmp_path / "shot.png").is_file()
    monkeypatch.setattr("warpav.view._plotting.has_display", lambda: False)
    monkeypatch.setattr("warpav.view._picture.has_display", lambda: False)
    monkeypatch.setattr("pyvista.OFF_SCREEN", False)
    with pytest.raises(InputError, match=r"plot: expected a display .* write a file instead, such as plot"):
        rig().plot()


def test_an_image_file_has_a_known_suffix(tmp_path, monkeypatch):
    monkeypatch.setattr("warpav.view._plotting.rig_plotter", lambda *_args, **_options: pytest.fail("drawn"))
    with pytest.raises(
        InputError,
        match=r"rig\.bmp: expected a name that ends in \.png, \.html, \.gif, \.mp4, \.pdf, \.svg, got '\.bmp'",
    ):
        plot(rig(), out=tmp_path / "rig.bmp")


def test_unknown_objects_and_options_are_named(tmp_path):
    with pytest.raises(TypeError, match=r"plot: expected one of .*Mesh, MountSurface,.* Rig.*, got list"):
        plot([], out=tmp_path / "x.png")
    with pytest.raises(TypeError, match=r"plot: iteration: expected an option of a Rig \(ego, scene, mount_surface"):
        plot(rig(), out=tmp_path / "x.png", iteration=3)
    with pytest.raises(TypeError, match=r"plot: screenshot: .* or of an image file \(cpos\)"):
        plot(rig(), out=tmp_path / "x.png", screenshot="y.png")
    for name, meant in {"kin": "kind", "coverages": "coverage", "windowsize": "window_size"}.items():
        with pytest.raises(TypeError, match=rf"plot: {name}: expected an option of a Rig .*; did you mean {meant}\?$"):
            plot(rig(), **{name: "plan"})


@pytest.mark.parametrize("file", ["rig.yaml", Path("runs/first")])
def test_a_file_is_to_be_read_before_it_is_plotted(file):
    with pytest.raises(TypeError, match=r"got (Posix|Windows)?(Path|str); read it first: wa.read_rig, wa.read_run"):
        plot(file)


def test_kinds_are_named_before_anything_is_drawn(tmp_path, registered):
    with pytest.raises(InputError, match=r"^kind: expected one of a Rig \(view, sheet.*\), got 'plann'$"):
        plot(rig(), kind="plann", out=tmp_path / "x.png")
    with pytest.raises(InputError, match=r"kind: expected one of a Ramp \(ramp\), got 'sheet'"):
        drawing_of(registered(), Canvas(), kind="sheet")
    with pytest.raises(InputError, match=r"x\.gif: out: expected a name that ends in \.png, \.pdf, \.svg, got"):
        plot(rig(), kind="sheet", out=tmp_path / "x.gif")
    with pytest.raises(
        TypeError, match=r"plot: visibility: expected an option of a Rig \(ego, scene, range_m, vehicle\)"
    ):
        plot(rig(), kind="sheet", visibility=True, out=tmp_path / "x.png")


def test_a_class_inherits_kinds_and_a_mapping_is_known_by_what_it_can(registered):
    class Steep(registered):
        pass

    draws(Steep, "steep")(lambda *_: None)
    assert list(kinds_of(Steep)) == ["steep", "ramp"]
    assert list(kinds_of(registered)) == ["ramp"]
    assert kinds_of(int) == {}


def test_a_canvas_has_the_size_of_its_file(tmp_path):
    assert Canvas().size_px((7, 5)) == (7, 5)
    assert Canvas(tmp_path / "x.GIF").size_px((7, 5)) == ANIMATION_PX
    assert Canvas(tmp_path / "x.gif", window_size=(9, 9)).size_px((7, 5)) == (9, 9)


@pytest.fixture
def registered():
    """A class of another room, with an animation and a figure."""

    class Ramp:
        pass

    @draws(Ramp, "ramp")
    def _draw(ramp, canvas, *, count=2):
        if canvas.is_animation:
            images = (np.full((20, 30, 3), 60 * k, np.uint8) for k in range(count))
            return Animation(images, count, frame_s=0.1)
        from warpav.view.figures._style import new_figure

        figure = new_figure(2.0, 1.0)
        figure.subplots().plot(range(count))
        return figure

    return Ramp


def test_a_registered_class_is_drawn(registered, tmp_path):
    seen = []

    class Counting(NullProgress):
        def steps(self, description, items, *, count):
            seen.append(count)
            return items

    plot(registered(), out=tmp_path / "ramp.gif", count=4, progress=Counting())
    with Image.open(tmp_path / "ramp.gif") as image:
        assert (image.n_frames, image.size, seen) == (4, (30, 20), [4])
    plot(registered(), out=tmp_path / "ramp.png")
    assert pixels(tmp_path / "ramp.png").shape == (150, 300, 3)
    assert plot(registered(), off_screen=True).size == (300, 150)
    refused = r"ramp\.html: out: expected a name that ends in \.png, \.pdf, \.svg, got|needs the module k3d"
    with pytest.raises(InputError, match=refused):
        plot(registered(), out=tmp_path / "ramp.html")


@needs_opengl
def test_a_rig_without_a_vehicle_floats_above_the_axes():
    canvas = Canvas(window_size=(160, 100), off_screen=True)
    alone = rig_plotter(Picture(rig=rig()), canvas)
    on_ego = rig_plotter(Picture(rig=rig(), scene=scene()), canvas)
    try:
        assert {"axis/x", "axis/y", "axis/z"} <= set(alone.actors)
        assert "ego" not in alone.actors
        assert "ego" in on_ego.actors
        centre_px = project_px(alone, np.array([camera.position_m for camera in rig().cameras]))
        assert ((centre_px > 0) & (centre_px < [160, 100])).all()
    finally:
        alone.close()
        on_ego.close()


def test_a_title_is_text_and_nothing_else(tmp_path):
    """Of a file whose name is not UTF-8, begins formulas, and would colour a terminal."""
    title = "F\udce4 $x_1$ $\\bad$ \x1b[31m"
    sheet = plot(rig(), kind="sheet", ego=ego(), title=title, out=tmp_path / "sheet.png")
    assert pixels(sheet).std() > 5.0
