"""The plan of the house: few rooms on few floors, few arrows between them, no circle, and not more than fits.

Floors, and imports that may point upwards, stand in ``pyproject.toml`` under ``tool.importlinter`` and nowhere else.
Imports inside functions and for annotations count like all others.
"""

import ast
import importlib.util
import re
import tomllib
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).parents[2]
MOST_ROOMS, MOST_FLOORS, MOST_ARROWS = 12, 9, 55
THIN_METHODS = {"plot", "to_pyvista"}
CONTRACTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
[LAYERS] = [each for each in CONTRACTS if each["type"] == "layers"]
FLOOR = {f"warpav.{name.strip()}": k for k, layer in enumerate(LAYERS["layers"]) for name in layer.split("|")}
EXEMPT = {tuple(line.split(" -> ")) for line in LAYERS["ignore_imports"]}


@pytest.fixture(scope="module")
def graph():
    return grimp.build_graph("warpav", cache_dir=None)


@pytest.fixture(scope="module")
def imports(graph):
    """What every module imports of warpav."""
    return {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}


def room(module):
    return ".".join(module.split(".")[:2])


def circle_in(imports):
    """One circle of modules that import one another, or none."""
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def arrows_of(imports):
    """Rooms that import from one another; the package's own face imports from where it likes."""
    return {
        (room(one), room(other))
        for one, others in imports.items()
        for other in others
        if room(one) != room(other) and "warpav" not in (one, other)
    }


def test_a_circle_is_found():
    assert circle_in({"a": {"b"}, "b": {"c"}, "c": set()}) == []
    assert set(circle_in({"a": {"b"}, "b": {"c"}, "c": {"b"}})) == {"b", "c"}


def test_rooms_are_few_and_all_on_a_floor(graph):
    rooms = graph.find_children("warpav")
    assert rooms == FLOOR.keys()
    assert len(rooms) <= MOST_ROOMS
    assert len(LAYERS["layers"]) <= MOST_FLOORS


def test_arrows_between_rooms_are_few_and_point_downwards(imports):
    left = {one: {other for other in others if (one, other) not in EXEMPT} for one, others in imports.items()}
    assert [arrow for arrow in sorted(arrows_of(left)) if FLOOR[arrow[0]] >= FLOOR[arrow[1]]] == []
    assert len(arrows_of(imports)) <= MOST_ARROWS


ROOMS = sorted(path.parent.name for path in (ROOT / "warpav").glob("*/__init__.py"))
FACES = {path.parent.name: path for path in (ROOT / "warpav").glob("*/__init__.pyi")}


def test_rooms_go_to_nobodys_private_modules(imports):
    past = [(one, other) for one, others in imports.items() for other in others if room(one) != room(other)]
    assert [arrow for arrow in past if "._" in arrow[1]] == []


def imported(path, package):
    """Names that a file imports from a package or its modules, also in code that it holds as text."""
    lines = re.findall(rf"from {package}[\w.]* import (\([^)]*\)|.*)", path.read_text(encoding="utf-8"))
    return {words.split()[0] for line in lines for words in line.strip("()").split(",") if words.strip()}


@pytest.mark.parametrize("name", sorted(FACES.keys() - {"raster"}))
def test_a_face_lists_what_other_rooms_use_and_nothing_else(name):
    """That of the rasteriser is for users."""
    others = [path for path in (ROOT / "warpav").rglob("*.py*") if path.suffix in (".py", ".pyi")]
    used = [imported(path, f"warpav.{name}") for path in others if path.relative_to(ROOT).parts[1] != name]
    assert imported(FACES[name], "warpav") - set().union(*used) == set()


def test_modules_without_a_face_are_few(graph):
    """Of rooms that have a face, modules that others may import beside it."""
    beside = [module for module in graph.modules if "._" not in module and module.split(".")[1:2] != ["raster"]]
    files = [module for module in beside if (ROOT / f"{module.replace('.', '/')}.py").is_file()]
    assert len([module for module in files if module.split(".")[1] in FACES]) <= MOST_OPEN_MODULES


@pytest.mark.parametrize("name", ROOMS)
def test_no_modules_of_a_room_import_one_another(imports, name):
    inside = {
        one: {other for other in others if room(other) == room(one) and (one, other) not in EXEMPT}
        for one, others in imports.items()
        if room(one) == f"warpav.{name}"
    }
    assert inside
    assert circle_in(inside) == []


@pytest.mark.parametrize("line", LAYERS["ignore_imports"])
def test_only_thin_methods_are_exempt(graph, line):
    """An exempt import stands in a method that draws, or is there for annotations alone."""
    one, other = line.split(" -> ")
    nodes = list(ast.walk(ast.parse(Path(importlib.util.find_spec(one).origin).read_text())))
    thin = [node for node in nodes if isinstance(node, ast.FunctionDef) and node.name in THIN_METHODS]
    typing = [node for node in nodes if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    for each in graph.get_import_details(importer=one, imported=other):
        number = each["line_number"]
        assert any(node.lineno <= number <= node.end_lineno for node in (*thin, *typing)), each


MOST_LINES = {
    "warpav/cli": 1_665,
    "warpav/core": 2_324,
    "warpav/detection": 5_133,
    "warpav/experiments": 3_585,
    "warpav/optimisation": 11_866,
    "warpav/raster": 4_040,
    "warpav/rig": 6_740,
    "warpav/runs": 12_426,
    "warpav/scene": 14_010,
    "warpav/sight": 2_189,
    "warpav/thesis": 1_172,
    "warpav/view": 8_612,
    "kernels/warpav_kernels": 7_612,
    "tests": 49_011,
}
"""Lines of Python by folder; what grows here shrinks there, so these only ever fall."""
MOST_FILES, MOST_NAMES, MOST_DOCUMENT_BYTES, MOST_FILE_LINES, MOST_OPEN_MODULES = 343, 965, 301_592, 800, 9


def lines_below(folder):
    return {path: path.read_text(encoding="utf-8").count("\n") for path in (ROOT / folder).rglob("*.py")}


@pytest.mark.parametrize("folder", MOST_LINES)
def test_no_room_grows(folder):
    lines = lines_below(folder)
    assert sum(lines.values()) <= MOST_LINES[folder]
    assert [path.name for path, count in lines.items() if count > MOST_FILE_LINES] == []


def test_every_room_has_its_measure():
    assert {folder for folder in MOST_LINES if folder.startswith("warpav/")} == {f"warpav/{name}" for name in ROOMS}


def public_names(path):
    """Functions, classes and constants of a module that say neither by their name nor by its that they are private."""
    if any(part.startswith("_") and part != "__init__.py" for part in path.parts):
        return []
    names = []
    for node in ast.parse((ROOT / path).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.append(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names += [each.id for each in targets if isinstance(each, ast.Name)]
    return [name for name in names if not name.startswith("_")]


def test_public_names_are_few():
    paths = [*lines_below("warpav"), *lines_below("kernels")]
    named = sum(len(public_names(path.relative_to(ROOT))) for path in paths)
    assert named + sum(len(imported(path, "warpav")) for path in FACES.values()) <= MOST_NAMES


def test_files_are_few_and_documents_short():
    assert len(lines_below("warpav")) + len(lines_below("kernels")) <= MOST_FILES
    pages = [path for path in (ROOT / "docs").rglob("*.md") if "generated" not in path.parts]
    assert sum(path.stat().st_size for path in pages) <= MOST_DOCUMENT_BYTES
