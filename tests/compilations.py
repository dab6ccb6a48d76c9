"""Count compiled programs: for a test, and for all test modules, held against `compile_budget.toml`."""

import tomllib
from collections import defaultdict
from collections.abc import Mapping, Sequence

import jax
import pytest

EVENT = "/jax/core/compile/backend_compile_duration"
# For the test module that runs now: programs that this process has compiled or read from the cache, and seconds.
_totals: defaultdict[str, list[float]] = defaultdict(lambda: [0, 0.0])
_module = "gs_jax"


def _count(event: str, duration_secs: float, **_: str | int) -> None:
    if event == EVENT:
        _totals[_module][0] += 1
        _totals[_module][1] += duration_secs


# JAX keeps listeners for good: one counts for all tests of a process.
jax.monitoring.register_event_duration_secs_listener(_count)


def compilations() -> int:
    """Number of programs that this process has compiled, or read from the cache."""
    return int(sum(programs for programs, _ in _totals.values()))


class CompileBudget:
    """Add up the programs of test modules over workers, report the dearest, and fail above the budget.

    The first module in a process that needs a program pays for it. A module compiles most when all of it runs alone,
    and that is what its budget is made from. So the largest number of a worker counts, and it does not matter how
    tests are spread. Tests marked `integration` or `slow` have no budget.
    """

    def __init__(self, config: pytest.Config):
        self.config = config
        self.workers: list[Mapping[str, Sequence[float]]] = [_totals]

    @pytest.hookimpl(wrapper=True)
    def pytest_make_collect_report(self, collector):
        global _module
        _module = collector.path.stem
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        global _module
        marked = any(item.get_closest_marker(name) for name in ("integration", "slow"))
        _module = f"{item.path.stem} (marked tests)" if marked else item.path.stem
        return (yield)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        # A worker that crashed has none.
        self.workers.append(getattr(node, "workeroutput", {}).get("compilations", {}))

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session):
        if (output := getattr(self.config, "workeroutput", None)) is not None:
            output["compilations"] = dict(_totals)
        elif self.excess():
            session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED

    def excess(self) -> list[str]:
        """A line for each module over its budget."""
        path = self.config.getini("compile_budget")
        if not path:
            return []
        budget = tomllib.loads((self.config.rootpath / path).read_text())
        counts, all_modules = defaultdict[str, float](float), 0.0
        for worker in self.workers:
            for module, (programs, _) in worker.items():
                if "(" not in module:
                    counts[module], all_modules = max(counts[module], programs), all_modules + programs
        limits = {module: budget["modules"].get(module, budget["module"]) for module in counts}
        counts["all modules"], limits["all modules"] = all_modules, budget["total"]
        return [
            f"{module}: {programs} programs compiled, {limits[module]} allowed by {path}"
            for module, programs in counts.items()
            if programs > limits[module]
        ]

    def pytest_terminal_summary(self, terminalreporter):
        sums = defaultdict[str, tuple[float, float]](lambda: (0, 0.0))
        for worker in self.workers:
            for module, (programs, seconds) in worker.items():
                sums[module] = sums[module][0] + programs, sums[module][1] + seconds
        programs, seconds = (sum(column) for column in zip((0, 0.0), *sums.values(), strict=True))
        terminalreporter.section("programs compiled")
        terminalreporter.line(f"{programs} programs in {seconds:.0f} s. Modules with most of these seconds:")
        dearest = sorted(sums.items(), key=lambda item: item[1][1], reverse=True)[:15]
        for module, (programs, seconds) in dearest:
            terminalreporter.line(f"{programs:6d} {seconds:7.1f} s  {module}")
        for line in self.excess():
            terminalreporter.line(line, red=True)
