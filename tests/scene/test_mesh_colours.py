"""Textures and materials of mesh files: found, followed by split triangles, said when missing."""

import json

import numpy as np
import pytest
import trimesh
from PIL import Image

from tests.raster.bodies import cuboid
from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh
from warpav.scene import read_vehicle, read_vehicle_file, shaded
from warpav.scene._mesh_colours import GREY_RGB, Texture, TexturedMesh, follow_textures

# a texture of 2 x 2 texels, upper row first
RED, GREEN, BLUE, WHITE = (200, 10, 20), (30, 180, 40), (50, 60, 220), (240, 241, 242)
TEXTURE = np.array([[RED, GREEN], [BLUE, WHITE]], np.uint8)
CORNER = np.array([[0, 0, 0], [4, 0, 0], [4, 2, 0], [0, 2, 0]], float)
UV = np.array([[0.1, 0.2], [0.9, 0.2], [0.9, 0.8], [0.1, 0.8]])
EXPECTED = {(0, 0): BLUE, (4, 0): WHITE, (4, 2): GREEN, (0, 2): RED}
"""Colours of the corners of the quad by x and y: v = 0 is the texture's lower row."""


def write_texture(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(TEXTURE).save(path)


def write_obj(path, *, texture="quad.png", options=""):
    lines = ["mtllib quad.mtl"]
    lines += [f"v {x} {y} {z}" for x, y, z in CORNER]
    lines += [f"vt {u} {v}" for u, v in UV]
    path.write_text("\n".join([*lines, "usemtl paint", "f 1/1 2/2 3/3", "f 1/1 3/3 4/4"]) + "\n")
    (path.parent / "quad.mtl").write_text(f"newmtl paint\nKd 0.588 0.588 0.588\nmap_Kd {options}{texture}\n")


def write_gltf(path, *, factor=None):
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(TEXTURE), baseColorFactor=factor)
    quad = trimesh.Trimesh(CORNER, [[0, 1, 2], [0, 2, 3]], process=False)
    quad.visual = trimesh.visual.TextureVisuals(uv=UV, material=material)
    if path.suffix == ".glb":
        quad.export(path)
        return
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(quad)).items():
        (path.parent / (path.name if name == "model.gltf" else name)).write_bytes(data)


DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><unit name="foot" meter="0.3048"/><up_axis>{up}</up_axis></asset>
  <library_images><image id="img"><init_from>{texture}</init_from></image></library_images>
  <library_effects><effect id="fx"><profile_COMMON>
    <newparam sid="surface"><surface type="2D"><init_from>img</init_from></surface></newparam>
    <newparam sid="sampler"><sampler2D><source>surface</source></sampler2D></newparam>
    <technique sid="common"><lambert><diffuse>{diffuse}</diffuse></lambert></technique>
  </profile_COMMON></effect></library_effects>
  <library_materials><material id="mat"><instance_effect url="#fx"/></material></library_materials>
  <library_geometries><geometry id="geo"><mesh>
    <source id="pos"><float_array id="pos-a" count="12">0 0 0 4 0 0 4 2 0 0 2 0</float_array>
      <technique_common><accessor source="#pos-a" count="4" stride="3">
        <param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
      </accessor></technique_common></source>
    <source id="uv"><float_array id="uv-a" count="12">0.1 0.2 7 0.9 0.2 7 0.9 0.8 7 0.1 0.8 7</float_array>
      <technique_common><accessor source="#uv-a" count="4" stride="3">
        <param name="S" type="float"/><param name="T" type="float"/><param name="P" type="float"/>
      </accessor></technique_common></source>
    <vertices id="vtx"><input semantic="POSITION" source="#pos"/></vertices>
    {faces}
  </mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="vs"><node>{transform}
    <instance_geometry url="#geo"><bind_material><technique_common>
      <instance_material symbol="paint" target="#mat"/></technique_common></bind_material></instance_geometry>
  </node></visual_scene></library_visual_scenes>
  <scene><instance_visual_scene url="#vs"/></scene>
</COLLADA>
"""
INPUTS = '<input semantic="VERTEX" source="#vtx" offset="0"/><input semantic="TEXCOORD" source="#uv" offset="1"/>'
TRIANGLES = f'<triangles material="paint" count="2">{INPUTS}<p>0 0 1 1 2 2 0 0 2 2 3 3</p></triangles>'
FACES = {
    "triangles": TRIANGLES,
    "polylist": f'<polylist material="paint" count="1">{INPUTS}<vcount>4</vcount><p>0 0 1 1 2 2 3 3</p></polylist>',
    "polygons": f'<polygons material="paint" count="1">{INPUTS}<p>0 0 1 1 2 2 3 3</p></polygons>',
    "tristrips": f'<tristrips material="paint" count="1">{INPUTS}<p>0 0 1 1 3 3 2 2</p></tristrips>',
    "trifans": f'<trifans material="paint" count="1">{INPUTS}<p>0 0 1 1 2 2 3 3</p></trifans>',
}
SKIN = """<library_controllers><controller id="skin"><skin source="#geo">
  <source id="joint"><Name_array id="joint-a" count="1">bone</Name_array><technique_common>
    <accessor source="#joint-a" count="1"><param name="JOINT" type="name"/></accessor></technique_common></source>
  <source id="bind"><float_array id="bind-a" count="16">1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</float_array><technique_common>
    <accessor source="#bind-a" count="1" stride="16"><param name="TRANSFORM" type="float4x4"/></accessor>
  </technique_common></source>
  <source id="weight"><float_array id="weight-a" count="1">1</float_array><technique_common>
    <accessor source="#weight-a" count="1"><param name="WEIGHT" type="float"/></accessor></technique_common></source>
  <joints><input semantic="JOINT" source="#joint"/><input semantic="INV_BIND_MATRIX" source="#bind"/></joints>
  <vertex_weights count="4"><input semantic="JOINT" source="#joint" offset="0"/>
    <input semantic="WEIGHT" source="#weight" offset="1"/><vcount>1 1 1 1</vcount><v>0 0 0 0 0 0 0 0</v>
  </vertex_weights>
</skin></controller></library_controllers>
<library_nodes><node id="skinned"><instance_controller url="#skin"/></node></library_nodes>"""
TEXTURED = '<texture texture="sampler" texcoord="CHANNEL1"/>'


def write_dae(path, *, faces="triangles", texture="quad.png", diffuse=TEXTURED, transform="", up="Z_UP"):
    text = DAE.format(faces=FACES.get(faces, faces), texture=texture, diffuse=diffuse, transform=transform, up=up)
    path.write_text(text)


def colours(path):
    """Colour of every corner of every triangle by its x and y, each one colour."""
    file = read_vehicle_file(path, vertices_max=None)
    found = {}
    for corner in file.triangle.ravel():
        x, y, _ = np.round(file.vertex[corner], 5)
        found.setdefault((x, y), set()).add(tuple(file.vertex_rgb[corner].tolist()))
    assert all(len(colour) == 1 for colour in found.values())
    return {place: colour.pop() for place, colour in found.items()}


@pytest.mark.parametrize("name", ["quad.obj", "quad.glb", "quad.gltf", "quad.dae"])
def test_a_textured_quad_has_the_texture_at_its_corners(tmp_path, name):
    write = {"obj": write_obj, "glb": write_gltf, "gltf": write_gltf, "dae": write_dae}[name.rpartition(".")[2]]
    write(tmp_path / name)
    write_texture(tmp_path / "quad.png")
    assert colours(tmp_path / name) == EXPECTED
    assert read_vehicle_file(tmp_path / name).notes == ()


@pytest.mark.parametrize("faces", sorted(FACES))
def test_every_kind_of_colladas_faces_is_read(tmp_path, faces):
    write_dae(tmp_path / "quad.dae", faces=faces)
    write_texture(tmp_path / "quad.png")
    assert colours(tmp_path / "quad.dae") == EXPECTED
    file = read_vehicle_file(tmp_path / "quad.dae", vertices_max=None)
    corner = file.vertex[file.triangle]
    doubled = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    np.testing.assert_allclose(doubled, [[0, 0, 8]] * 2)  # upwards, and half of the quad each
    assert (file.usual.scale, file.usual.up) == (0.3048, "z")


@pytest.mark.parametrize(
    ("named", "at"),
    [
        ("quad.png", "quad.png"),
        ("quad.png", "../materials/textures/quad.png"),
        ("../materials/textures/quad.png", "../materials/textures/quad.png"),
        ("model://car/materials/textures/quad.png", "../materials/textures/quad.png"),
        ("model://other/textures/quad.png", "../../other/textures/quad.png"),
        ("C:\\Users\\me\\Quad.PNG", "textures/quad.png"),
        ("quad%20one.png", "quad one.png"),
    ],
)
@pytest.mark.parametrize("kind", ["obj", "dae"])
def test_textures_are_found_where_they_usually_lie(tmp_path, named, at, kind):
    mesh = tmp_path / "car" / "meshes" / f"quad.{kind}"
    mesh.parent.mkdir(parents=True)
    (write_obj if kind == "obj" else write_dae)(mesh, texture=named)
    write_texture(mesh.parent / at)
    assert colours(mesh) == EXPECTED


@pytest.mark.parametrize("kind", ["obj", "dae"])
@pytest.mark.parametrize("is_there", [False, True])
def test_a_texture_that_is_missing_or_broken_is_grey_and_said(tmp_path, kind, is_there):
    (write_obj if kind == "obj" else write_dae)(tmp_path / f"quad.{kind}")
    if is_there:
        (tmp_path / "quad.png").write_bytes(b"no image")
    assert set(colours(tmp_path / f"quad.{kind}").values()) == {tuple(GREY_RGB.tolist())}
    assert read_vehicle_file(tmp_path / f"quad.{kind}").notes == (
        "texture quad.png not found, or not readable: grey instead",
    )


def test_a_gltf_without_its_texture_is_grey_and_without_its_buffer_refused(tmp_path):
    write_gltf(tmp_path / "quad.gltf")
    tree = json.loads((tmp_path / "quad.gltf").read_text())
    tree["images"] = [{"uri": "paint.png"}]
    (tmp_path / "quad.gltf").write_text(json.dumps(tree))
    grey = np.array(list(colours(tmp_path / "quad.gltf").values())).astype(int)
    assert np.abs(grey - GREY_RGB).max() <= 1
    assert "texture paint.png not found" in read_vehicle_file(tmp_path / "quad.gltf").notes[0]
    for file in tmp_path.glob("*.bin"):
        file.unlink()
    with pytest.raises(InputError, match=r"quad\.gltf: vehicle: expected a readable gltf file, got: "):
        read_vehicle_file(tmp_path / "quad.gltf")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("<COLLADA", "<OTHER"), "dae file, got: line [0-9]+: expected COLLADA, got a syntax error: mismatched"),
        (('source="#pos"', 'source="#none"'), "expected a readable dae file"),
        (("2 2 0 0 2 2 3 3</p>", "2 2 0 0 2 2 9 3</p>"), "maxindex=9.* beyond the limits"),
        (('count="4" stride="3"', 'count="40" stride="3"'), "of 4 rows instead of 40"),
        (("0 0 0 4 0 0", "0 0 0 four 0 0"), "Corrupted float array"),
        ((TRIANGLES, ""), "expected a mesh with triangles, got none"),
        (("<node>", '<node><instance_node url="#n"/></node><node id="n"><instance_node url="#n"/>'), "#n not found"),
        (("<node>", "<node>" * 20_000), "expected a readable dae file"),
        (("<library_visual_scenes>", f"{SKIN}<library_visual_scenes>"), "skeleton"),
        (("2 2 0 0 2 2 3 3</p>", "2 2 0 0 2 2 -1 3</p>"), "index -1"),
        (("0 0 0 4 0 0", "0 0 0 nan 0 0"), "no numbers"),
        (('<scene><instance_visual_scene url="#vs"/></scene>', ""), "no scene"),
        (("<COLLADA", "<!DOCTYPE COLLADA [<!ENTITY a 'aa'><!ENTITY b '&a;&a;&a;&a;'>]><COLLADA"), "DOCTYPE"),
    ],
)
def test_broken_collada_is_refused_with_one_line(tmp_path, change, message):
    write_dae(tmp_path / "quad.dae")
    text = (tmp_path / "quad.dae").read_text()
    assert change[0] in text
    (tmp_path / "quad.dae").write_text(text.replace(*change))
    with pytest.raises(InputError, match=message) as caught:
        read_vehicle_file(tmp_path / "quad.dae")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a (readable obj file|mesh with triangles)"),
        ("v 0 0 0\nv 1 0 0\nv 1 1 0\n", "expected a mesh with triangles, got none"),
        ("v 0 0 0\nv nan 0 0\nv 1 1 0\nf 1 2 3\n", "finite|nan"),
    ],
)
def test_empty_meshes_and_vertices_that_are_no_numbers_are_refused(tmp_path, text, message):
    (tmp_path / "car.obj").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_vehicle(tmp_path / "car.obj")
    assert "\n" not in str(caught.value)


# ----------------------------------------------------------------------------------------------- as downloaded


QUAD = np.array([[0, 0, 0], [4, 0, 0], [4, 2, 0], [0, 2, 0]], float)
TWO = np.array([[0, 1, 2], [0, 2, 3]])


def textured(texel_rgb, vertex=QUAD, triangle=TWO, uv=None, texture_of=0):
    texture = Texture(Image.fromarray(np.asarray(texel_rgb, np.uint8)))
    uv = vertex[:, :2] / vertex[:, :2].max(axis=0) if uv is None else uv
    rgb = texture.rgb(uv).astype(float)
    return TexturedMesh(vertex, triangle, rgb, uv, np.full(len(triangle), texture_of)), [texture]


def chequers(count, texels=8):
    field = (np.add.outer(np.arange(count), np.arange(count)) % 2 * 200 + 20).astype(np.uint8)
    return np.repeat(np.repeat(field, texels, 0), texels, 1)[..., None].repeat(3, axis=2)


def areas(mesh):
    corner = mesh.vertex[mesh.triangle]
    return 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)


def rms_on(mesh, textures, rng, count=50_000):
    """Rms difference of drawn colour and texture at random points of the textured surface, of 255."""
    area = np.where(mesh.texture_of >= 0, areas(mesh), 0.0)
    index = rng.choice(len(area), count, p=area / area.sum())
    share = rng.dirichlet(np.ones(3), count)  # even over a triangle
    corner = mesh.triangle[index]
    drawn, uv = (np.einsum("pc,pcx->px", share, each[corner]) for each in (mesh.rgb, mesh.uv))
    there = np.zeros_like(drawn)
    for k, texture in enumerate(textures):
        there[mesh.texture_of[index] == k] = texture.rgb(uv[mesh.texture_of[index] == k])
    return float(np.sqrt(((drawn - there) ** 2).mean()))


def rim(mesh):
    """Length of all edges of an odd number of triangles, places joined; and how many there are."""
    place, joined = np.unique(mesh.vertex + 0.0, axis=0, return_inverse=True)
    triangle = joined.reshape(-1)[mesh.triangle]
    edge = np.sort(np.stack([triangle, np.roll(triangle, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    found, count = np.unique(edge, axis=0, return_counts=True)
    odd = found[count % 2 == 1]
    return float(np.linalg.norm(place[odd[:, 0]] - place[odd[:, 1]], axis=1).sum()), len(odd)


def test_a_chequered_quad_is_followed_within_the_budget(rng):
    mesh, textures = textured(chequers(8))
    before = rms_on(mesh, textures, rng)
    errors = []
    for vertices_max in (100, 400, 1600, 6400):
        found = follow_textures(mesh, textures, vertices_max=vertices_max)
        assert len(found.vertex) <= vertices_max
        np.testing.assert_allclose(areas(found).sum(), 8.0, rtol=1e-12)
        assert not found.vertex[:, 2].any()
        assert (np.cross(*(np.diff(found.vertex[found.triangle], axis=1).transpose(1, 0, 2)))[:, 2] > 0.0).all()
        np.testing.assert_array_equal(found.vertex[:4], QUAD)
        np.testing.assert_array_equal(found.rgb[4:], textures[0].rgb(found.uv[4:]))
        np.testing.assert_allclose(found.uv, found.vertex[:, :2] / [4, 2], atol=1e-12)
        assert rim(found)[0] == pytest.approx(12.0)
        errors.append(rms_on(found, textures, rng))
    assert before > 80.0
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.35 * before  # measured: .334


def test_a_closed_box_stays_closed():
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    side = [[0, 1, 3], [0, 3, 2]], [[4, 6, 7], [4, 7, 5]], [[0, 4, 5], [0, 5, 1]]
    other = [[2, 3, 7], [2, 7, 6]], [[0, 2, 6], [0, 6, 4]], [[1, 5, 7], [1, 7, 3]]
    index = np.array([*side, *other]).reshape(-1)
    # every triangle with vertices of its own, as where textures do not join
    uv = np.tile([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]], (12, 1))
    mesh, textures = textured(chequers(8), corner[index], np.arange(36).reshape(-1, 3), uv)
    found = follow_textures(mesh, textures, vertices_max=4000)
    assert len(found.vertex) > 3000
    assert rim(found) == (0.0, 0)
    np.testing.assert_allclose(areas(found).sum(), 6.0)


@pytest.mark.parametrize(("rgb", "least"), [([200, 60, 60], 60), ([0, 0, 0], 60)])
def test_a_vehicle_of_one_colour_is_shaded_and_others_are_not(rgb, least):
    box = cuboid((4.0, 2.0, 1.5), (0.0, 0.0, 0.75))
    plain = Mesh.create(box.vertex_m, box.triangle[:, ::-1], rgb)  # inside out, as some files are
    lit = shaded(plain)
    np.testing.assert_array_equal(lit.vertex_m[lit.triangle].mean(axis=1), box.vertex_m[box.triangle].mean(axis=1))
    middle_m, luma = lit.vertex_m[lit.triangle].mean(axis=1), lit.vertex_rgb[lit.triangle].mean(axis=(1, 2))
    top, side = luma[middle_m[:, 2] > 1.49], luma[np.abs(middle_m[:, 1]) > 0.99]
    assert np.ptp(top) == np.ptp(side) == 0.0
    assert top[0] > side[0] + 20.0 > least
    assert shaded(lit) is lit
