"""XLA FFI handler, compiled by numba: calls a kernel and splits its work over XLA's thread pool.

XLA calls the handler with a frame (`xla/ffi/api/c_api.h` in jaxlib; the layout is stable within a major version). On
XLA's own threads nothing waits for a second pool, and numba needs no threading layer. The calling thread works too, so
that the call ends even if no other thread is free.
"""

from llvmlite import ir
from numba import types

from . import rows
from .rows import BUFFERS, DONE, OWN, PARTS, PER_BUFFER
from .simd import I64, call, inline, instruction, load_long as get, store_long as put

# Places in structures, in units of 8 bytes.
EXTENSION, API, CONTEXT, ARGUMENTS, RESULTS, ATTRIBUTES = 1, 2, 3, 5, 10, 20  # of the frame
COUNT, ITEMS = 2, 4  # of its arguments and results
ERROR_CREATE, ERROR_DESTROY, SCHEDULE, THREADS = 6, 8, 17, 18  # of the API
RESOURCE_EXHAUSTED = 8  # XLA's number of this error
METADATA, TABLE = 1, 77  # types of extensions: XLA's, and our own, which tells the handler the table's address
# Places in the table: addresses of functions, the version, addresses of an error's arguments and of the kernels.
TASK, ALLOCATE, FREE, YIELD, ADVISE, MAJOR, MINOR, NO_MEMORY, FIRST_KERNEL = range(9)
# Places in a job, besides its parts, length and buffers.
_REFERENCES, _NEXT, _DONE, _KERNEL, _FAILED = 0, 1, 2, 4, 7


@instruction(types.int64)
def _global(builder):
    """The address of a number that the compiled handler keeps."""
    name = "gs_jax_table"
    if name not in builder.module.globals:
        variable = ir.GlobalVariable(builder.module, I64, name)
        variable.linkage = "internal"
        variable.initializer = ir.Constant(I64, 0)  # pyright: ignore[reportAttributeAccessIssue]
    return builder.ptrtoint(builder.module.globals[name], I64)


@instruction(types.int64)
def _fetch_add(builder, address, number):
    return builder.atomic_rmw("add", builder.inttoptr(address, I64.as_pointer()), number, "seq_cst")


@inline
def _work(job):
    """Take parts until none is left."""
    while True:
        part = _fetch_add(job + 8 * _NEXT, 1)
        if part >= get(job, PARTS):
            return
        if call(get(job, _KERNEL), job, part, 0) != DONE:
            _fetch_add(job + 8 * _FAILED, 1)
        _fetch_add(job + 8 * _DONE, 1)


@inline
def _release(job):
    if _fetch_add(job + 8 * _REFERENCES, -1) == 1:
        call(get(job, rows.FREE), job, 0, 0)


def task(job, _):
    """The work of a helping thread, which may start when all is done."""
    _work(job)
    _release(job)
    return 0


@inline
def _list_buffers(job, first, items):
    """Write the buffers of a frame's arguments or results to the job; returns the number of the next buffer."""
    for number in range(get(items, COUNT)):
        place, buffer = BUFFERS + PER_BUFFER * (first + number), get(get(items, ITEMS), number)
        put(job, place, get(buffer, 3))
        put(job, place + 1, get(buffer, 2) & 0xFFFFFFFF)
        for axis in range(3):
            put(job, place + 2 + axis, get(get(buffer, 5), axis) if axis < get(buffer, 4) else 1)
    return first + get(items, COUNT)


@inline
def _put_four(at, size, third, fourth):
    """Begin a structure of XLA: its size, no extension, and two numbers."""
    put(at, 0, size)
    put(at, 1, 0)
    put(at, 2, third)
    put(at, 3, fourth)


@inline
def _use_large_pages(job, result, advise):
    """For a result: to map 100 MB in small pages takes half as long as a kernel."""
    page, start = 2**21, rows.address(job, result)
    first = (start + page - 1) // page * page
    size = 4 * rows.size(job, result, 0) * rows.size(job, result, 1) * rows.size(job, result, 2)
    pages = (start + size - first) // page
    if advise != 0 and pages > 1:
        call(advise, first, pages * page, 14)  # MADV_HUGEPAGE


def handle(frame, _):
    """The handler that XLA calls."""
    table = get(_global(), 0)
    if get(frame, EXTENSION) != 0:
        extension = get(frame, EXTENSION)
        if get(extension, 1) & 0xFFFFFFFF == METADATA:
            # Two numbers of 32 bits.
            put(get(extension, 3), 3, get(table, MAJOR) | get(table, MINOR) << 32)
            return 0
        if get(extension, 1) & 0xFFFFFFFF == TABLE:
            put(_global(), 0, get(extension, 3))
            return 0
    api, context = get(frame, API), get(frame, CONTEXT)
    length = BUFFERS + PER_BUFFER * (get(frame, ARGUMENTS + COUNT) + get(frame, RESULTS + COUNT))
    job = call(get(table, ALLOCATE), length, 8, 0)
    if job == 0:
        return call(get(api, ERROR_CREATE), get(table, NO_MEMORY), 0, 0)
    attributes = get(frame, ATTRIBUTES)
    kernel, parts = get(get(get(attributes, 0), 1), 0), get(get(get(attributes, 1), 1), 0)
    put(job, _REFERENCES, 1)
    put(job, PARTS, parts)
    put(job, _KERNEL, get(table, FIRST_KERNEL + kernel))
    put(job, rows.ALLOCATE, get(table, ALLOCATE))
    put(job, rows.FREE, get(table, FREE))
    first = _list_buffers(job, 0 * length, frame + 8 * ARGUMENTS)
    for result in range(first, _list_buffers(job, first, frame + 8 * RESULTS)):
        _use_large_pages(job, result, get(table, ADVISE))
    # XLA reads and writes the structures of its functions here.
    scratch, threads = job + 8 * OWN, job + 8 * (OWN + 8)
    put(threads, 0, 1)
    _put_four(scratch, 32, context, threads)
    error = call(get(api, THREADS), scratch, 0, 0)
    for _ in range(min(get(threads, 0), parts) - 1):
        if error != 0:
            break
        _fetch_add(job + 8 * _REFERENCES, 1)
        _put_four(scratch, 40, context, get(table, TASK))
        put(scratch, 4, job)
        error = call(get(api, SCHEDULE), scratch, 0, 0)
        if error != 0:
            _fetch_add(job + 8 * _REFERENCES, -1)
    if error != 0:  # no threads: all is done here
        _put_four(scratch, 24, error, 0)
        call(get(api, ERROR_DESTROY), scratch, 0, 0)
    _work(job)
    while _fetch_add(job + 8 * _DONE, 0) < parts:
        call(get(table, YIELD), 0, 0, 0)
    failed = get(job, _FAILED) > 0
    _release(job)
    return call(get(api, ERROR_CREATE), get(table, NO_MEMORY), 0, 0) if failed else 0
