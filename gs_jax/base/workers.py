"""Independent jobs as one stream of what they return: in this process, in others of this machine, or on a cluster.

Others are reached by Dask, which gives the job of a worker that died to another one. It is imported when it is asked
for.
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
from functools import partial
from typing import Any, NamedTuple, TypeVar

from .._version import __version__
from .errors import InputError, needs_extra

Item = TypeVar("Item")
Result = TypeVar("Result")

# Jobs given out for each worker, so that none waits for one.
_AHEAD = 2
# Seconds that a scheduler has to answer, that a worker has to end, and between two looks at how many workers there are.
_ANSWER, _END, _LOOK = 10, 2, 1.0
_lock = threading.Lock()
# What this worker runs now, by token.
_functions: dict[str, Callable[[Any], Any]] = {}


class _Work(NamedTuple):
    """What a worker needs to make the function that it runs, once; `build` is read when it has its settings."""

    token: str
    version: str
    folder: str
    double: bool
    build: bytes


class Workers:
    """Who does independent jobs; used by `with`.

    Parameters
    ----------
    count
        Processes on this machine, which share its cores. By default there are none: this process does the jobs.
    scheduler
        Address of a Dask scheduler whose workers do them, such as `tcp://host:8786`. They see the files that this
        process sees, by the same names, and have this version of `gs_jax`.

    Raises
    ------
    InputError
        If both are given; on entering, if Dask is not installed or no scheduler answers.
    """

    def __init__(self, count: int | None = None, scheduler: str | None = None):
        if count and scheduler:
            raise InputError("--workers: found --scheduler beside it, allowed: one of them.")
        self.count, self.scheduler = count, scheduler
        self._client: Any = None
        self._cluster: Any = None

    @property
    def elsewhere(self) -> bool:
        """Whether other processes do the jobs."""
        return bool(self.count or self.scheduler)

    def __enter__(self) -> "Workers":
        if self.elsewhere:
            self._client = self._connected()
        return self

    def __exit__(self, kind, *_) -> None:
        for each in (self._client, self._cluster):
            # What has not ended by then ends with this process.
            with contextlib.suppress(TimeoutError):
                if each is not None:
                    each.close(timeout=_END)

    def stream_of(
        self, build: Callable[[], Callable[[Item], Result]]
    ) -> Callable[[Iterable[Item]], Iterator[tuple[Item, Callable[[], Result]]]]:
        """From items to each of them, when its job is done, with what gives its result, or raises what the job raised.

        Parameters
        ----------
        build
            Makes the function that is called with each item: in this process, or in each worker, once, so that each
            compiles once. For workers it can be pickled, functions of a script or notebook by what they do, as its
            items and results can.

        Returns
        -------
        Callable
            Its items are taken as they are needed. They come in their order if this process does the jobs; else as the
            jobs are done. A job whose worker dies is done again by another, so it writes nothing, or what may be
            written twice.
        """
        if self._client is None:
            function = build()
            return lambda items: ((item, partial(function, item)) for item in items)
        import cloudpickle  # Dask brings it
        import jax

        double: Any = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
        work = _Work(uuid.uuid4().hex, __version__, os.getcwd(), double, cloudpickle.dumps(build))
        return partial(self._stream, work)

    def _stream(self, work: _Work, items):
        from distributed import as_completed

        left, waiting, done = iter(items), {}, as_completed(loop=self._client.loop)
        looked, threads = -math.inf, 1
        try:
            while True:
                # Workers come and go; to ask the scheduler takes as long as to give it a job.
                if time.monotonic() - looked > _LOOK:
                    looked, threads = time.monotonic(), max(1, sum(self._client.nthreads().values()))
                room = _AHEAD * threads - len(waiting)
                # What counts comes first: the other would take an item, and drop it.
                for _, item in zip(range(room), left, strict=False):
                    future = self._client.submit(_run, work, pickle.dumps(item), pure=False)
                    waiting[future.key] = item
                    done.add(future)
                if not waiting:
                    return
                future = next(done)
                yield waiting.pop(future.key), partial(self._result, future)
        finally:
            done.clear()

    def _result(self, future):
        from concurrent.futures import CancelledError

        from distributed import KilledWorker

        try:
            return future.result()
        except KilledWorker as error:
            found = f"{error.allowed_failures + 1} workers ended by it"
            raise InputError(
                f"found {found}, for want of memory perhaps, allowed: fewer workers, or more of it."
            ) from error
        except ModuleNotFoundError as error:
            raise InputError(f"found a worker without {error.name}, allowed: workers with the same gs_jax.") from error
        except CancelledError as error:
            raise ConnectionResetError(0, "the scheduler does not answer any more", self.scheduler) from error

    def _connected(self):
        name = "--scheduler" if self.scheduler else "--workers"
        # For workers of this machine too, which read it when they start.
        os.environ.setdefault("DASK_LOGGING__DISTRIBUTED", "critical")
        # Python counts what a process that ends at once leaves to it.
        os.environ["PYTHONWARNINGS"] = ",".join(
            filter(None, [os.environ.get("PYTHONWARNINGS"), "ignore:resource_tracker"])
        )
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
                env=_threads(max(1, CPU_COUNT // self.count)),
            )
        try:
            return Client(self._cluster or self.scheduler, timeout=_ANSWER, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            found = f"nobody who answers at {self.scheduler}"
            raise InputError(f"{name}: found {found}, allowed: a Dask scheduler, as tcp://HOST:8786.") from error


def dask_setup(_) -> None:
    """Called by Dask in each worker of this machine: Ctrl-C is this process's to hear, with which they end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _threads(count: int) -> dict[str, str]:
    """Variables that keep a process to so many threads: of XLA, on which the kernels run too, and of linear algebra."""
    return dict.fromkeys(("NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(count))


def _run(work: _Work, item: bytes):
    """In a worker, which reads the item when it has its settings."""
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
        found = f"gs_jax {__version__} at the worker {worker.address}"
        raise InputError(f"found {found}, allowed: {work.version}, as here.")
    try:
        os.chdir(work.folder)
    except OSError as error:
        found = f"no such folder at the worker {worker.address}"
        raise InputError(f"{work.folder}: found {found}, allowed: workers that see the same files.") from error
    # JAX reads them when it is first used. Other machines' workers are told how many jobs they run, and no more.
    for name, count in _threads(worker.state.nthreads).items():
        os.environ.setdefault(name, count)
    import jax

    jax.config.update("jax_enable_x64", work.double)
