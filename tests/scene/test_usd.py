"""Vehicles in USD and STEP files: units, axes, instances, purposes, visibility, colours, and what is refused."""

import re

import numpy as np
import pytest
from PIL import Image

from warpav.core.errors import InputError
from warpav.scene import Reading, ego_vehicle, examine, read_scene, read_vehicle, read_vehicle_file

PARTS_OF_USD = ("Gf", "Sdf", "Usd", "UsdGeom", "UsdShade", "UsdUtils", "Vt")
Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils, Vt = (pytest.importorskip(f"pxr.{name}") for name in PARTS_OF_USD)

BOX = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]  # outwards


def light_of(rgb):
    value = np.asarray(rgb) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def stage_at(path, *, metres=1.0, up="Z"):
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    UsdGeom.SetStageUpAxis(stage, up)
    return stage


def box(stage, name, at=(0, 0, 0), size=1.0):
    mesh = UsdGeom.Mesh.Define(stage, name)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy((BOX * size).astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    mesh.CreateFaceVertexIndicesAttr([corner for quad in QUADS for corner in quad])
    mesh.AddTranslateOp().Set(Gf.Vec3d(*at))
    return mesh


def material(stage, name, colour=None, file=None, factor=None):
    made = UsdShade.Material.Define(stage, name)
    surface = UsdShade.Shader.Define(stage, f"{name}/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    made.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    diffuse = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    if file is None:
        diffuse.Set(Gf.Vec3f(*colour))
        return made
    texture, reader = (UsdShade.Shader.Define(stage, f"{name}/{each}") for each in ("texture", "reader"))
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(file)
    if factor is not None:
        texture.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*factor))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("map")
    texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    diffuse.ConnectToSource(texture.ConnectableAPI(), "rgb")
    return made


def bind(prim, to):
    UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(to)


def corners(file):
    return file.vertex[file.triangle].reshape(-1, 3)


def lows(file):
    """The lowest corner of every box, in order."""
    return sorted(
        tuple(each.min(axis=0).round(6).tolist()) for each in np.split(corners(file), len(file.triangle) // 12)
    )


def step_of(low, high, *, unit="SI_UNIT(.MILLI.,.METRE.)", rgb=(0.8, 0.1, 0.2)):
    """A red box as a faceted solid, as CAD systems write it."""
    lines = []

    def add(text):
        lines.append(f"#{len(lines) + 1}={text};")
        return f"#{len(lines)}"

    def row(items):
        return f"({','.join(map(str, items))})"

    app = add("APPLICATION_CONTEXT('automotive design')")
    part, stage = add(f"PRODUCT_CONTEXT('',{app},'')"), add(f"PRODUCT_DEFINITION_CONTEXT('',{app},'design')")
    units = [add(f"(LENGTH_UNIT() NAMED_UNIT(*) {unit})")]
    units += [add("(NAMED_UNIT(*) PLANE_ANGLE_UNIT() SI_UNIT($,.RADIAN.))")]
    units += [add("(NAMED_UNIT(*) SI_UNIT($,.STERADIAN.) SOLID_ANGLE_UNIT())")]
    around = f"GLOBAL_UNIT_ASSIGNED_CONTEXT({row(units)}) REPRESENTATION_CONTEXT('','')"
    context = add(f"(GEOMETRIC_REPRESENTATION_CONTEXT(3) {around})")
    shape = add(f"PRODUCT('box','box','',({part}))")
    shape = add(f"PRODUCT_DEFINITION_FORMATION('','',{shape})")
    shape = add(f"PRODUCT_DEFINITION('','',{shape},{stage})")
    shape = add(f"PRODUCT_DEFINITION_SHAPE('','',{shape})")
    corner = np.array(low) + BOX * (np.array(high) - low)
    point = [add(f"CARTESIAN_POINT('',{row(each.tolist())})") for each in corner]
    faces = []
    for quad in QUADS:
        along = corner[quad[1]] - corner[quad[0]]
        normal = np.cross(along, corner[quad[2]] - corner[quad[1]])
        axes = [add(f"DIRECTION('',{row((v / np.linalg.norm(v)).tolist())})") for v in (normal, along)]
        plane = add(f"AXIS2_PLACEMENT_3D('',{point[quad[0]]},{axes[0]},{axes[1]})")
        plane = add(f"PLANE('',{plane})")
        bound = add(f"POLY_LOOP('',{row(point[k] for k in quad)})")
        bound = add(f"FACE_OUTER_BOUND('',{bound},.T.)")
        faces.append(add(f"FACE_SURFACE('',({bound}),{plane},.T.)"))
    solid = add(f"CLOSED_SHELL('',{row(faces)})")
    solid = add(f"FACETED_BREP('',{solid})")
    look = add(f"COLOUR_RGB('',{rgb[0]},{rgb[1]},{rgb[2]})")
    for kind in ("FILL_AREA_STYLE_COLOUR('',{})", "FILL_AREA_STYLE('',({}))", "SURFACE_STYLE_FILL_AREA({})"):
        look = add(kind.format(look))
    for kind in (
        "SURFACE_SIDE_STYLE('',({}))",
        "SURFACE_STYLE_USAGE(.BOTH.,{})",
        "PRESENTATION_STYLE_ASSIGNMENT(({}))",
    ):
        look = add(kind.format(look))
    styled = add(f"STYLED_ITEM('',({look}),{solid})")
    add(f"MECHANICAL_DESIGN_GEOMETRIC_PRESENTATION_REPRESENTATION('',({styled}),{context})")
    whole = add(f"FACETED_BREP_SHAPE_REPRESENTATION('',({solid}),{context})")
    add(f"SHAPE_DEFINITION_REPRESENTATION({shape},{whole})")
    head = "FILE_DESCRIPTION((''),'2;1');FILE_NAME('','',(''),(''),'','','');FILE_SCHEMA(('AUTOMOTIVE_DESIGN'));"
    body = "\n".join(lines)
    return f"ISO-10303-21;HEADER;{head}ENDSEC;\nDATA;\n{body}\nENDSEC;\nEND-ISO-10303-21;\n"


@pytest.mark.parametrize(("unit", "scale"), [("SI_UNIT(.MILLI.,.METRE.)", 1000.0), ("SI_UNIT($,.METRE.)", 1.0)])
def test_a_step_file_states_its_unit_and_colours(tmp_path, unit, scale):
    pytest.importorskip("cascadio", reason="needs cascadio")
    size = np.array([4.5, 1.8, 1.5])
    path = tmp_path / "car.step"
    path.write_text(step_of([0.0, 0.0, 0.0], (scale * size).tolist(), unit=unit))
    file = read_vehicle_file(path)
    assert (file.usual.up, file.usual.scale, len(file.triangle)) == ("z", 1.0, 12)
    np.testing.assert_allclose(np.ptp(file.vertex, axis=0), size, atol=1e-6)
    assert np.abs(file.vertex_rgb.astype(int) - [204, 26, 51]).max() <= 2  # eight bits of linear light in between
    assert examine(file, file.usual).open_edge_count == 0  # its faces meet


@pytest.mark.parametrize(("unit", "scale"), [("SI_UNIT(.MILLI.,.METRE.)", 1000.0), ("SI_UNIT($,.METRE.)", 1.0)])
def test_a_round_step_file_becomes_few_triangles_near_it(tmp_path, unit, scale):
    """A ball with a radius of .35 m, as a wheel has it: within 2 mm of it, hundreds of triangles do."""
    pytest.importorskip("cascadio", reason="needs cascadio")
    lines = (
        "#901=CARTESIAN_POINT('',(0.,0.,0.));#902=DIRECTION('',(0.,0.,1.));#903=DIRECTION('',(1.,0.,0.));"
        f"#904=AXIS2_PLACEMENT_3D('',#901,#902,#903);#905=SPHERICAL_SURFACE('',#904,{0.35 * scale});"
        f"#906=CARTESIAN_POINT('',(0.,0.,{-0.35 * scale}));#907=VERTEX_POINT('',#906);#908=VERTEX_LOOP('',#907);"
        "#909=FACE_BOUND('',#908,.T.);#910=ADVANCED_FACE('',(#909),#905,.T.);#911=CLOSED_SHELL('',(#910));\n"
    )
    text = step_of([0.0] * 3, [1.0] * 3, unit=unit).replace("FACETED_BREP_SHAPE", "ADVANCED_BREP_SHAPE")
    text = re.sub(r"(#\d+=)FACETED_BREP\('',#\d+\)", r"\1MANIFOLD_SOLID_BREP('',#911)", text)
    (tmp_path / "ball.step").write_text(text.replace("DATA;\n", f"DATA;\n{lines}"))
    file = read_vehicle_file(tmp_path / "ball.step")
    assert len(file.triangle) < 5000  # 1702
    middle_m = file.vertex[file.triangle].mean(axis=1)
    assert np.linalg.norm(middle_m, axis=1).min() > 0.35 - 0.004  # worst seen 1.5 mm


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: "solid", "got: StepFile : Undefined Parsing: Line"),
        (lambda text: text[: len(text) // 2], "got: StepFile : Undefined Parsing: Line"),
        (
            lambda text: text.replace("FACETED_BREP_SHAPE_REPRESENTATION", "SHAPE_OF_NOTHING"),
            "no shape that can be read",
        ),
    ],
)
def test_a_step_file_with_errors_is_refused_in_one_line(tmp_path, capfd, change, message):
    pytest.importorskip("cascadio", reason="needs cascadio")
    (tmp_path / "car.stp").write_text(change(step_of([0.0] * 3, [4500.0, 1800.0, 1500.0])))
    with pytest.raises(InputError) as refused:
        read_vehicle_file(tmp_path / "car.stp")
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", ["usda", "usdc", "usd", "usdz"])
@pytest.mark.parametrize(("up", "metres"), [("Z", 1.0), ("Y", 0.01)])
def test_the_embedded_car_survives_with_its_colours(tmp_path, suffix, up, metres):
    car = ego_vehicle()
    stored = tmp_path / f"car.{'usdc' if suffix == 'usdz' else suffix}"
    stage = stage_at(stored, metres=metres, up=up)
    mesh = UsdGeom.Mesh.Define(stage, "/car")
    vertex = car.vertex_m.astype(np.float64) @ Reading(up.lower(), "x").ego_from_file / metres
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertex.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr([3] * len(car.triangle))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(car.triangle.astype(np.int32).reshape(-1)))
    mesh.CreateDisplayColorPrimvar("vertex").Set(Vt.Vec3fArray.FromNumpy(light_of(car.vertex_rgb).astype(np.float32)))
    stage.Save()
    path = tmp_path / f"car.{suffix}"
    if suffix == "usdz":
        assert UsdUtils.CreateNewUsdzPackage(str(stored), str(path))
    read = read_vehicle(path)
    for name in ("vertex_m", "vertex_rgb"):  # worst seen 4e-7 m and 0: files hold single precision
        ours, theirs = (np.asarray(getattr(each, name), np.float64)[each.triangle] for each in (read, car))
        np.testing.assert_allclose(ours, theirs, atol=2e-6)


def test_what_a_renderer_shows_is_read(tmp_path):
    stage = stage_at(tmp_path / "wheel.usda")
    box(stage, "/wheel/tyre")
    stage.SetDefaultPrim(stage.GetPrimAtPath("/wheel"))
    stage.Save()
    stage = stage_at(tmp_path / "car.usda")
    for k in (1, 2):  # instances of a file beside it
        wheel = UsdGeom.Xform.Define(stage, f"/wheel_{k}")
        wheel.GetPrim().GetReferences().AddReference("./wheel.usda")
        wheel.GetPrim().SetInstanceable(True)
        wheel.AddTranslateOp().Set(Gf.Vec3d(10.0 * k, 0, 0))
    many = UsdGeom.PointInstancer.Define(stage, "/many")  # prototypes stand below it, and are not shown themselves
    box(stage, "/many/prototype", at=(0, 0, 2))
    many.AddTranslateOp().Set(Gf.Vec3d(0, 5, 0))
    many.CreatePrototypesRel().AddTarget("/many/prototype")
    many.CreateProtoIndicesAttr([0, 0, 0])
    many.CreatePositionsAttr([(0, 0, 0), (0, 30, 0), (0, 60, 0)])
    many.InvisId(1, Usd.TimeCode.Default())
    UsdGeom.Imageable(box(stage, "/guide")).CreatePurposeAttr("guide")
    UsdGeom.Imageable(box(stage, "/proxy")).CreatePurposeAttr("proxy")
    UsdGeom.Imageable(box(stage, "/render", at=(0, 0, 50))).CreatePurposeAttr("render")
    hidden = UsdGeom.Xform.Define(stage, "/hidden")
    box(stage, "/hidden/box")
    hidden.MakeInvisible()
    mirrored = box(stage, "/mirrored", at=(0, 0, 90))
    mirrored.AddScaleOp().Set(Gf.Vec3f(1, -1, 1))
    UsdGeom.Cube.Define(stage, "/cube")
    stage.Save()
    file = read_vehicle_file(tmp_path / "car.usda")
    places = [(10, 0, 0), (20, 0, 0), (0, 5, 2), (0, 65, 2), (0, 0, 50), (0, -1, 90)]
    assert lows(file) == sorted(tuple(map(float, each)) for each in places)
    corner = file.vertex[file.triangle]
    volume = np.einsum("ti,ti->t", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])).sum() / 6.0
    assert volume == pytest.approx(len(places))  # all faces point outwards, also of what is mirrored
    notes = " | ".join(file.notes)
    for text in ("purpose guide is left out", "purpose proxy is", "an invisible part", "a Cube is not read"):
        assert text in notes


@pytest.mark.parametrize("is_instance", [False, True])
def test_a_stage_may_refer_to_its_own_prims(tmp_path, is_instance):
    """As Blender writes what occurs often: once, and references to that."""
    stage = stage_at(tmp_path / "car.usda")
    box(stage, "/parts/wheel")
    stage.OverridePrim("/parts").SetSpecifier(Sdf.SpecifierClass)
    for k in range(3):
        wheel = UsdGeom.Xform.Define(stage, f"/car/wheel_{k}")
        wheel.AddTranslateOp().Set(Gf.Vec3d(10 * k, 0, 0))
        wheel.GetPrim().GetReferences().AddInternalReference("/parts")
        wheel.GetPrim().SetInstanceable(is_instance)
    stage.Save()
    file = read_vehicle_file(tmp_path / "car.usda")
    assert len(file.triangle) == 36
    assert sorted({*file.vertex[:, 0].tolist()}) == [0.0, 1.0, 10.0, 11.0, 20.0, 21.0]


def test_materials_become_colours(tmp_path):
    Image.fromarray(np.array([[[200, 0, 0], [0, 100, 0]]], np.uint8)).save(tmp_path / "map.png")
    stage = stage_at(tmp_path / "car.usda")
    split = box(stage, "/split")  # a material for all, and another one for its first face
    bind(split, material(stage, "/red", light_of([200, 10, 20])))
    subset = UsdGeom.Subset.CreateGeomSubset(split, "first", "face", [0], "materialBind")
    bind(subset, material(stage, "/green", light_of([10, 200, 20])))
    mapped = box(stage, "/mapped", at=(5, 0, 0))
    bind(mapped, material(stage, "/map", file="./map.png", factor=(0.5, 1.0, 1.0, 1.0)))
    uv = UsdGeom.PrimvarsAPI(mapped).CreatePrimvar("map", Sdf.ValueTypeNames.TexCoord2fArray, "uniform")
    uv.Set([(0.25, 0.5)] * 3 + [(0.75, 0.5)] * 3)
    box(stage, "/own", at=(9, 0, 0)).CreateDisplayColorPrimvar("constant").Set([Gf.Vec3f(*light_of([1, 2, 3]))])
    lost = box(stage, "/lost", at=(20, 0, 0))
    bind(lost, material(stage, "/lost_map", file="/elsewhere/lost.png"))
    stage.Save()
    file = read_vehicle_file(tmp_path / "car.usda")
    face_rgb = file.vertex_rgb[file.triangle]
    np.testing.assert_array_equal(face_rgb, np.broadcast_to(face_rgb[:, :1], face_rgb.shape))
    half = np.round(255.0 * (1.055 * (0.5 * light_of(200)) ** (1 / 2.4) - 0.055))
    middle = corners(file).reshape(-1, 3, 3).mean(axis=1)
    for x, expected in ((0, {(200, 10, 20): 10, (10, 200, 20): 2}), (5, {(half, 0, 0): 6, (0, 100, 0): 6})):
        rgb = face_rgb[np.abs(middle[:, 0] - x - 0.5) < 1.0, 0]
        found, count = np.unique(rgb, axis=0, return_counts=True)
        assert dict(zip(map(tuple, found.tolist()), count.tolist(), strict=True)) == expected
    assert face_rgb[np.abs(middle[:, 0] - 9.5) < 1.0, 0].tolist() == [[1, 2, 3]] * 12
    assert face_rgb[middle[:, 0] > 15, 0].tolist() == [[150, 152, 156]] * 12
    assert "texture /elsewhere/lost.png not found" in " ".join(file.notes)


def test_a_packed_stage_brings_its_textures(tmp_path):
    Image.new("RGB", (2, 2), (30, 60, 90)).save(tmp_path / "map.png")
    stage = stage_at(tmp_path / "car.usda")
    bind(box(stage, "/box"), material(stage, "/map", file="./map.png"))
    UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/box")).CreatePrimvar(
        "map", Sdf.ValueTypeNames.TexCoord2fArray, "vertex"
    ).Set([(0.5, 0.5)] * 8)
    stage.Save()
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "car.usda"), str(tmp_path / "car.usdz"))
    (tmp_path / "map.png").unlink()
    assert np.unique(read_vehicle_file(tmp_path / "car.usdz").vertex_rgb, axis=0).tolist() == [[30, 60, 90]]


def test_units_are_what_the_file_states_and_doubted_where_no_vehicle_has_them(tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "car.usda"))
    box(stage, "/box", size=4.0)
    stage.Save()
    file = read_vehicle_file(tmp_path / "car.usda")
    assert (file.usual.up, file.usual.scale) == ("y", 0.01)
    assert "states no metersPerUnit" in file.notes[0]
    assert "units: expected a vehicle of 2 to 20 m, got 0.04 m" in examine(file, file.usual).problems[0].text


@pytest.mark.parametrize(("up", "metres"), [("Y", 0.01), ("Z", 1.0)])
def test_a_scene_is_what_stands_below_prims_of_its_names(tmp_path, up, metres):
    """A car of two boxes at (9, 3), an ego vehicle and a plate below, in a stage with its own unit and axis."""
    stage, turn = stage_at(tmp_path / "scene.usda", metres=metres, up=up), Reading(up.lower(), "x").ego_from_file
    stage.GetRootLayer().customLayerData = {"name": "by hand", "sky_zenith_rgb": Vt.DoubleArray([1, 2, 3])}
    world = UsdGeom.Xform.Define(stage, "/world")  # puts the ego frame into the stage's
    frame = np.eye(4)
    frame[:3, :3] = turn / metres
    world.AddTransformOp().Set(Gf.Matrix4d(frame.tolist()))
    car = UsdGeom.Xform.Define(stage, "/world/vehicle_1").GetPrim()
    about = {"class": "car", "instance_id": 1, "box_yaw_deg": 0.0, "velocity_ego_m_s": Vt.DoubleArray([1, 0])}
    sides = {"box_center_m": Vt.DoubleArray([10.0, 3.5, 0.5]), "box_size_m": Vt.DoubleArray([2, 1, 1])}
    car.SetCustomData({**about, **sides})
    box(stage, "/world/vehicle_1/body", at=(9, 3, 0))
    box(stage, "/world/vehicle_1/more/tail", at=(10, 3, 0))
    box(stage, "/world/ego")
    ground = box(stage, "/world/environment/plate", at=(-5, -5, -20), size=20.0)
    ground.CreateDisplayColorPrimvar("constant").Set([Gf.Vec3f(*light_of([1, 2, 3]))])
    stage.Save()
    scene = read_scene(tmp_path / "scene.usda")
    assert (scene.name, scene.sky.zenith_rgb.tolist()) == ("by hand", [1, 2, 3])
    [found] = scene.vehicles
    assert (found.category, found.instance_id, found.velocity_ego_m_s.tolist()) == ("car", 1, [1.0, 0.0])
    np.testing.assert_allclose(found.mesh.bounds_m(), [[9, 3, 0], [11, 4, 1]], atol=1e-5)
    np.testing.assert_allclose(scene.ego.bounds_m(), [[0, 0, 0], [1, 1, 1]], atol=1e-5)
    np.testing.assert_allclose(scene.environment.bounds_m(), [[-5, -5, -20], [15, 15, 0]], atol=1e-5)
    assert np.unique(scene.environment.vertex_rgb, axis=0).tolist() == [[1, 2, 3]]
    box(stage, "/world/lost")
    stage.RemovePrim("/world/environment")
    stage.Save()
    with pytest.raises(InputError, match=r"expected a mesh node named 'environment', got ego, lost, .*; rename"):
        read_scene(tmp_path / "scene.usda")


WHEEL = '#usda 1.0\n(\n  metersPerUnit = {}\n)\ndef Mesh "w" {{}}\n'
PARTS = {"in/wheel.usda": WHEEL.format(1), "out/wheel.usda": WHEEL.format(1), "in/inch.usda": WHEEL.format(0.0254)}
DOUBLED = "".join(
    f'def "a{k}" {{\ndef "x" (references = </a{k + 1}>) {{}}\ndef "y" (references = </a{k + 1}>) {{}}\n}}\n'
    for k in range(20)
)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ('def Xform "a" {}', "expected a mesh with triangles, got none"),
        ('def Mesh "a" (references = @../out/wheel.usda@</w>) {}', "'../out/wheel.usda' leads out of its folder; copy"),
        ('def Mesh "a" (payload = @../out/wheel.usda@</w>) {}', "'../out/wheel.usda' leads out of its folder; copy"),
        ('def Mesh "a" (payload = @OUT/wheel.usda@</w>) {}', "leads out of its folder; copy"),
        ('def Mesh "a" (payload = @link.usda@</w>) {}', "'link.usda' leads out of its folder; copy"),
        ('def Mesh "a" (references = @gone.usda@</w>) {}', "car.usda: the reference 'gone.usda' is not resolved"),
        ('def Mesh "a" (references = @http://a.b/c.usda@</w>) {}', "'http://a.b/c.usda' is not resolved"),
        ('def Mesh "a" (references = @`"../out/wheel.usda"`@</w>) {}', "is not resolved, there is no such file"),
        ('def Mesh "a" (references = @wheel.usda@</x>) {}', "a reference that is not resolved: "),
        ('def Mesh "a" (references = @inch.usda@</w>) {}', "layers of 0.0254 m a unit with Z up in a stage of 1 m"),
        ('def Mesh "a" (clips = { dictionary a = { asset[] assetPaths = [@/x.usda@] } }) {}', "value clips at /a"),
        (DOUBLED, "more than 100,000 prims, references counted"),
        ('variantSet "v" = { "b" {', "parse error"),
        ('def Mesh "a" {\npoint3f[] points = [(0, 0, 0)]\nint[] faceVertexCounts = [3]\n'
         'int[] faceVertexIndices = [0, 1, 2]\n}', "/a: faces of vertices that are not there"),
    ],
)  # fmt: skip
def test_what_a_stage_may_not_do_is_refused_in_one_line(tmp_path, capfd, body, message):
    for name, text in PARTS.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "in/link.usda").symlink_to(tmp_path / "out/wheel.usda")
    path = tmp_path / "in/car.usda"
    body = body.replace("OUT", str(tmp_path / "out"))
    path.write_text(f'#usda 1.0\n(\n  metersPerUnit = 1\n  upAxis = "Z"\n)\n{body}\n')
    with pytest.raises(InputError) as refused:
        read_vehicle(path)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)
    assert capfd.readouterr() == ("", "")
