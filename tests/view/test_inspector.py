"""The inspector without a window: what users do, by calls and by events of the mouse and the keyboard."""

import dataclasses
import math

import numpy as np
import pytest

from tests.driving_scene import ConstantDetector, flat_surface
from tests.view.stand_ins import rig, scene, vehicle
from warpav.optimisation import FurtherCameras, ObjectiveOptions, RigObserver
from warpav.raster.decide import Occlusion
from warpav.rig import LEAST_STAND_OFF_M, Rig, builtin_modules, read_rig
from warpav.sight import PATCH_M, Ground, Requirement, check_requirements
from warpav.sight._requirement import SIZES_M, Band, TestObject
from warpav.thesis import BoundsAndSpacing
from warpav.view import Canvas, InspectedRig, Inspector, Steepest, opengl_problem
from warpav.view._layers import _ARROW_M, _GAIN_TITLE
from warpav.view._palette import COVERAGE_RGB, FALSE_POSITIVE_RGB, MISS_RGB, camera_rgb
from warpav.view._picture import project_px

CAR = vehicle(1, 9.0, 0.5)
SCENES = [scene(CAR), scene(vehicle(1, -8.0, -2.0), vehicle(2, 12.0, 3.0))]
SURFACE = flat_surface([0.0, -0.6], [2.6, 0.6], height_m=1.5)
HEIGHT_M = 0.08
FURTHER = FurtherCameras(
    np.array([[1.0, 0.1, 1.6], [1.0, 0.2, 1.6], [2.0, -0.3, 1.6]]),
    np.full(3, np.pi / 2),
    np.zeros(3),
    np.full(3, 1.5),
    np.array([0.02, 0.01, 0.005]),
)
SMALL = Canvas(window_size=(640, 400), off_screen=True)
FOUND_PX = [[100.0, 110.0, 150.0, 150.0]]


def frames(count=3):
    whole = rig()
    return [
        Rig(
            [
                dataclasses.replace(camera, position_m=camera.position_m - [0.02 * (count - 1 - k), 0.0, 0.0])
                for camera in whole.cameras
            ]
        )
        for k in range(count)
    ]


def inspected(detector, **options):
    """The state of an inspector; ``asked`` are the rigs whose detections were wanted."""
    asked = []
    options_of_looks = ObjectiveOptions(occlusion=Occlusion.EXACT)

    def observer_of(rig):
        asked.append(rig)
        return RigObserver(rig, detector(), options_of_looks, device="cpu")

    constraints = BoundsAndSpacing(SURFACE, min_spacing_m=0.2)
    fixed = {"constraints": constraints, "height_offset_m": HEIGHT_M, "observer_of": observer_of}
    made = InspectedRig(frames(), lambda index: SCENES[index], 2, **fixed, **options)
    made.asked = asked
    return made


@pytest.fixture
def state():
    descents = [Steepest(np.full((4, 2), 0.1 * (k + 1)), np.full(4, 0.2)) for k in range(2)] + [None]
    return inspected(lambda: ConstantDetector([FOUND_PX, [], [], []], [[0.9], [], [], []]), descents=descents)


# ------------------------------------------------------------------------------------------------ state


def test_only_what_changed_is_looked_at_again(state):
    before, images = state.coverage, state.images
    state.edits.move(0, np.array([9.0, 0.1, 7.0]))
    assert state.coverage is not before
    assert (state.coverage.is_seen[1:] == before.is_seen[1:]).all()
    assert [new[0] is old[0] for new, old in zip(state.images, images, strict=True)] == [False, True, True, True]
    assert all(jpeg.startswith(b"\xff\xd8") and 0.0 <= share < 1.0 for jpeg, share in images)
    state.edits.undo()
    assert state.rig is state.frames[-1]


def test_frames_and_scenes(state):
    assert state.frame == 2
    moved = state.edits.move(0, np.array([1.0, 0.0]))
    state.go_to(0)
    assert state.rig is state.frames[0]
    assert state.edits.undo() is moved
    with pytest.raises(IndexError, match="frame must be from 0 to 2, got 3"):
        state.go_to(3)
    assert len(state.scene.vehicles) == 1
    state.show_scene(3)
    assert state.scene is SCENES[1]
    with pytest.raises(ValueError, match="at least one rig and one scene, got 0 and 1"):
        InspectedRig([], None, 1, constraints=None, height_offset_m=0.0, observer_of=None)


def test_the_detector_is_asked_once_for_a_rig(state):
    assert state.observation is state.observation
    state.coverage  # noqa: B018 (needs no detector)
    assert len(state.asked) == 1
    state.edits.pose(0, yaw_deg=200.0)
    state.observation  # noqa: B018
    assert len(state.asked) == 2


MODULES = tuple(builtin_modules().values())[:3]


NEAR = Requirement("near", Band((0.0, 6.0)), 0.8, TestObject("child", SIZES_M["child"]), visible_share=0.3)


def checked(rig, ego):
    return check_requirements(rig, ego, [NEAR])


class BlindDetector(ConstantDetector):
    """Finds nothing in however many images."""

    def detect(self, images_rgb):
        self.answer = [self.answer[0]] * len(images_rgb)
        return super().detect(images_rgb)


@pytest.fixture
def equipped():
    return inspected(lambda: BlindDetector([[]], [[]]), modules=MODULES, check=checked)


def test_requirements_are_checked_again_when_the_rig_changes(state, equipped):
    first = equipped.requirements
    assert first is equipped.requirements
    equipped.edits.pose(1, yaw_deg=50.0)
    again, expected = equipped.requirements, checked(equipped.rig, SCENES[0].ego)
    assert again is not first
    np.testing.assert_array_equal(again.meets, expected.meets)
    assert (again.meets[1] != first.meets[1]).any()
    np.testing.assert_array_equal(again.meets[[0, 2, 3]], first.meets[[0, 2, 3]])
    assert state.requirements is None


# ------------------------------------------------------------------------------------------------ picture


@pytest.fixture
def show(tmp_path):
    """Opens inspectors, which are closed at the end."""
    opened = []

    def make(state, **options):
        if opengl_problem() is not None:
            pytest.skip(f"no OpenGL: {opengl_problem()}")
        opened.append(Inspector(state, save_to=tmp_path / "mine.yaml", canvas=SMALL, **options))
        opened[-1].plotter.show(auto_close=False, interactive=False)
        return opened[-1]

    yield make
    for each in opened:
        each.plotter.close()


@pytest.fixture
def inspector(state, show):
    return show(state)


def picture(inspector):
    inspector.plotter.render()
    return inspector.plotter.screenshot(return_img=True).astype(int)


def press(inspector, key):
    inspector.plotter.iren.interactor.SetKeySym(key)
    inspector.plotter.iren.interactor.KeyPressEvent()


def test_cameras_are_dragged_by_the_mouse_along_the_skin(inspector):
    """One after the other: the place on the skin follows the mouse, and beside the body the nearest place."""
    plotter, state = inspector.plotter, inspector.state
    before = picture(inspector)

    def mouse(action, point_m):
        [[column, row]] = project_px(plotter, np.array([point_m]))
        getattr(plotter.iren, f"_mouse_{action}")(int(column), int(plotter.window_size[1] - row))

    roof_m, skin_m = 1.5 + HEIGHT_M, 1.5 + LEAST_STAND_OFF_M
    for camera, (x_m, y_m), wanted in (
        (0, (1.4, 0.3), (1.4, 0.3, roof_m)),
        (3, (2.9, -0.3), (2.9, -0.3, skin_m)),
        (2, (5.0, 0.2), (2.6, math.nan, roof_m)),
    ):
        old = state.rig.cameras[camera]
        mouse("left_button_press", old.position_m)
        assert inspector.chosen == camera
        mouse("move", [x_m, y_m, roof_m])
        asked = len(state.asked)
        mouse("left_button_release", [x_m, y_m, roof_m])
        assert len(state.asked) == asked + 1  # only now
        # it stands on the surface, and the ball with it
        np.testing.assert_allclose(np.nan_to_num(state.rig.cameras[camera].position_m - wanted), 0.0, atol=0.08)
        ball = plotter.actors[f"rig/cam_{camera}/ball"].center
        np.testing.assert_allclose(ball, state.rig.cameras[camera].position_m, atol=1e-5)
        before_it, after_it = state.edits.undo().rig.cameras, state.edits.redo().rig.cameras
        changed = [new is not old for new, old in zip(before_it, after_it, strict=True)]
        assert changed == [k == camera for k in range(4)]  # one step
    assert np.abs(picture(inspector) - before).max() > 50


def test_keys_do_what_the_help_says(inspector, tmp_path):
    state = inspector.state
    heights = []
    for _ in range(4):
        press(inspector, "c")
        heights.append(inspector.shown_height)
    assert heights == [1, 2, None, 0]
    press(inspector, "n")
    assert state.scene is SCENES[1]
    press(inspector, "d")
    assert {"scene/outcomes/1/body", "scene/outcomes/2/box"} <= set(inspector.plotter.actors)
    press(inspector, "n")
    assert "scene/outcomes/2/box" not in inspector.plotter.actors  # the first scene has one vehicle
    press(inspector, "d")
    assert "scene/vehicles" in inspector.plotter.actors
    yaw = state.rig.cameras[1].yaw_rad
    press(inspector, "Left")
    assert state.rig.cameras[1].yaw_rad == yaw  # no camera is chosen
    inspector.choose(1)
    press(inspector, "Left")
    assert state.rig.cameras[1].yaw_rad == pytest.approx(yaw + math.radians(2.0))
    press(inspector, "Return")
    assert len(read_rig(tmp_path / "mine.yaml").cameras) == 4
    before = (tmp_path / "mine.yaml").read_bytes()
    press(inspector, "Left")
    inspector.drag(0, state.rig.cameras[1].position_m)
    press(inspector, "Return")  # does not replace what is there, and leaves the numbers
    assert (tmp_path / "mine.yaml").read_bytes() == before != (tmp_path / "mine-2.yaml").read_bytes()
    said = inspector._numbers.input.splitlines()
    assert said[-1] == f"wrote {tmp_path / 'mine-2.yaml'}"
    assert "Closest pair of cameras 0.00 m (cam_0, cam_1), at least 0.20 m asked" in said
    press(inspector, "BackSpace")
    assert state.rig.cameras[0].position_m[0] == frames()[-1].cameras[0].position_m[0]


def test_keys_and_a_click_add_and_remove_cameras(equipped, show):
    made = show(equipped)
    made.choose(1)
    for key, count in (("h", 5), ("x", 6), ("Delete", 5), ("BackSpace", 6), ("BackSpace", 5), ("y", 6)):
        press(made, key)
        balls = [name for name in made.plotter.actors if name.endswith("/ball")]
        assert (len(equipped.rig.cameras), len(balls)) == (count, count)
    press(made, "b")
    [[column, row]] = project_px(made.plotter, np.array([[2.2, -0.3, 1.5]]))
    at_px = int(column), int(made.plotter.window_size[1] - row)
    made.plotter.iren._mouse_left_button_press(*at_px)
    made.plotter.iren._mouse_left_button_release(*at_px)
    assert made.chosen == 6
    np.testing.assert_allclose(equipped.rig.cameras[6].position_m, [2.2, -0.3, 1.5 + HEIGHT_M], atol=0.02)


def test_keys_change_modules_and_lay_requirements_on_the_ground(equipped, show):
    made = show(equipped)
    plain = picture(made)
    press(made, "o")
    assert equipped.rig is equipped.frames[-1]  # no camera is chosen
    press(made, "k")
    assert made.shown_height is None
    assert "requirements" in made.plotter.actors
    result = equipped.requirements
    drawn = made.plotter.actors["requirements"].mapper.dataset
    assert made._numbers.input.splitlines()[-1].startswith(f"requirements: {result.is_point_met.mean():.1%} of points")
    count = np.minimum(result.camera_count, 3)
    np.testing.assert_array_equal(drawn.cell_data["RGB"], np.array(COVERAGE_RGB)[count[drawn.cell_data["point"]]])
    assert np.abs(picture(made) - plain).max() > 50
    made.choose(2)
    press(made, "o")
    assert equipped.rig.cameras[2].module == MODULES[0].name
    assert f"{equipped.rig.cameras[2].name}: {MODULES[0].name}" in made._numbers.input
    assert equipped.requirements is not result
    assert read_rig(made.save()).cameras[2].module == MODULES[0].name
    press(made, "k")
    assert "requirements" not in made.plotter.actors


def test_views_follow_the_cameras_and_the_scene(inspector):
    """What is painted is what each camera sees now, coarser while it is dragged."""
    state = inspector.state

    def painted():
        return {name: actor for name, actor in inspector.plotter.actors.items() if name.startswith("visibility/")}

    def points_m(name):
        return painted()[name].mapper.dataset.points

    assert not painted()
    assert "coverage" in inspector.plotter.actors
    press(inspector, "v")
    assert "coverage" not in inspector.plotter.actors  # the ground carries one of the two
    names = {f"visibility/cam_{k}" for k in range(4)}
    assert set(painted()) == names
    before = painted()
    inspector.drag(0, np.array([1.2, 0.3]))
    assert {name for name in names if painted()[name] is before[name]} == names - {"visibility/cam_0"}
    dragged = len(points_m("visibility/cam_0"))
    inspector.drop(0, np.array([1.5, -0.2]))
    assert len(points_m("visibility/cam_0")) > 2 * dragged
    # every side of the view meets in the camera
    assert np.linalg.norm(points_m("visibility/cam_0") - state.rig.cameras[0].position_m, axis=1).min() < 1e-5
    in_first_scene = {name: points_m(name) for name in names}
    press(inspector, "n")
    assert any(not np.array_equal(points_m(name), in_first_scene[name]) for name in names)
    inspector.go_to(0)
    assert np.linalg.norm(points_m("visibility/cam_3") - state.frames[0].cameras[3].position_m, axis=1).min() < 1e-5
    press(inspector, "c")
    assert "coverage" in inspector.plotter.actors
    assert not painted()
    press(inspector, "v")
    press(inspector, "v")
    assert not painted()


@pytest.mark.parametrize(
    ("begin_with", "shown"), [("outcomes", "scene/outcomes/1/body"), ("visibility", "visibility/cam_3")]
)
def test_it_can_begin_without_the_coverage(state, show, begin_with, shown):
    opened = show(state, begin_with=begin_with)
    assert shown in opened.plotter.actors
    assert "coverage" not in opened.plotter.actors
    opened.cycle_coverage()
    assert "coverage" in opened.plotter.actors
    assert (shown in opened.plotter.actors) == (begin_with == "outcomes")  # the ground carries one of the two


def test_a_key_that_fails_says_so_in_the_window(inspector, tmp_path, capfd):
    (tmp_path / "mine.yaml").mkdir()  # in the way of the rig
    press(inspector, "Return")
    said = "".join(inspector._numbers.input.split())
    assert "mine.yaml:expectedaplacetowriteto,got:" in said
    assert "Traceback" not in capfd.readouterr().err
    press(inspector, "c")
    assert "mine.yaml" not in inspector._numbers.input


def test_a_drag_changes_what_is_drawn_in_place(inspector, show):
    """The picture after moves equals one that is drawn anew, and no actor was made for it."""
    plotter, state = inspector.plotter, inspector.state
    actors = dict(plotter.actors)
    for x_m in (1.0, 1.9, 1.4):
        inspector.drag(0, np.array([x_m, 0.3]))
    inspector.drop(0, np.array([1.5, -0.2]))
    inspector.choose(None)
    assert dict(plotter.actors) == actors
    moved = picture(inspector)
    np.testing.assert_array_equal(
        state.coverage.is_seen, Ground.around(state.packed).coverage(state.rig.cameras).is_seen
    )
    state.frames[state.frame] = state.rig  # so that the new slider leaves it as it is
    anew = show(state)
    below = slice(90, None)  # of the numbers
    assert (np.abs(picture(anew) - moved)[below].max(axis=2) > 40).mean() < 1e-3  # edges of the frustum


def test_arrows_of_the_descent_come_and_go(inspector):
    def arrows():
        return {name for name in inspector.plotter.actors if name.startswith("descent/")}

    assert not arrows()  # the last frame is the result
    inspector.go_to(0)
    assert arrows() == {f"descent/cam_{k}/{kind}" for k in range(4) for kind in ("move", "turn")}
    press(inspector, "g")
    assert not arrows()
    press(inspector, "g")
    assert arrows()
    inspector.drag(1, np.array([1.0, 0.0]))
    assert not arrows()  # the gradient was that of the rig before
    with pytest.raises(ValueError, match="a descent for each of 3 rigs, got 1"):
        InspectedRig(frames(), None, 1, constraints=None, height_offset_m=0.0, observer_of=None, descents=[None])


def test_one_more_camera_is_shown_at_the_rig_that_it_would_join(state, inspector, show):
    """Without what a search by a pool has found, the key does nothing and the help is silent of it."""
    press(inspector, "m")
    assert "further_cameras" not in inspector.plotter.actors
    assert "one more camera" not in help_of(inspector)
    state._further = FURTHER
    opened = show(state)
    assert "m: one more camera" in help_of(opened)
    before = picture(opened)
    assert "further_cameras" not in opened.plotter.actors
    press(opened, "m")
    mesh = opened.plotter.actors["further_cameras"].mapper.dataset
    assert set(np.unique(mesh.point_data["gain_of_100"]).round(6)) == {0.5, 1.0, 2.0}
    # the best of a place is an arrow that begins at its camera and points where that looks, the others are dots
    best = mesh.points[mesh.point_data["gain_of_100"] > 1.5]
    np.testing.assert_allclose([best[:, 1].min(), best[:, 1].max()], [0.1, 0.1 + _ARROW_M], atol=1e-6)
    dot = mesh.points[np.isclose(mesh.point_data["gain_of_100"], 1.0)]
    np.testing.assert_allclose(dot.mean(axis=0), FURTHER.position_m[1], atol=1e-3)
    assert np.abs(picture(opened) - before).max() > 50
    scale = list(opened.plotter.scalar_bars.keys())
    assert scale == [_GAIN_TITLE]
    opened.go_to(0)  # another rig
    assert "further_cameras" not in opened.plotter.actors
    assert not list(opened.plotter.scalar_bars.keys())
    opened.go_to(2)
    assert "further_cameras" in opened.plotter.actors
    opened.drag(1, np.array([1.0, 0.0]))
    assert "further_cameras" not in opened.plotter.actors
    opened.go_to(2)
    press(opened, "m")
    assert "further_cameras" not in opened.plotter.actors


def test_the_ground_itself_is_counted(inspector):
    """Its colours and the line are those of a coverage computed anew, also after a drag."""
    state = inspector.state
    press(inspector, "c")
    press(inspector, "c")
    inspector.drag(0, np.array([1.5, 0.6]))
    inspector.choose(0)
    inspector.turn(math.degrees(1.3))  # to the left, where the second looks
    anew = Ground.around(state.packed).coverage(state.rig.cameras, heights_m=(PATCH_M,))
    np.testing.assert_array_equal(state.ground_coverage.count, anew.count)
    row, column = np.nonzero(anew.is_open[0])
    level = np.minimum(anew.count[0, row, column], 3)
    assert len(np.unique(level)) >= 3  # none, one, two cameras
    shown = inspector.plotter.actors["coverage"].mapper.dataset.cell_data["RGBA"]
    np.testing.assert_array_equal(shown[:, :3], np.array(COVERAGE_RGB)[level])
    ground = anew.ground
    centre_m = SCENES[0].ego.bounds_m().mean(axis=0)[:2]
    near = np.hypot(ground.x_m[row] - centre_m[0], ground.y_m[column] - centre_m[1]) < 20.0
    share = [float((anew.count[0, row, column][near] >= count).mean()) for count in (1, 2, 3)]
    line = f"the ground within 20 m: {share[0]:.1%} by 1, {share[1]:.1%} by 2, {share[2]:.1%} by 3 cameras or more"
    assert line in inspector._numbers.input.splitlines()
    press(inspector, "n")  # another scene, another ground
    assert inspector.plotter.actors["coverage"].mapper.dataset.n_cells == state.ground_coverage.is_open.sum()
    press(inspector, "c")
    assert "coverage" not in inspector.plotter.actors


def test_the_body_carries_zones_then_gains_then_nothing(state, inspector, show):
    """Zones stay whatever happens to the cameras; gains belong to the rig of the last frame."""

    def painted(opened):
        return {name for name in opened.plotter.actors if name in ("zones", "gain")}

    assert "z: body: zones, off" in help_of(inspector)
    seen = []
    for _ in range(3):
        press(inspector, "z")
        seen.append(painted(inspector))
    assert seen == [{"zones"}, set(), {"zones"}]  # no search by a pool
    inspector.drop(0, np.array([1.2, 0.3]))
    press(inspector, "n")
    assert painted(inspector) == {"zones"}
    assert "zones/legend/0" in inspector.plotter.actors
    state._further = FURTHER
    opened = show(state, begin_with="gain")
    assert "z: body: zones, one more camera, off" in help_of(opened)
    before = picture(opened)
    assert painted(opened) == {"gain"}
    gain_of_100 = opened.plotter.actors["gain"].mapper.dataset.cell_data["gain_of_100"]
    assert set(np.unique(gain_of_100).round(6)) == {0.5, 1.0, 2.0}
    opened.go_to(0)
    assert painted(opened) == set()
    opened.go_to(2)
    opened.drag(1, np.array([1.0, 0.0]))
    assert painted(opened) == set()
    opened.go_to(2)
    press(opened, "z")
    assert painted(opened) == set()
    assert np.abs(picture(opened) - before).max() > 50
    press(opened, "z")
    assert painted(opened) == {"zones"}


def help_of(inspector):
    return " ".join(inspector.plotter.actors["help"].input.split())


def test_names_follow_the_cameras(inspector):
    label = inspector.plotter.actors["label/cam_0"]
    before = np.array(label.position)
    move = np.array([0.3, 0.1, 0.0])
    place = inspector.state.rig.cameras[0].position_m + move
    inspector.drop(0, place)
    np.testing.assert_allclose(np.array(label.position) - before, move, atol=1e-3)


def test_no_key_is_one_of_vtk(inspector):
    assert not set(inspector.keys) & set("wsrfpuea3jtl")


def test_the_slider_goes_through_the_run(inspector):
    [slider] = inspector.plotter.widgets.slider_widgets
    slider.GetRepresentation().SetValue(0.2)
    slider.InvokeEvent("EndInteractionEvent")
    assert inspector.state.frame == 0
    np.testing.assert_allclose(
        inspector.plotter.actors["rig/cam_0/ball"].center, inspector.state.frames[0].cameras[0].position_m
    )


def test_the_view_shows_the_boxes_of_the_chosen_camera(inspector):
    before = picture(inspector)
    inspector.choose(0)
    after = picture(inspector)
    view = inspector.view_rgb()
    rows, columns = view.shape[:2]
    bottom, right = 400 - 44, 640 - 16
    shown = after[bottom - rows : bottom, right - columns : right]
    assert np.abs(shown - view).max() <= 2
    assert tuple(view[0, 0]) == camera_rgb(0)
    # the detection fits nothing, so it is red, and the vehicle is missed
    scale = 300 / 256
    x0, y0, _, _ = (int(round(value * scale)) + 4 for value in FOUND_PX[0])
    assert tuple(view[y0, x0 + 10]) == FALSE_POSITIVE_RGB
    x0, y0, _, _ = (
        int(round(float(value) * scale)) + 4 for value in inspector.state.observation.cameras[0].truth_box_px[0]
    )
    assert tuple(view[y0, x0 + 5]) == MISS_RGB
    assert (after[bottom - 40 : bottom, right - 40 : right] != before[bottom - 40 : bottom, right - 40 : right]).any()
    inspector.choose(None)
    assert "view" not in inspector.plotter.actors
