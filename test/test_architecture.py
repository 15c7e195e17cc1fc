"""The rules of the tree, read off the source: who may import whom, and what nobody may do."""

import ast
import sys
from pathlib import Path

import pytest

import omsm_ros

PACKAGE = Path(omsm_ros.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))

# A module may import from its own layer and from those after it.
LAYERS = [
    {"nodes", "cli"},
    {"jobs"},
    {"viewing"},
    {"report", "storage", "devices", "emulators"},
    {"twin", "protocols"},
    {"core"},
    {"parameters"},
    {"quantities", "foreign_units"},
    {"errors", "units", "readable", "least_squares", "scipy_parts", "loading", "seconds"},
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
    "departures": FITTING | {"fitting"},
    "identification": FITTING | {"fitting", "departures"},
    "sampled": FITTING | {"fitting", "departures", "identification"},
    "correction": FITTING,
    "surface": FITTING,
    "registration": FITTING | {"correction", "surface"},
    "comparison": FITTING | {"correction", "surface"},
    "form": FITTING | {"surface", "registration"},
    "spectra": FITTING,
    "verification": FITTING | {"fitting", "departures", "identification", "correction", "surface"},
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
    "rosgraph_msgs": {"nodes"},
    "lifecycle_msgs": {"nodes"},
    "tf2_msgs": {"nodes"},
    "geometry_msgs": {"nodes"},
    "serial": {"devices.transport"},
    "socket": {"devices.transport", "emulators.tcp_server", "viewing.few_connections"},
    "rosbags": {"storage"},
    "mcap": {"storage.recording"},
    "websockets": {"viewing"},
    "matplotlib": {"report"},
    "h5py": {"storage"},
    "nptdms": {"storage.foreign"},
    "x3pio": {"storage.maps"},
    "SurfaceTopography": {"storage.maps"},
}
PURE = {"core", "protocols"}
PURE_FOREIGN = {"numpy", "scipy", "control", "cobs"}
# Of the standard library: no clock, file, print, network or process in what decides a number.
IMPURE_STANDARD = {
    "time", "datetime", "os", "sys", "io", "pathlib", "logging", "threading", "subprocess",
    "socket", "tempfile", "shutil", "random", "asyncio", "multiprocessing", "warnings",
}  # fmt: skip
FORBIDDEN_EVERYWHERE = {"pickle", "marshal", "shelve", "dill", "cloudpickle"}


GREATEST_FILE, GREATEST_FUNCTION, GREATEST_ROOM = 350, 50, 17


def _name(path):
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


def _tree(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def _imports(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield "." * node.level + (node.module or "")
            if node.module == "omsm_ros":
                yield from (f"omsm_ros.{alias.name}" for alias in node.names)


def _own(imported):
    """First part below omsm_ros, or empty for the package itself."""
    parts = imported.split(".")
    return parts[1] if len(parts) > 1 else ""


# The rules: each yields what breaks it.


def one_way(name, tree):
    """Layers look down, never up and never sideways by a relative name."""
    layer = name.split(".")[0]
    if layer in ("__init__", "interfaces"):
        return
    if layer not in RANK:
        yield f"{layer} belongs to no layer; say where it stands"
        return
    for imported in _imports(tree):
        if imported.startswith("."):
            yield f"{name}: relative import"
        elif imported.startswith("omsm_ros.") and RANK.get(_own(imported), 99) < RANK[layer]:
            yield f"{name} looks up at {imported}"


def rooms_look_left(name, tree):
    """Rooms of the core use only those named in ROOMS."""
    _, *parts = name.split(".")
    if len(parts) != 2:
        yield f"{name} stands in no room of the core"
        return
    if parts[0] not in ROOMS:
        yield f"{parts[0]} is no room of the core; say what it may use"
        return
    for imported in _imports(tree):
        if imported.startswith("omsm_ros.core."):
            room = imported.split(".")[2]
            if room not in ROOMS[parts[0]] | {parts[0]}:
                yield f"{name} looks at {imported}"


def foreign_in_its_place(name, tree):
    """What only one place may import, and what nobody may."""
    for imported in _imports(tree):
        top = imported.split(".")[0]
        if top in FORBIDDEN_EVERYWHERE:
            yield f"{name} imports {imported}"
        allowed = ONLY_IN.get(top)
        if allowed and not any(name == p or name.startswith(f"{p}.") for p in allowed):
            yield f"{name} imports {imported}, which belongs in {allowed}"


def pure(name, tree):
    """No clock, file, network, process or printing; foreign modules of a short list."""
    for imported in _imports(tree):
        top = imported.split(".")[0]
        known = top in PURE_FOREIGN or top in sys.stdlib_module_names or top == "omsm_ros"
        if top in IMPURE_STANDARD or not known:
            yield f"{name} imports {imported}"
    for node in ast.walk(tree):
        called = getattr(node.func, "id", "") if isinstance(node, ast.Call) else ""
        if called in {"print", "open", "input"}:
            yield f"{name} calls {called}"


def nothing_evaluated(name, tree):
    """No eval, no YAML that makes objects, no pickled arrays."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        if isinstance(node.func, ast.Name) and node.func.id in {"eval", "exec"}:
            yield f"{name} calls {node.func.id}"
        elif isinstance(node.func, ast.Attribute) and isinstance(node.func.value, ast.Name):
            called = f"{node.func.value.id}.{node.func.attr}"
            if called in {"yaml.load", "yaml.unsafe_load", "yaml.full_load"}:
                yield f"{name} calls {called}"
            pickled = any(k.arg == "allow_pickle" for k in node.keywords)
            if called in {"np.load", "numpy.load"} and pickled:
                yield f"{name} loads pickled arrays"


def no_arithmetic(name, tree):
    """Nodes leave numbers to the core."""
    for imported in _imports(tree):
        if imported.split(".")[0] in {"numpy", "scipy", "math", "control"}:
            yield f"{name} imports {imported}"


def functions_fit_a_screen(name, tree):
    """From its first line to its last, docstring and nested functions included."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = node.end_lineno - node.lineno + 1
            if lines > GREATEST_FUNCTION:
                yield f"{name}.{node.name} has {lines} lines, at most {GREATEST_FUNCTION}"


def public_names_are_explained(name, tree):
    """A docstring for every public function, class and method, and for the module.

    A method that another class of the module explains (a protocol, a base) need not repeat it.
    """
    if not ast.get_docstring(tree):
        yield f"{name} has no docstring"
    kinds = ast.FunctionDef | ast.AsyncFunctionDef
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    explained = {
        method.name
        for owner in classes
        for method in owner.body
        if isinstance(method, kinds) and ast.get_docstring(method)
    }
    for owner in [tree, *(c for c in classes if not c.name.startswith("_"))]:
        for node in owner.body:
            public = isinstance(node, kinds | ast.ClassDef) and not node.name.startswith("_")
            if not public or ast.get_docstring(node):
                continue
            if owner is tree or node.name not in explained:
                yield f"{name}: {node.name} has no docstring"


RULES = {
    one_way: lambda name: True,
    rooms_look_left: lambda name: name.startswith("core.") and not name.endswith("__init__"),
    foreign_in_its_place: lambda name: True,
    pure: lambda name: name.split(".")[0] in PURE,
    nothing_evaluated: lambda name: True,
    no_arithmetic: lambda name: name.startswith("nodes.") and name.endswith("_node"),
    functions_fit_a_screen: lambda name: True,
    public_names_are_explained: lambda name: True,
}


@pytest.mark.parametrize("path", MODULES, ids=_name)
def test_the_rules_hold(path):
    name = _name(path)
    applied = [rule for rule, applies in RULES.items() if applies(name)]
    assert not [
        (rule.__name__, *told) for rule in applied if (told := list(rule(name, _tree(path))))
    ]


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_is_no_corridor(room):
    files = list((PACKAGE / "core" / room).glob("[!_]*.py"))
    assert 0 < len(files) <= GREATEST_ROOM, "make it two rooms"


@pytest.mark.parametrize("path", MODULES, ids=_name)
def test_a_file_is_read_in_one_sitting(path):
    lines = len(path.read_text(encoding="utf-8").splitlines())
    assert lines <= GREATEST_FILE, "is it still one thing?"
    assert path.stem not in {"utils", "util", "misc", "helpers", "common"}, "of what?"


@pytest.mark.parametrize("path", sorted(Path(__file__).parent.rglob("*.py")), ids=lambda p: p.name)
def test_a_test_is_read_in_one_sitting(path):
    lines = len(path.read_text(encoding="utf-8").splitlines())
    assert lines <= GREATEST_FILE, "split it by subject; what several share goes beside them"
    assert not list(functions_fit_a_screen(path.stem, _tree(path)))


# A rule broken is a rule told.

BROKEN = [
    (one_way, "core.dynamics.new", "from omsm_ros.storage.bags import BagReader", "looks up at"),
    (one_way, "jobs.new", "import omsm_ros.cli.command_line", "looks up at"),
    (one_way, "twin.new", "from omsm_ros import devices", "looks up at"),
    (one_way, "jobs.new", "from . import measure", "relative import"),
    (one_way, "attic.new", "", "belongs to no layer"),
    (rooms_look_left, "core.new", "", "in no room"),
    (rooms_look_left, "core.attic.new", "", "is no room"),
    (foreign_in_its_place, "jobs.new", "import rclpy.node", "belongs in"),
    (foreign_in_its_place, "devices.new", "import serial", "belongs in"),
    (foreign_in_its_place, "storage.new", "from omsm_msgs.msg import AxisBlock", "belongs in"),
    (foreign_in_its_place, "jobs.new", "def f():\n    import pickle", "imports pickle"),
    (pure, "core.dynamics.new", "from pathlib import Path", "imports pathlib"),
    (pure, "protocols.new", "import pandas", "imports pandas"),
    (pure, "core.dynamics.new", "print(1)", "calls print"),
    (nothing_evaluated, "storage.new", "eval('1')", "calls eval"),
    (nothing_evaluated, "storage.new", "yaml.load(f)", "calls yaml.load"),
    (nothing_evaluated, "storage.new", "np.load(f, allow_pickle=True)", "pickled"),
    (no_arithmetic, "nodes.new_node", "import numpy as np", "imports numpy"),
    (functions_fit_a_screen, "jobs.new", "def f():\n" + 50 * "    pass\n", "has 51 lines"),
    (public_names_are_explained, "jobs.new", "x = 1", "jobs.new has no docstring"),
    (public_names_are_explained, "jobs.new", "'M.'\ndef f(): ...", "f has no docstring"),
    (public_names_are_explained, "jobs.new", "'M.'\nclass C:\n 'C.'\n def m(s): ...", "m has no"),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "name", "source", "told"), BROKEN)
def test_a_broken_rule_is_told(rule, name, source, told):
    assert RULES[rule](name)
    found = list(rule(name, ast.parse(source)))
    assert any(told in complaint for complaint in found), found


@pytest.mark.parametrize("room", ROOMS)
@pytest.mark.parametrize("other", ROOMS)
def test_a_room_that_looks_where_it_must_not_is_told(room, other):
    """The whole graph: the corridor from samples to identification, and who stands beside it."""
    order = ["samples", "dynamics", "machine", "fitting", "departures", "identification"]
    beside = {"sampled": 6, "correction": 3, "surface": 3, "registration": 3, "comparison": 3}
    beside |= {"form": 3, "spectra": 3, "verification": 6}
    allowed = set(order[: order.index(room) if room in order else beside[room]]) | {room}
    on_points = {"correction", "surface"}
    allowed |= {
        "registration": on_points,
        "comparison": on_points,
        "form": {"surface", "registration"},
        "verification": on_points,
    }.get(room, set())
    tree = ast.parse(f"from omsm_ros.core.{other}.new import anything")
    assert bool(list(rooms_look_left(f"core.{room}.new", tree))) is (other not in allowed)


def test_a_rule_that_is_kept_is_not_told():
    good = ast.parse(
        '"""What it is for."""\n\nimport numpy as np\n\n\ndef f():\n    """Do it."""\n'
    )
    for rule in (one_way, rooms_look_left, foreign_in_its_place, pure, nothing_evaluated):
        assert not list(rule("core.dynamics.new", good))
    assert not list(functions_fit_a_screen("jobs.new", good))
    assert not list(public_names_are_explained("jobs.new", good))
