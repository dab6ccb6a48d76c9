"""What can be said of Windows without one: nothing is used that it lacks, and names are ones that it has."""

import ast
from pathlib import Path, PureWindowsPath

import pytest

from gs_jax.io.files import _temporary_beside

from .test_imports import MODULES, names

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
