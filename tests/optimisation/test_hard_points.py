"""Hard points as inequalities of a polish: margins, their Jacobian, and steps along the edge instead of across it."""

import numpy as np
import pytest

from tests.optimisation.calls import polish
from tests.optimisation.test_ghost_scene import scene
from tests.optimisation.test_modules import columns, symmetric_cameras, symmetric_mount
from tests.optimisation.test_polish import zone_of
from tests.optimisation.test_pool import cameras_of, poses_of
from tests.optimisation.test_pool import mount_of as roof_mount
from tests.optimisation.test_zones import MODEL, mount_of, spread
from warpav.optimisation import HEIGHT_DELTA_M, PITCH_RAD, X_M, Y_M, YAW_RAD, RequiredPoints
from warpav.optimisation._mount import ROLL_RAD
from warpav.optimisation._required_points import _NEAR_EDGE
from warpav.optimisation._single_cameras import _camera_margins, hard_points
from warpav.optimisation._tangent_model import KEPT_BACK, HardPoints


def test_margins_reach_one_where_points_are_met():
    cameras, pose = cameras_of(mount=mount_of()), spread()[:40]
    margin, _ = _camera_margins(cameras, scene(pixels=60.0), pose)
    is_met = RequiredPoints.meets(cameras.detection_probability(pose, scene(pixels=60.0)))
    np.testing.assert_array_equal(margin >= 1.0, is_met)
    assert 0.0 < is_met.mean() < 1.0
    assert hard_points(cameras, scene(weight=0.5)) is None
    points = hard_points(cameras, scene(pixels=60.0))
    np.testing.assert_array_equal(points.margins(pose)[0], margin)
    assert points.needed.shape == (margin.shape[1],)


def test_a_pair_has_the_greater_margin_of_its_two_cameras():
    mount, cameras = symmetric_mount(), symmetric_cameras()
    pose = columns()[mount.is_pair(columns())][:6]
    margin, jacobian = _camera_margins(cameras, scene(), pose)
    is_met = RequiredPoints.meets(cameras.detection_probability(pose, scene()))
    np.testing.assert_array_equal(margin >= 1.0, is_met)
    alone, slope = _camera_margins(cameras.sides[0], scene(), pose)
    is_image = margin > alone
    assert is_image.any()
    np.testing.assert_array_equal(margin[~is_image], alone[~is_image])
    np.testing.assert_array_equal(jacobian[~is_image], slope[~is_image])


@pytest.mark.parametrize(("share", "pixels"), [(0.3, 0.0), (0.01, 3000.0)])
def test_the_jacobian_of_margins_agrees_with_differences(share, pixels):
    cameras = cameras_of(mount=mount_of(model=MODEL.resized(640, 640)))  # as wide as they are drawn: less rough
    seeing = [2, 6, 10, 14]  # some points well enough, and not whole
    pose, ghosts = spread()[seeing].astype(np.float64), scene(share=share, pixels=pixels)
    margin, jacobian = _camera_margins(cameras, ghosts, pose)
    size = 0.01
    for column in (X_M, Y_M, HEIGHT_DELTA_M, YAW_RAD, PITCH_RAD, ROLL_RAD):
        ends = [_camera_margins(cameras, ghosts, pose + side * size * np.eye(7)[column])[0] for side in (1.0, -1.0)]
        slope = (ends[0] - ends[1]) / (2.0 * size)
        is_met = (margin > 1.0) & (np.max([margin, *ends], axis=0) < _NEAR_EDGE) & jacobian.any(axis=2)
        bend = np.abs(ends[0] + ends[1] - 2.0 * margin)
        is_met &= bend < 0.2 * np.abs(ends[0] - ends[1]) + 0.01  # a kink has no slope
        one, other = slope[is_met], jacobian[..., column][is_met]
        assert is_met.sum() > 10, column
        cosine = one @ other / (np.linalg.norm(one) * np.linalg.norm(other))
        assert cosine > 0.97, (column, cosine)
        assert np.linalg.norm(other) == pytest.approx(np.linalg.norm(one), rel=0.1)


def test_only_the_best_cameras_that_could_lose_a_point_are_held():
    margin = np.array([[1.2, 2.5, 0.0], [1.1, 1.5, 0.8], [2.0, 1.3, 0.3]])
    jacobian = np.zeros((3, 3, 7))
    jacobian[..., X_M] = 1.0
    points = HardPoints(lambda pose: (margin, jacobian), np.array([2, 1, 1]))
    edges = points.edges(np.zeros((3, 7)), (margin, jacobian), np.full((3, 7), 0.3))
    # the best two of point 0, of which the other is out of reach; of point 1 likewise; point 2 is not met
    assert list(zip(edges.camera.tolist(), edges.margin.tolist(), strict=True)) == [(0, 1.2), (1, 0.8)]
    np.testing.assert_allclose(edges.spare, [0.2 - KEPT_BACK, 0.0])


def polished(margin_of, *, knows):
    """One camera, one object: ever surer the further it turns left, and a little the further left it stands.

    Args:
        margin_of: Margin of the one hard point and its slope, by y and yaw.
        knows: Whether the polish has the inequality.
    """
    mount = roof_mount(free=None)
    start = poses_of(1, mount)
    start[:, :3] = 0.0, -0.3, 0.0
    tried = []

    def detect(pose):
        y_m, yaw = (float(each) for each in pose[0, [Y_M, YAW_RAD]])
        tried.append((y_m, yaw))
        jacobian = np.zeros((1, 1, 7))
        jacobian[0, 0, [Y_M, YAW_RAD]] = 0.05, 0.4
        return np.array([[0.4 + 0.05 * y_m + 0.4 * yaw]]), jacobian

    def margins(pose):
        value, *slope = margin_of(*(float(each) for each in pose[0, [Y_M, YAW_RAD]]))
        jacobian = np.zeros((1, 1, 7))
        jacobian[0, 0, [Y_M, YAW_RAD]] = slope
        return np.array([[value]]), jacobian

    steps = list(
        polish(
            start,
            detect,
            mount=mount,
            constraints=zone_of(mount, 1),
            scene_count=1,
            is_allowed=lambda pose, probability: margin_of(*tried[-1])[0] >= 1.0,
            hard_points=HardPoints(margins, np.array([1])) if knows else None,
        )
    )
    y_m, yaw = (float(each) for each in steps[-1].mount_pose[0, [Y_M, YAW_RAD]])
    assert margin_of(y_m, yaw)[0] >= 1.0
    return y_m, yaw, len(steps)


def test_where_rejection_stalls_the_inequality_slides_along_the_edge():
    def margin_of(y_m, yaw):
        """At the edge from the start; curved, so that tangents lie beyond it."""
        return 1.06 + (y_m + 0.3) - 2.0 * yaw - 3.0 * yaw**2, 1.0, -2.0 - 6.0 * yaw

    *stalled, _ = polished(margin_of, knows=False)
    y_m, yaw, _ = polished(margin_of, knows=True)
    assert stalled[0] < -0.25
    assert stalled[1] < 0.05
    assert y_m > 0.3
    assert yaw > 0.2


def test_a_kink_is_known_from_rigs_that_were_refused():
    def margin_of(y_m, yaw):
        """An object that is seen whole, without a slope, until it begins to leave the image."""
        left = yaw - 0.1 - 0.3 * (y_m + 0.3)
        return (2.0, 0.0, 0.0) if left < 0.0 else (max(2.0 - 10.0 * left, 0.1), 3.0, -10.0)

    *stalled, _ = polished(margin_of, knows=False)
    y_m, yaw, _ = polished(margin_of, knows=True)
    assert yaw > stalled[1] + 0.05
    assert y_m > stalled[0]


def test_a_refused_rig_adds_its_tangent_where_it_lost_a_point_and_does_not_contradict():
    value, slope = np.array([[1.5, 1.5, 1.5]]), np.zeros((1, 3, 7))
    other, steep = np.array([[0.5, 1.2, 0.5]]), np.zeros((1, 3, 7))
    steep[..., X_M] = [-10.0, -10.0, 10.0]  # its tangents come to 1.5, 2.2 and -0.5 here
    points = HardPoints(lambda pose: (value, slope), np.array([1, 1, 1]))
    refused = [(np.full((1, 7), 0.1), (other, steep))]
    edges = points.edges(np.zeros((1, 7)), (value, slope), np.full((1, 7), 0.2), refused)
    # the second point was not lost there, the third is met here against what the tangent says
    np.testing.assert_allclose(edges.margin, [1.5])
    np.testing.assert_array_equal(edges.jacobian, steep[0, :1])
