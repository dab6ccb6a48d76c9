"""Independent jobs in threads, in other processes of this machine, or on the workers of a Dask scheduler.

Dask gives the job of a worker that died to another one. It is imported only when it is used.
"""

import contextlib
import math
import os
import pickle
import signal
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, TypeVar

from .._version import __version__
from .errors import InputError, input_error, needs_extra

Item = TypeVar("Item")
Result = TypeVar("Result")
Results = Iterator[tuple[Item, Callable[[], Result]]]

# Each thread holds the arrays that it works on, and memory bandwidth limits how many are of use.
_MAX_THREADS = 8
# Jobs that are submitted ahead for each worker, so that none is idle.
_AHEAD = 2
# Seconds: timeout of the scheduler, timeout of closing, and between two counts of the workers.
_ANSWER, _END, _RECOUNT = 10, 2, 1.0
_lock = threading.Lock()
# The function that this worker calls, by token.
_functions: dict[str, Callable[[Any], Any]] = {}


def map_in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """`map` with a thread per core, for NumPy code, which releases Python's lock; results are in the items' order."""
    with ThreadPoolExecutor(min(os.cpu_count() or 1, _MAX_THREADS)) as threads:
        yield from threads.map(function, items)


def compile_at_once(*calls: tuple[Any, tuple]) -> None:
    """Compile jitted functions for arguments, in threads, before they are called: XLA releases Python's lock.

    The threads have JAX's global configuration, not what the caller's context managers set. Compile in threads, but run
    one program at a time: on two cores, programs that ran in several threads hung (LAPACK's QR in `while` loops).
    """
    for _ in map_in_threads(lambda call: call[0].lower(*call[1]).compile(), calls):
        pass


class _Work(NamedTuple):
    """Settings of a worker, and the pickled `build`, which is read once they are set."""

    token: str
    version: str
    folder: str
    double: bool
    build: bytes


class Workers:
    """Context manager of the processes that run independent jobs.

    Parameters
    ----------
    count
        Processes on this machine, which share its cores. By default this process runs the jobs itself.
    scheduler
        Address of a Dask scheduler, such as `tcp://host:8786`. Its workers must see the same files under the same
        names, and have the same version of `gs_jax`.

    Raises
    ------
    InputError
        If both are given; on entering, if Dask is not installed or no scheduler answers.
    """

    def __init__(self, count: int | None = None, scheduler: str | None = None):
        if count and scheduler:
            raise InputError("--workers must not be given together with --scheduler.")
        self.count, self.scheduler = count, scheduler
        self._client: Any = None
        self._cluster: Any = None

    @property
    def remote(self) -> bool:
        """Whether other processes run the jobs."""
        return bool(self.count or self.scheduler)

    def __enter__(self) -> "Workers":
        if self.remote:
            self._client = self._connect()
        return self

    def __exit__(self, kind, *_) -> None:
        for connection in (self._client, self._cluster):
            # Whatever has not ended after the timeout ends with this process.
            with contextlib.suppress(TimeoutError):
                if connection is not None:
                    connection.close(timeout=_END)

    def mapper(
        self, build: Callable[[], Callable[[Item], Result]]
    ) -> Callable[[Iterable[Item]], Results[Item, Result]]:
        """Return a function that maps items to pairs of an item and a callable, which returns or raises its result.

        Items are taken as they are needed. Pairs come in the items' order if this process runs the jobs, otherwise as
        jobs finish. A job whose worker dies runs again on another, so it must not matter if it writes a file twice.

        Parameters
        ----------
        build
            Returns the function that is called with each item. It runs once in this process or in each worker, so that
            each compiles once. For workers it is pickled by value, as items and results are.
        """
        if self._client is None:
            function = build()
            return lambda items: ((item, partial(function, item)) for item in items)
        import cloudpickle  # a dependency of Dask
        import jax

        double: Any = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
        work = _Work(uuid.uuid4().hex, __version__, os.getcwd(), double, cloudpickle.dumps(build))
        return partial(self._map, work)

    def _map(self, work: _Work, items):
        from distributed import as_completed

        remaining, running, done = iter(items), {}, as_completed(loop=self._client.loop)
        counted, threads = -math.inf, 1
        try:
            while True:
                # Workers come and go; asking the scheduler takes as long as submitting a job.
                if time.monotonic() - counted > _RECOUNT:
                    counted, threads = time.monotonic(), max(1, sum(self._client.nthreads().values()))
                # `range` must come first: `zip` would otherwise take one item too many.
                for _, item in zip(range(_AHEAD * threads - len(running)), remaining, strict=False):
                    future = self._client.submit(_run, work, pickle.dumps(item), pure=False)
                    running[future.key] = item
                    done.add(future)
                if not running:
                    return
                future = next(done)
                yield running.pop(future.key), partial(self._result, future)
        finally:
            done.clear()

    def _result(self, future):
        from concurrent.futures import CancelledError

        from distributed import KilledWorker

        try:
            return future.result()
        except KilledWorker as error:
            count = error.allowed_failures + 1
            raise InputError(
                f"a job ended {count} workers, perhaps for want of memory; use fewer workers, or more memory."
            ) from error
        except ModuleNotFoundError as error:
            raise InputError(f"a worker lacks {error.name}; all workers must have the same gs_jax.") from error
        except CancelledError as error:
            raise ConnectionResetError(0, "the scheduler does not answer any more", self.scheduler) from error

    def _connect(self):
        # In the environment, for the workers of this machine to read when they start.
        os.environ.setdefault("DASK_LOGGING__DISTRIBUTED", "critical")
        # The resource tracker warns of what a killed process leaves behind.
        filters = [os.environ.get("PYTHONWARNINGS"), "ignore:resource_tracker"]
        os.environ["PYTHONWARNINGS"] = ",".join(filter(None, filters))
        with needs_extra("cluster"):
            from distributed import Client, LocalCluster
        if self.count:
            from dask.system import CPU_COUNT

            self._cluster = LocalCluster(
                n_workers=self.count,
                threads_per_worker=1,
                dashboard_address="127.0.0.1:0",
                memory_limit=None,
                preload=[__name__],
                env=_thread_limits(max(1, CPU_COUNT // self.count)),
            )
        try:
            return Client(self._cluster or self.scheduler, timeout=_ANSWER, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            if self.scheduler is None:
                raise InputError(f"--workers: the processes did not start: {error}.") from error
            advice = "give an address as tcp://HOST:8786"
            raise InputError(f"--scheduler: no Dask scheduler is reachable at {self.scheduler}; {advice}.") from error


def dask_setup(_) -> None:
    """Hook that Dask calls in each local worker: Ctrl-C is for the parent process, which ends the workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _thread_limits(count: int) -> dict[str, str]:
    """Environment variables that limit the threads of XLA, which runs the kernels too, and of linear algebra."""
    return dict.fromkeys(("NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(count))


def _run(work: _Work, item: bytes):
    """Run a job in a worker, which unpickles the item after its settings are made."""
    with _lock:
        if work.token not in _functions:
            _prepare(work)
            _functions.clear()
            _functions[work.token] = pickle.loads(work.build)()
        function = _functions[work.token]
    return function(pickle.loads(item))


def _prepare(work: _Work) -> None:
    from distributed import get_worker

    worker = get_worker()
    if work.version != __version__:
        raise input_error(f"gs_jax of worker {worker.address}", f"version {work.version}, as here", __version__)
    try:
        os.chdir(work.folder)
    except OSError as error:
        raise InputError(
            f"{work.folder}: no such folder at worker {worker.address}; all workers must see the same files."
        ) from error
    # JAX reads these when it is first used. Workers of other machines know how many jobs they run, and no more.
    for name, count in _thread_limits(worker.state.nthreads).items():
        os.environ.setdefault(name, count)
    import jax

    jax.config.update("jax_enable_x64", work.double)
