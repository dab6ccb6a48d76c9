import ctypes
import gc
import math
import os
import sys
from functools import cache
from importlib.metadata import version
from pathlib import Path

# A test computes little and compiles much. Fewer optimisations take less time, and what was compiled is
# kept for the other processes and the next run. JAX reads these when it is imported.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ["XDG_CACHE_HOME"] = str(Path(__file__).parents[1] / ".pytest_cache")
# A third of the time goes with XLA's older emitters, and with each program compiled in one piece. Flags that a version
# does not know end the process: only of those that are known to know them.
if os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] == "1" and version("jaxlib").startswith("0.10."):
    flags = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
    os.environ["XLA_FLAGS"] = f"{flags} {os.environ.get('XLA_FLAGS', '')}".strip()

import jax  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
import tifffile  # noqa: E402
from hypothesis import settings  # noqa: E402

from .browser import browser as browser  # noqa: E402
from .compilations import CompileBudget  # noqa: E402

# Strict: float64 unless a test says float32, and no silent promotion or broadcasting of ranks.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# The same examples each time: a change should fail for what it changed.
settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")

# Programs take memory, and memory maps, of which Linux gives a process 65,530. What a worker may hold is its share of
# half of the memory, within limits; then memory has to grow by a quarter of that before programs are dropped again.
_MOST_MAPS, _LEAST_BYTES, _MOST_BYTES = 40_000, 1.1e9, 4e9
_held_after_the_last_time = 0


@pytest.fixture(autouse=True)
def _compiled_code_is_dropped():
    """Forget compiled programs where a process has too many: they are read from the cache when they are needed."""
    yield
    global _held_after_the_last_time
    if not Path("/proc/self").exists():
        return
    many = Path("/proc/self/maps").read_bytes().count(b"\n") > _MOST_MAPS
    if many or _resident() > max(_share(), _held_after_the_last_time + _share() / 4):
        jax.clear_caches()
        gc.collect()
        # The C library keeps what was freed.
        if hasattr(library := ctypes.CDLL(None), "malloc_trim"):
            library.malloc_trim(0)
        _held_after_the_last_time = _resident()


@cache
def _share() -> float:
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGESIZE")
    share = memory / 2 / int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    return min(max(share, _LEAST_BYTES), _MOST_BYTES)


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")


@pytest.fixture(autouse=True)
def _no_machine_is_slow(monkeypatch):
    """What a test reads on standard error is what it asked for, not that a slow machine took ten seconds."""
    monkeypatch.setattr("gs_jax.base.progress._EVERY", math.inf)
    monkeypatch.setattr("gs_jax.base.progress._MEASURED", math.inf)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder to work in, with a design and a capture."""
    # The package is imported after what checks its shapes and types, which pytest starts after this file.
    from .helpers import DESIGN

    monkeypatch.chdir(tmp_path)
    (tmp_path / "design.toml").write_text(DESIGN)
    tifffile.imwrite(tmp_path / "capture.tif", np.full((96, 80), 7, np.uint16))
    return tmp_path


@pytest.fixture
def run(monkeypatch, capsys):
    """Run a command by its arguments; the exit status, standard output and standard error."""
    from gs_jax.__main__ import main

    def command(*arguments):
        monkeypatch.setattr(sys, "argv", ["gs-jax", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            main()
        return stop.value.code, *capsys.readouterr()

    return command


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addini("compile_budget", "file with the number of programs that test modules may compile; empty: no limit")


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(CompileBudget(config))
