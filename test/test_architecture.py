"""The rules of the tree: import contracts, sizes, and calls that no file may make."""

import ast
import importlib
import re
from collections import Counter
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest
from importlinter.cli import lint_imports

import omsm_ros
from omsm_ros.cli.words import WORDS
from omsm_ros.instruments.registry import ACCELEROMETERS, PROBES, REFERENCES
from omsm_ros.nodes.start import NODES

PACKAGE = Path(omsm_ros.__file__).parent
ROOT = PACKAGE.parent
MODULES = sorted(p for p in PACKAGE.rglob("*.py") if "interfaces" not in p.parts)

LONGEST_FILE, LONGEST_FUNCTION, LARGEST_ROOM = 500, 50, 22
MOST_FILES, MOST_LINES, MOST_SINGLE_IMPORTERS = 285, 71_108, 15


def _name(path):
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


def _lines(path):
    return len(path.read_text(encoding="utf-8").splitlines())


@cache
def _tree(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def _statements(node):
    """Yield the statements below ``node``: all of its functions, in a tenth of the time of all."""
    for block in ("body", "orelse", "finalbody", "handlers", "cases"):
        for child in getattr(node, block, ()):
            yield child
            yield from _statements(child)


def test_the_import_contracts_hold():
    """The contracts stand in pyproject.toml; ``lint-imports`` prints what breaks them."""
    assert lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True) == 0


def test_each_broken_import_contract_is_reported(tmp_path):
    import shutil
    import subprocess
    import sys

    shutil.copytree(PACKAGE, tmp_path / "omsm_ros", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    broken = (
        ("core.lti.recursion", "omsm_ros.io.bags"),
        ("core.streams.blocks", "omsm_ros.core.form.zernike_fit"),
        ("core.lti.recursion", "pathlib"),
        ("twin.probe", "rclpy"),
        ("pipelines.form", "omsm_ros.cli.form"),
    )
    for where, imported in broken:
        file = tmp_path / "omsm_ros" / (where.replace(".", "/") + ".py")
        file.write_text(file.read_text() + f"\nimport {imported}\n")
    command = "from importlinter.cli import lint_imports as f; raise SystemExit(f(no_cache=True))"
    done = subprocess.run(
        [sys.executable, "-c", command], cwd=tmp_path, env={"PYTHONPATH": str(tmp_path)},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 1
    said = " ".join(done.stdout.split())
    silent = [(w, i) for w, i in broken if f"omsm_ros.{w} -> {i} " not in said]
    assert not silent, done.stdout
    assert "4 broken" in said


# Calls


def prints_or_opens(name, tree):
    """The core neither prints nor opens a file."""
    for node in ast.walk(tree):
        called = getattr(node.func, "id", "") if isinstance(node, ast.Call) else ""
        if called in {"print", "open", "input"}:
            yield f"{name} calls {called}"


def evaluates_foreign_text(name, tree):
    """No eval, no YAML that makes objects, no pickled arrays."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            top = (getattr(node, "module", None) or node.names[0].name).split(".")[0]
            if top in {"pickle", "marshal", "shelve", "dill", "cloudpickle"}:
                yield f"{name} imports {top}"
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


def functions_are_too_long(name, tree):
    """From the first line of a function to its last, without its docstring."""
    for node in _statements(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = node.end_lineno - node.lineno + 1
            if ast.get_docstring(node) is not None:
                lines -= node.body[0].end_lineno - node.body[0].lineno + 1
            if lines > LONGEST_FUNCTION:
                yield f"{name}.{node.name} has {lines} lines, at most {LONGEST_FUNCTION}"


def public_names_lack_a_docstring(name, tree):
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
    prints_or_opens: lambda name: name.startswith("core."),
    evaluates_foreign_text: lambda name: True,
    functions_are_too_long: lambda name: True,
    public_names_lack_a_docstring: lambda name: True,
}


def test_modules_keep_the_rules():
    trees = {_name(path): _tree(path) for path in MODULES}
    assert len(trees) > 200
    assert not [
        text
        for name, tree in trees.items()
        for rule, applies in RULES.items()
        if applies(name)
        for text in rule(name, tree)
    ]
    assert not [_name(p) for p in MODULES if _lines(p) > LONGEST_FILE], "is it still one thing?"
    vague = {"utils", "util", "misc", "helpers", "common"}
    assert not [_name(p) for p in MODULES if p.stem in vague], "name its subject"


BROKEN = [
    (prints_or_opens, "core.lti.new", "print(1)", "calls print"),
    (evaluates_foreign_text, "io.new", "eval('1')", "calls eval"),
    (evaluates_foreign_text, "io.new", "yaml.load(f)", "calls yaml.load"),
    (evaluates_foreign_text, "io.new", "np.load(f, allow_pickle=True)", "pickled"),
    (evaluates_foreign_text, "io.new", "def f():\n    import pickle", "imports pickle"),
    (functions_are_too_long, "io.new", "def f():\n" + 50 * "    pass\n", "has 51 lines"),
    (
        functions_are_too_long,
        "io.new",
        "try: ...\nexcept E:\n def f():\n" + 50 * "  1\n",
        "51 lines",
    ),
    (public_names_lack_a_docstring, "io.new", "x = 1", "io.new has no docstring"),
    (public_names_lack_a_docstring, "io.new", "'M.'\ndef f(): ...", "f has no docstring"),
    (public_names_lack_a_docstring, "io.new", "'M.'\nclass C:\n 'C.'\n def m(s): ...", "m has no"),
]


@pytest.mark.parametrize(("rule", "name", "source", "reported"), BROKEN)
def test_a_broken_rule_is_reported(rule, name, source, reported):
    assert RULES[rule](name)
    found = list(rule(name, ast.parse(source)))
    assert any(reported in complaint for complaint in found), found


# Sizes


def test_the_product_has_a_bounded_size():
    files = [p for p in MODULES if p.name != "__init__.py"]
    lines = sum(map(_lines, MODULES))
    assert len(files) <= MOST_FILES
    assert lines <= MOST_LINES


def loaded_by_name():
    """Return the modules that a table of names loads: commands, nodes and devices."""
    models = {**PROBES, **REFERENCES, **ACCELEROMETERS}.values()
    places = [place for model in models for place in model]
    return {
        *(f"cli.{word.module}" for word in WORDS.values() if word.module),
        *(f"nodes.{place.partition(':')[0]}" for place in NODES.values()),
        *(f"instruments{place.partition(':')[0]}" for place in places if place.startswith(".")),
        "nodes.start",  # by setup.py
    }


def test_scripts_outside_the_package_use_names_that_exist():
    """Most of them run only by hand, on a machine or with LinuxCNC."""
    paths = [
        p for f in ("benchmarks", "config", "docs", "launch") for p in (ROOT / f).rglob("*.py")
    ]
    assert len(paths) > 40
    missing = []
    for path in paths:
        rooms = {}
        for node in ast.walk(_tree(path)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("omsm_ros"):
                room = importlib.import_module(node.module)
                for alias in node.names:
                    if not hasattr(room, alias.name):
                        try:
                            importlib.import_module(f"{node.module}.{alias.name}")
                        except ModuleNotFoundError:
                            missing.append(f"{path.name}: {node.module}.{alias.name}")
                            continue
                    value = getattr(room, alias.name)
                    if isinstance(value, ModuleType):
                        rooms[alias.asname or alias.name] = value
        missing += [
            f"{path.name}: {node.value.id}.{node.attr}"
            for node in ast.walk(_tree(path))
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
            and node.value.id in rooms and not hasattr(rooms[node.value.id], node.attr)
        ]  # fmt: skip
    assert not missing


def test_few_files_are_imported_by_one_other_only():
    """A small module belongs in its only importer; modules loaded by name are not counted."""
    names = {_name(p) for p in MODULES}
    by_name = loaded_by_name()
    assert by_name <= names
    importers = Counter()
    for path in MODULES:
        imported = set()
        for node in _statements(_tree(path)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("omsm_ros"):
                module = node.module.removeprefix("omsm_ros").lstrip(".")
                for alias in node.names:
                    full = f"{module}.{alias.name}".lstrip(".")
                    imported.add(full if full in names else module)
        importers.update(imported)
    single = sorted(name for name in names - by_name if importers[name] == 1)
    assert len(single) <= MOST_SINGLE_IMPORTERS, single


def test_a_room_has_few_files():
    rooms = Counter(p.parent for p in MODULES if not p.name.startswith("_"))
    assert not {room: n for room, n in rooms.items() if n > LARGEST_ROOM}, "divide it by subject"


def _longest_block(path):
    """Return the most lines from one definition at the margin to the next, found without a tree."""
    blocks = re.split(r"^(?=def |class |async )", path.read_text(encoding="utf-8"), flags=re.M)
    return max(block.count("\n") for block in blocks)


def test_test_files_have_a_bounded_size():
    paths = sorted((ROOT / "test").rglob("*.py"))
    assert len(paths) > 200
    assert not [p.name for p in paths if _lines(p) > LONGEST_FILE], "split it by subject"
    assert not [
        text
        for p in paths
        if _longest_block(p) > LONGEST_FUNCTION
        for text in functions_are_too_long(p.stem, _tree(p))
    ]
