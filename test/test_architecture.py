"""The rules of the tree, read off the source: who may import whom, and what nobody may do."""

import ast
from pathlib import Path

import pytest

import omsm_ros

PACKAGE = Path(omsm_ros.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))

# A module may import from its own layer and from those after it.
LAYERS = [
    {"nodes", "cli"},
    {"jobs"},
    {"report", "storage", "devices", "emulators"},
    {"twin", "protocols"},
    {"core"},
    {"errors", "units", "sosfilt"},
]
RANK = {name: rank for rank, layer in enumerate(LAYERS) for name in layer}

# The rooms of the core, and which other rooms each may use.
SAMPLES = set()
DYNAMICS = SAMPLES | {"samples"}
MACHINE = DYNAMICS | {"dynamics"}
FITTING = MACHINE | {"machine"}
ROOMS = {
    "samples": SAMPLES,
    "dynamics": DYNAMICS,
    "machine": MACHINE,
    "fitting": FITTING,
    "identification": FITTING | {"fitting"},
    "correction": FITTING,
    "surface": FITTING | {"correction"},
    "verification": FITTING | {"fitting", "identification", "correction", "surface"},
}

# Foreign modules that only one place may import.
ONLY_IN = {
    "rclpy": {"nodes"},
    "omsm_msgs": {"nodes", "storage.conversions"},
    "sensor_msgs": {"nodes", "storage.conversions"},
    "std_msgs": {"nodes", "storage.conversions"},
    "std_srvs": {"nodes"},
    "diagnostic_msgs": {"nodes"},
    "builtin_interfaces": {"nodes", "storage.conversions"},
    "rcl_interfaces": {"nodes"},
    "serial": {"devices.transport"},
    "socket": {"devices.transport"},
    "rosbags": {"storage"},
    "matplotlib": {"report"},
}
PURE = {"core", "protocols"}
PURE_FOREIGN = {"numpy", "scipy", "control", "cobs"}
# Of the standard library: no clock, file, print, network or process in what decides a number.
IMPURE_STANDARD = {
    "time", "datetime", "os", "sys", "io", "pathlib", "logging", "threading", "subprocess",
    "socket", "tempfile", "shutil", "random", "asyncio", "multiprocessing", "warnings",
}  # fmt: skip
FORBIDDEN_EVERYWHERE = {"pickle", "marshal", "shelve", "dill", "cloudpickle"}


def _name(path):
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


def _imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            assert node.module
            yield node.module
            if node.module == "omsm_ros":
                yield from (f"omsm_ros.{alias.name}" for alias in node.names)


def _own(imported):
    """First part below omsm_ros, or empty for the package itself."""
    parts = imported.split(".")
    return parts[1] if len(parts) > 1 else ""


@pytest.mark.parametrize("path", MODULES, ids=_name)
def test_imports_go_one_way(path):
    layer = _name(path).split(".")[0]
    if layer in ("__init__", "interfaces"):
        return
    assert layer in RANK, f"{layer} belongs to no layer; say where it stands"
    for imported in _imports(path):
        if imported.split(".")[0] == "omsm_ros" and (target := _own(imported)) in RANK:
            assert RANK[target] >= RANK[layer], f"{_name(path)} looks up at {imported}"


CORE = [p for p in MODULES if _name(p).startswith("core.") and p.stem != "__init__"]


@pytest.mark.parametrize("path", CORE, ids=_name)
def test_rooms_of_the_core_look_one_way(path):
    parts = _name(path).split(".")
    assert len(parts) == 3, f"{_name(path)} stands in no room of the core"
    assert parts[1] in ROOMS, f"{parts[1]} is no room of the core; say what it may use"
    for imported in _imports(path):
        if imported.startswith("omsm_ros.core."):
            room = imported.split(".")[2]
            allowed = ROOMS[parts[1]] | {parts[1]}
            assert room in allowed, f"{_name(path)} looks at {imported}"


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_is_no_corridor(room):
    assert len(list((PACKAGE / "core" / room).glob("[!_]*.py"))) <= 17, "make it two rooms"


@pytest.mark.parametrize("path", MODULES, ids=_name)
def test_a_file_is_read_in_one_sitting(path):
    assert len(path.read_text().splitlines()) <= 350, "is it still one thing?"


@pytest.mark.parametrize("path", MODULES, ids=_name)
def test_foreign_modules_stay_in_their_place(path):
    name = _name(path)
    for imported in _imports(path):
        top = imported.split(".")[0]
        assert top not in FORBIDDEN_EVERYWHERE, f"{name} imports {imported}"
        if top in ONLY_IN:
            allowed = any(name == p or name.startswith(f"{p}.") for p in ONLY_IN[top])
            assert allowed, f"{name} imports {imported}, which belongs in {ONLY_IN[top]}"


@pytest.mark.parametrize("path", [p for p in MODULES if _name(p).split(".")[0] in PURE], ids=_name)
def test_what_decides_a_number_is_pure(path):
    import sys

    for imported in _imports(path):
        top = imported.split(".")[0]
        assert top not in IMPURE_STANDARD, f"{_name(path)} imports {imported}"
        known = top in PURE_FOREIGN or top in sys.stdlib_module_names or top == "omsm_ros"
        assert known, f"{_name(path)} imports {imported}"
    calls = {
        node.func.id
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert not calls & {"print", "open", "input"}, f"{_name(path)} calls {calls}"


@pytest.mark.parametrize("path", MODULES, ids=_name)
def test_nothing_is_evaluated_and_yaml_is_loaded_safely(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.Call):
            continue
        if isinstance(node.func, ast.Name):
            assert node.func.id not in {"eval", "exec"}, _name(path)
        elif isinstance(node.func, ast.Attribute) and isinstance(node.func.value, ast.Name):
            called = f"{node.func.value.id}.{node.func.attr}"
            assert called not in {"yaml.load", "yaml.unsafe_load", "yaml.full_load"}, _name(path)
            if called in {"np.load", "numpy.load"}:
                assert not any(k.arg == "allow_pickle" for k in node.keywords), _name(path)


def test_nodes_hold_no_arithmetic():
    for path in (PACKAGE / "nodes").glob("*_node.py"):
        imported = {i.split(".")[0] for i in _imports(path)}
        assert not imported & {"numpy", "scipy", "math", "control"}, path.name
