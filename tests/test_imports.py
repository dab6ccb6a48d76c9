"""The direction of imports and the shape of modules, read from the syntax trees."""

import ast
from collections.abc import Iterator
from pathlib import Path, PureWindowsPath

import pytest

from gs_jax.io.files import _temporary_beside

ROOT = Path(__file__).parents[1]
MODULES = sorted((ROOT / "gs_jax").rglob("*.py"))
# Whatever stands here imports from what stands before it.
ORDER = [
    "_version",
    "base",
    "linear",
    "microscope",
    "metrics",
    "optics",
    "objectives",
    "projection",
    "interop",
    "io",
    "simulation",
    "design",
    "solvers",
    "detection",
    "calibration",
    "reconstruction",
    "codesign",
    "mold",
    "apps",
    "cli",
    "widget",
    "__main__",
]


def imported(path: Path, root: Path = ROOT) -> Iterator[list[str]]:
    """The parts of each dotted name that a module imports, wherever in it: `from ..a import b` in c/d/e.py is c.a.b."""
    package = path.relative_to(root).parent.parts
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (name.name.split(".") for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) + 1 - node.level] if node.level else ()
            module = node.module.split(".") if node.module else []
            yield from ([*above, *module, name.name] for name in node.names)


def names(paths) -> list[str]:
    return [str(path.relative_to(ROOT / "gs_jax")) for path in paths]


def defined(path: Path) -> set[str]:
    tree = ast.parse(path.read_text())
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}


def top(path: Path) -> str:
    return path.relative_to(ROOT / "gs_jax").parts[0].removesuffix(".py")


def test_relative_imports_are_resolved(tmp_path):
    (tmp_path / "c/d").mkdir(parents=True)
    (tmp_path / "c/d/e.py").write_text("import a.b\ndef f():\n    from ..a import b\n    from . import g\n")
    assert sorted(imported(tmp_path / "c/d/e.py", tmp_path)) == [["a", "b"], ["c", "a", "b"], ["c", "d", "g"]]


def test_the_order_names_every_module():
    assert {top(path) for path in MODULES} == {*ORDER, "__init__"}


@pytest.mark.parametrize("path", [path for path in MODULES if top(path) != "__init__"], ids=lambda path: path.stem)
def test_imports_point_one_way(path):
    """Thus without a cycle. The front door imports what it shows, and nothing imports the front door."""
    here = top(path)
    below = {here, *ORDER[: ORDER.index(here)]}
    ours = [name for name in imported(path) if name[0] == "gs_jax"]
    assert not [".".join(name) for name in ours if len(name) < 2 or name[1] not in below]


def test_the_package_stands_without_what_is_made_with_it():
    """`design`, `experiments` and `tests` are not installed."""
    outside = {"design", "experiments", "tests"}
    assert not names(path for path in MODULES if any(name[0] in outside for name in imported(path)))


def imports_of(*folders: str) -> set[tuple[str, str]]:
    """Modules in these folders, with the folders of the package that they import."""
    paths = [path for path in MODULES if top(path) in folders]
    return {(path.stem, name[1]) for path in paths for name in imported(path) if name[0] == "gs_jax" and len(name) > 1}


def test_the_physics_knows_no_files_and_solvers_no_microscope():
    """As `CONTRIBUTING.md` says."""
    physics = imports_of("microscope", "optics", "objectives", "projection")
    assert not {(module, other) for module, other in physics if other in ("io", "design", "simulation")}
    of_solvers = {
        (module, other) for module, other in imports_of("solvers") if other not in ("base", "linear", "solvers")
    }
    assert not of_solvers


def test_jaxopt_has_one_place():
    """It is no longer maintained: what replaces it replaces one module."""
    assert len(names(path for path in MODULES if any(name[0] == "jaxopt" for name in imported(path)))) == 1


def test_no_module_is_named_as_what_it_defines():
    """`from .name import name` would hide the module behind it."""
    assert not names(path for path in MODULES if path.stem in defined(path))


@pytest.mark.parametrize("path", [path for path in MODULES if path.name == "__init__.py"][1:], ids=top)
def test_a_folder_is_a_docstring_and_names(path):
    """The first is the package's own, which loads its names when they are asked for: `test_front_door`."""
    docstring, *rest = ast.parse(path.read_text()).body
    assert isinstance(docstring, ast.Expr) and isinstance(docstring.value, ast.Constant)
    for node in rest:
        is_all = isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["__all__"]
        assert isinstance(node, ast.ImportFrom) or is_all, ast.unparse(node)


# What can be said of Windows without one: nothing is used that it lacks, and names are ones that it has.


# Modules of POSIX alone, and what `os` and `signal` have there alone.
ABSENT = {"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog"}
CALLS = {
    "os": set("fork uname getuid geteuid getpgid setsid killpg statvfs mkfifo chown sysconf".split()),
    "signal": set("SIGKILL SIGHUP SIGUSR1 SIGUSR2 SIGALRM SIGCHLD SIGPIPE alarm setitimer pause".split()),
}
# What reads and writes text in the machine's own encoding unless told, and the place of `encoding`.
TEXT = {"read_text": 0, "write_text": 1, "open": None}
# Where the system is asked which it is before.
LINUX = {"base/machine.py", "apps/benchmark.py"}


def portable(path: Path) -> list[str]:
    """What of a module would not do on Windows."""
    tree, found = ast.parse(path.read_text(encoding="utf-8")), []
    for node in tree.body:
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name in ABSENT]
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module in ABSENT:
            found.append(node.module)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            found += [f"{node.value.id}.{node.attr}"] * (node.attr in CALLS.get(node.value.id, ()))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found += [node.value] * node.value.startswith(("/tmp", "/dev/", "/proc/", "/home/"))
        elif isinstance(node, ast.Call):
            found += [f"line {node.lineno}: text without an encoding"] * _own_encoding(node)
    return found


def _own_encoding(call: ast.Call) -> bool:
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    if name not in TEXT or any(word.arg in ("encoding", "formats") for word in call.keywords):
        return False
    if name != "open":
        # Our own `read_text(path)` and `write_text(path, text, suffixes)` are plain functions, and say UTF-8.
        return isinstance(call.func, ast.Attribute) and len(call.args) <= TEXT[name]
    # Of a path or of Python; what other libraries open is theirs.
    if isinstance(call.func, ast.Attribute) and getattr(call.func.value, "id", "") == "zarr":
        return False
    place = 1 if isinstance(call.func, ast.Name) else 0
    given = call.args[place] if len(call.args) > place else None
    mode = given.value if isinstance(given, ast.Constant) else "r"
    return "b" not in str(mode) and (isinstance(call.func, ast.Name) or str(mode) in ("r", "w", "a", "x"))


def test_it_sees_what_is_not_portable(tmp_path):
    bad = tmp_path / "bad.py"
    bad.write_text('import fcntl\nos.fork()\nsignal.SIGKILL\nopen("a")\np.open("w")\np.read_text()\nx = "/tmp/a"\n')
    good = tmp_path / "good.py"
    good.write_text('def f():\n    import resource\nopen(a, "rb")\np.open("w", encoding="utf-8")\nread_text(p)\n')
    assert len(portable(bad)) == 7 and not portable(good)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_nothing_is_used_that_windows_lacks(path):
    assert not portable(path) or names([path])[0] in LINUX


@pytest.mark.parametrize("name", ["v.ome.tif", "v.zarr", "a b.toml"])
def test_a_temporary_file_lies_beside_its_target_under_a_name_that_windows_has(name):
    """On the same volume, so that it can take the target's place at once."""
    target = PureWindowsPath(r"C:\Users\me\data") / name
    beside = _temporary_beside(target)
    assert beside.parent == target.parent and beside.suffix == target.suffix
    assert not set(beside.name) & set('<>:"/\\|?*') and not beside.is_reserved()
