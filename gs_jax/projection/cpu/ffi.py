"""XLA FFI handler, compiled by numba: calls a kernel and splits its work over XLA's thread pool.

XLA calls the handler with a frame (`xla/ffi/api/c_api.h` in jaxlib; the layout is stable within a major version). On
XLA's own threads nothing waits for a second pool, several programs may run at once, and numba needs no threading layer.
The calling thread works too, so that the call ends even if no other thread is free.
"""

import numpy as np
from llvmlite import ir
from numba import types

from . import rows
from .rows import BUFFERS, DONE, LENGTH, OWN, PARTS, PER_BUFFER
from .simd import I64, call, carray, inline, instruction, pointer

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
def _at(address, length):
    return carray(pointer(address), length, np.int64)


@inline
def _work(address):
    """Take parts until none is left."""
    job = _at(address, OWN)
    while True:
        part = _fetch_add(address + 8 * _NEXT, 1)
        if part >= job[PARTS]:
            return
        if call(job[_KERNEL], address, part, 0) != DONE:
            _fetch_add(address + 8 * _FAILED, 1)
        _fetch_add(address + 8 * _DONE, 1)


@inline
def _release(address):
    if _fetch_add(address + 8 * _REFERENCES, -1) == 1:
        call(_at(address, OWN)[rows.FREE], address, 0, 0)


def task(address, _):
    """The work of a helping thread, which may start when all is done."""
    _work(address)
    _release(address)
    return 0


@inline
def _list_buffers(job, first, items):
    """Write the buffers of a frame's arguments or results to the job; returns the number of the next buffer."""
    for number in range(items[COUNT]):
        place = BUFFERS + PER_BUFFER * (first + number)
        buffer = _at(_at(items[ITEMS], items[COUNT])[number], 6)
        job[place], job[place + 1] = buffer[3], buffer[2] & 0xFFFFFFFF
        for axis in range(3):
            job[place + 2 + axis] = _at(buffer[5], 3)[axis] if axis < buffer[4] else 1
    return first + items[COUNT]


@inline
def _use_large_pages(job, place, advise):
    """For a result: to map 100 MB in small pages takes half as long as a kernel."""
    page = 2**21
    first = (job[place] + page - 1) // page * page
    pages = (job[place] + 4 * job[place + 2] * job[place + 3] * job[place + 4] - first) // page
    if advise != 0 and pages > 1:
        call(advise, first, pages * page, 14)  # MADV_HUGEPAGE


def handle(frame_address, _):
    """The handler that XLA calls."""
    frame, at_table = _at(frame_address, 21), _at(_global(), 1)[0]
    table = _at(at_table, FIRST_KERNEL)
    if frame[EXTENSION] != 0:
        extension = _at(frame[EXTENSION], 4)
        if extension[1] & 0xFFFFFFFF == METADATA:
            version = carray(pointer(extension[3] + 24), 2, np.int32)
            version[0], version[1] = table[MAJOR], table[MINOR]
            return 0
        if extension[1] & 0xFFFFFFFF == TABLE:
            _at(_global(), 1)[0] = extension[3]
            return 0
    api = _at(frame[API], 19)
    length = BUFFERS + PER_BUFFER * (frame[ARGUMENTS + COUNT] + frame[RESULTS + COUNT])
    address = call(table[ALLOCATE], length, 8, 0)
    if address == 0:
        return call(api[ERROR_CREATE], table[NO_MEMORY], 0, 0)
    job = _at(address, length)
    attributes = _at(frame[ATTRIBUTES], 2)
    which, parts = _at(_at(attributes[0], 2)[1], 1)[0], _at(_at(attributes[1], 2)[1], 1)[0]
    job[_REFERENCES], job[_NEXT], job[_DONE], job[PARTS], job[LENGTH], job[_FAILED] = 1, 0, 0, parts, length, 0
    job[_KERNEL] = _at(at_table + 8 * FIRST_KERNEL, which + 1)[which]
    job[rows.ALLOCATE], job[rows.FREE] = table[ALLOCATE], table[FREE]
    arguments = _list_buffers(job, 0, frame[ARGUMENTS : ARGUMENTS + 5])
    for result in range(arguments, _list_buffers(job, arguments, frame[RESULTS : RESULTS + 5])):
        _use_large_pages(job, BUFFERS + PER_BUFFER * result, table[ADVISE])
    # XLA reads and writes the structures of its functions here.
    scratch, at_scratch, threads = job[OWN:BUFFERS], address + 8 * OWN, address + 8 * (OWN + 8)
    scratch[0], scratch[1], scratch[2], scratch[3], scratch[8] = 32, 0, frame[CONTEXT], threads, 1
    error = call(api[THREADS], at_scratch, 0, 0)
    for _ in range(min(scratch[8], parts) - 1):
        if error != 0:
            break
        _fetch_add(address + 8 * _REFERENCES, 1)
        scratch[0], scratch[1], scratch[2], scratch[3], scratch[4] = 40, 0, frame[CONTEXT], table[TASK], address
        error = call(api[SCHEDULE], at_scratch, 0, 0)
        if error != 0:
            _fetch_add(address + 8 * _REFERENCES, -1)
    if error != 0:  # no threads: all is done here
        scratch[0], scratch[1], scratch[2] = 24, 0, error
        call(api[ERROR_DESTROY], at_scratch, 0, 0)
    _work(address)
    while _fetch_add(address + 8 * _DONE, 0) < parts:
        call(table[YIELD], 0, 0, 0)
    failed = job[_FAILED] > 0
    _release(address)
    return call(api[ERROR_CREATE], table[NO_MEMORY], 0, 0) if failed else 0
