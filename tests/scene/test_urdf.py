"""Robots in URDF files as ego vehicles: where their links are, what they show, what is refused."""

import numpy as np
import pytest
import trimesh

from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.runs import own_vehicle_digest
from warpav.runs.config import placed_config
from warpav.scene import examine, read_vehicle, read_vehicle_file

ROBOT = """\
<robot name="cart">
  <material name="red"><color rgba="1 0 0.5 1"/></material>
  <link name="base_link">
    <visual><origin xyz="0.5 0 0.3"/><geometry><box size="1.2 0.6 0.3"/></geometry><material name="red"/></visual>
    <collision><geometry><box size="9 9 9"/></geometry></collision>
  </link>
  <link name="wheel">
    <visual><origin rpy="1.5707963267948966 0 0"/><geometry><cylinder radius="0.15" length="0.1"/></geometry></visual>
  </link>
  <link name="mast"><visual><geometry><mesh filename="MESH" scale="0.001 -0.001 0.001"/></geometry></visual></link>
  <link name="lidar_link"/>
  <joint name="axle" type="continuous">
    <parent link="base_link"/><child link="wheel"/><origin xyz="0 0.35 0.15"/><axis xyz="0 1 0"/>
  </joint>
  <joint name="lift" type="prismatic">
    <parent link="base_link"/><child link="mast"/><origin xyz="0.9 0 0.45" rpy="0 0 1.5707963267948966"/>
    <axis xyz="0 0 2"/><limit lower="0.1" upper="0.5" effort="1" velocity="1"/>
  </joint>
  <joint name="fix" type="fixed"><parent link="mast"/><child link="lidar_link"/></joint>
</robot>
"""
LIDAR = '<link name="lidar_link"/>'


def robot(folder, *, named="package://cart/meshes/mast.stl", text=ROBOT):
    """A mast that reaches from 0 to 100 mm along x, to 20 along y and to 400 along z, in a package as ROS has it."""
    (folder / "cart/urdf").mkdir(parents=True)
    (folder / "cart/meshes").mkdir()
    mast = trimesh.creation.box(bounds=[[0, 0, 0], [100, 20, 400]])
    mast.export(folder / "cart/meshes/mast.stl")
    (folder / "cart/urdf/cart.urdf").write_text(text.replace("MESH", named))
    return folder / "cart/urdf/cart.urdf"


@pytest.mark.parametrize("named", ["package://cart/meshes/mast.stl", "../meshes/mast.stl", "file:///home/me/mast.stl"])
def test_links_stand_where_their_joints_put_them(tmp_path, named):
    file = read_vehicle_file(robot(tmp_path, named=named))
    assert (file.usual.up, file.usual.forward, file.usual.scale, file.part) == ("z", "x", 1.0, "3 parts")
    ends = {
        name: [part.min(axis=0).round(4).tolist(), part.max(axis=0).round(4).tolist()]
        for name, part in (("base", file.vertex[:8]), ("wheel", file.vertex[8:-36]), ("mast", file.vertex[-36:]))
    }
    assert ends["base"] == [[-0.1, -0.3, 0.15], [1.1, 0.3, 0.45]]
    np.testing.assert_allclose(ends["wheel"], [[-0.15, 0.3, 0.0], [0.15, 0.4, 0.3]], atol=2e-4)  # it has 32 sides
    # mirrored along its y, turned by 90 degrees, lifted by the least that the joint allows
    assert ends["mast"] == [[0.9, 0.0, 0.55], [0.92, 0.1, 0.95]]
    assert file.vertex_rgb[:8].tolist() == [[255, 0, 128]] * 8
    mast = file.vertex[file.triangle[-12:]]
    assert np.linalg.det(mast - mast.mean(axis=(0, 1))).sum() > 0.0  # its faces look outwards, mirrored as it is


def test_a_robot_needs_no_scale_and_carries_cameras(tmp_path, capsys):
    path = robot(tmp_path)
    file = read_vehicle_file(path)
    found = examine(file, file.usual)
    assert any("got 1.25 m; accepted as stated" in hint for hint in found.hints)
    assert [problem.remedy for problem in found.problems if problem.remedy] == []
    assert np.ptp(read_vehicle(path).bounds_m(), axis=0) == pytest.approx([1.25, 0.7, 0.95], abs=1e-3)
    glb = tmp_path / "cart.glb"
    assert main(["vehicle", "check", str(path), "--rear-axle", "0.15", "--out", str(glb)]) == 0
    words = ["rig", "requirements", "corners", f"scenes.ego={glb}", "--requirements", "near_robot"]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "leg" in out
    assert "lying" in out


def test_another_mesh_of_a_link_is_another_vehicle(tmp_path):
    path = robot(tmp_path)
    with placed_config("quick", [f"scenes.ego={path}"]) as config:
        before = own_vehicle_digest(config)
        assert own_vehicle_digest(config) == before
        trimesh.creation.box(bounds=[[0, 0, 0], [100, 20, 500]]).export(tmp_path / "cart/meshes/mast.stl")
        assert own_vehicle_digest(config) != before


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "MESH",
            "package://cart/meshes/none.stl",
            "link 'mast': expected the mesh file 'package://cart/meshes/none.st",
        ),
        ("MESH", "/etc/passwd", "link 'mast': expected the mesh file '/etc/passwd' beside it, got no such file there"),
        ("robot", "sdf", "got: <sdf> instead of <robot>"),
        (
            '<link name="lidar_link"/>',
            '<link name="lidar_link"/><xacro:m xmlns:xacro="http://www.ros.org/wiki/xacro"/>',
            "xacro cart.urdf > robot.u",
        ),
        ("rgba=", "rgb=", "<color rgba=''> instead of 4 finite numbers"),
        ('radius="0.15"', 'radius="nan"', "<cylinder radius='nan'> instead of 1 finite number;"),
        ('type="continuous"', 'type="hinge"', "joint 'axle': the type 'hinge', which URDF does not have"),
        ('<child link="mast"/>', '<child link="wheel"/>', "joint 'lift': expected a parent, and a child that no other"),
        (
            '<link name="lidar_link"/>',
            '<link name="lidar_link"/><link name="lost"/>',
            "one tree of 5 links, got 2 roots",
        ),
        ("<cylinder", "<capsule", "link 'wheel': <capsule> instead of mesh, box, cylinder or sphere"),
        ("visual", "collision", "expected a mesh with triangles, got none"),
    ],
)
def test_what_is_no_robot_is_refused_in_one_line(tmp_path, old, new, message):
    assert old in ROBOT
    with pytest.raises(InputError) as refused:
        read_vehicle_file(robot(tmp_path, text=ROBOT.replace(old, new)))
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)
