"""From compiled programs to numba: one handler for XLA's foreign functions, which shares a kernel's parts over threads.

The handler is called with a frame (`xla/ffi/api/c_api.h`, which comes with jaxlib; its layout is kept within a major
version). The threads are XLA's own, so that nothing waits for a second pool, several programs may run at once, and
none of numba's threading layers is needed. Who calls works too, so it ends if no thread is free to help.
"""

import ctypes
import sys
from functools import cache
from inspect import unwrap
from pathlib import Path
from zlib import crc32

import jax
import numpy as np
from llvmlite import ir
from numba import cfunc, types

from . import fftconv as tiles, kernels
from .dispatch import TARGET
from .rows import BUFFERS, PARTS, PER_BUFFER
from .simd import FAST, carray, inline, intrinsic, pointer

KERNELS = {
    function.__name__: function for function in (kernels.gather, kernels.scatter, kernels.rays_bar, tiles.overlap_save)
}

# Places in structures, in units of 8 bytes.
_EXTENSION, _API, _CONTEXT, _ARGUMENTS, _RESULTS, _ATTRIBUTES = 1, 2, 3, 5, 10, 20  # of the frame
_COUNT, _ITEMS = 2, 4  # of its arguments and results
_ERROR_DESTROY, _SCHEDULE, _THREADS = 8, 17, 18  # of the API
# The version that these places are from. XLA refuses a handler of a version that it does not support.
VERSION = 0, 3
_METADATA, _TABLE = 1, 77  # types of extensions: XLA's, and our own, by which the handler learns where the table is
# Places in the table: addresses of functions and the version, the kernels last.
_TASK, _ALLOCATE, _FREE, _YIELD, _ADVISE, _MAJOR, _MINOR, _FIRST_KERNEL = range(8)
# Places in a job; its parts and buffers are known to the kernels.
_REFERENCES, _NEXT, _DONE, _KERNEL, _FREE_ME, _SCRATCH, _LENGTH = 0, 1, 2, 4, 5, 240, 256


@intrinsic
def _global(_):
    """The address of a number that the compiled handler keeps."""

    def code(context, builder, signature, arguments):
        kind, name = ir.IntType(64), "gs_jax_table"
        if name not in builder.module.globals:
            variable = ir.GlobalVariable(builder.module, kind, name)
            variable.linkage = "internal"
            variable.initializer = ir.Constant(kind, 0)  # pyright: ignore[reportAttributeAccessIssue]
        return builder.ptrtoint(builder.module.globals[name], kind)

    return types.int64(), code


@intrinsic
def _add(_, address, number):
    """Add to a number that other threads add to; returns what it was."""

    def code(context, builder, signature, arguments):
        return builder.atomic_rmw(
            "add", builder.inttoptr(arguments[0], ir.IntType(64).as_pointer()), arguments[1], "seq_cst"
        )

    return types.int64(address, types.int64), code


@intrinsic
def _call(_, function, first, second, third):
    """Call a C function by its address; one that takes less ignores the rest."""

    def code(context, builder, signature, arguments):
        number = ir.IntType(64)
        kind = ir.FunctionType(number, [number, number, number]).as_pointer()
        return builder.call(builder.inttoptr(arguments[0], kind), arguments[1:])

    return types.int64(function, types.int64, types.int64, types.int64), code


@inline
def _at(address, length):
    return carray(pointer(address), length, np.int64)


@inline
def _work(address):
    """Take parts until none is left."""
    job = _at(address, _LENGTH)
    while True:
        part = _add(address + 8 * _NEXT, 1)
        if part >= job[PARTS]:
            return
        _call(job[_KERNEL], address, part, 0)
        _add(address + 8 * _DONE, 1)


@inline
def _release(address):
    if _add(address + 8 * _REFERENCES, -1) == 1:
        _call(_at(address, _LENGTH)[_FREE_ME], address, 0, 0)


def task(address, _):
    """What a thread that helps does; it may come when all is done."""
    _work(address)
    _release(address)
    return 0


@inline
def _list(job, first, items):
    """List the buffers of a frame's arguments or results."""
    for number in range(items[_COUNT]):
        place = BUFFERS + PER_BUFFER * (first + number)
        buffer = _at(_at(items[_ITEMS], items[_COUNT])[number], 6)
        job[place], job[place + 1] = buffer[3], buffer[2] & 0xFFFFFFFF
        for axis in range(3):
            job[place + 2 + axis] = _at(buffer[5], 3)[axis] if axis < buffer[4] else 1
    return first + items[_COUNT]


@inline
def _use_large_pages(job, place, advise):
    """For a result: to map 100 MB in small ones takes as long as half of a kernel."""
    page = 2**21
    first = (job[place] + page - 1) // page * page
    pages = (job[place] + 4 * job[place + 2] * job[place + 3] * job[place + 4] - first) // page
    if advise != 0 and pages > 1:
        _call(advise, first, pages * page, 14)  # MADV_HUGEPAGE


def handle(frame_address, _):
    """XLA's handler."""
    frame, table = _at(frame_address, 21), _at(_at(_global(), 1)[0], 16)
    if frame[_EXTENSION] != 0:
        extension = _at(frame[_EXTENSION], 4)
        if extension[1] & 0xFFFFFFFF == _METADATA:
            version = carray(pointer(extension[3] + 24), 2, np.int32)
            version[0], version[1] = table[_MAJOR], table[_MINOR]
            return 0
        if extension[1] & 0xFFFFFFFF == _TABLE:
            _at(_global(), 1)[0] = extension[3]
            return 0
    address = _call(table[_ALLOCATE], 8 * _LENGTH, 0, 0)
    job = _at(address, _LENGTH)
    attributes = _at(frame[_ATTRIBUTES], 2)
    which, parts = _at(_at(attributes[0], 2)[1], 1)[0], _at(_at(attributes[1], 2)[1], 1)[0]
    job[_REFERENCES], job[_NEXT], job[_DONE], job[PARTS] = 1, 0, 0, parts
    job[_KERNEL], job[_FREE_ME] = table[_FIRST_KERNEL + which], table[_FREE]
    listed = _list(job, 0, frame[_ARGUMENTS : _ARGUMENTS + 5])
    for result in range(listed, _list(job, listed, frame[_RESULTS : _RESULTS + 5])):
        _use_large_pages(job, BUFFERS + PER_BUFFER * result, table[_ADVISE])
    # XLA reads and writes the structures of its functions here.
    api, scratch, at_scratch = _at(frame[_API], 19), job[_SCRATCH:], address + 8 * _SCRATCH
    threads = address + 8 * (_SCRATCH + 8)
    scratch[0], scratch[1], scratch[2], scratch[3], scratch[8] = 32, 0, frame[_CONTEXT], threads, 1
    error = _call(api[_THREADS], at_scratch, 0, 0)
    for _ in range(min(scratch[8], parts) - 1):
        if error != 0:
            break
        _add(address + 8 * _REFERENCES, 1)
        scratch[0], scratch[1], scratch[2], scratch[3], scratch[4] = 40, 0, frame[_CONTEXT], table[_TASK], address
        error = _call(api[_SCHEDULE], at_scratch, 0, 0)
        if error != 0:
            _add(address + 8 * _REFERENCES, -1)
    if error != 0:  # no threads: all is done here
        scratch[0], scratch[1], scratch[2] = 24, 0, error
        _call(api[_ERROR_DESTROY], at_scratch, 0, 0)
    _work(address)
    while _add(address + 8 * _DONE, 0) < parts:
        _call(table[_YIELD], 0, 0, 0)
    _release(address)
    return 0


_table, _kept = np.zeros(_FIRST_KERNEL + len(KERNELS), np.int64), []


def number(name: str) -> int:
    """By which the handler knows a kernel, which is compiled if it was not; the handler is registered at first.

    Raises
    ------
    RuntimeError
        If XLA does not support the handler's version.
    """
    place = _FIRST_KERNEL + list(KERNELS).index(name)
    _register()
    if _table[place] == 0:
        _table[place] = _compile(KERNELS[name], types.void, 2)
    return place - _FIRST_KERNEL


@cache
def _register():
    idle = ctypes.windll.kernel32.SwitchToThread if sys.platform == "win32" else ctypes.CDLL(None).sched_yield
    functions = (ctypes.pythonapi.PyMem_RawMalloc, ctypes.pythonapi.PyMem_RawFree, idle)
    for place, function in zip((_ALLOCATE, _FREE, _YIELD), functions, strict=True):
        _table[place] = ctypes.cast(function, ctypes.c_void_p).value or 0
    if sys.platform == "linux":
        _table[_ADVISE] = ctypes.cast(ctypes.CDLL(None).madvise, ctypes.c_void_p).value or 0
    (_table[_MAJOR], _table[_MINOR]), _table[_TASK] = VERSION, _compile(task, types.int64, 1)
    handler = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64)(_compile(handle, types.int64, 1))
    extension, frame = np.array([32, _TABLE, 0, _table.ctypes.data], np.int64), np.zeros(21, np.int64)
    frame[_EXTENSION] = extension.ctypes.data
    handler(frame.ctypes.data)
    jax.ffi.register_ffi_target(TARGET, jax.ffi.pycapsule(handler), platform="cpu")


def _compile(function, result, arguments) -> int:
    """The address; compiled, or read from the folder in which numba keeps what it compiled."""
    # Numba takes what it kept for current if the function's own file is: the other files are part of the signature.
    signature = result(*[types.int64] * arguments, types.literal(_sources()))
    compiled = cfunc(signature, cache=True, **FAST)(unwrap(function))
    _kept.append(compiled)
    return compiled.address or 0


@cache
def _sources() -> int:
    folder = Path(__file__).parent
    names = ("ffi", "fftconv", "gather", "kernels", "rows", "shuffles", "simd")
    return crc32(b"".join((folder / f"{name}.py").read_bytes() for name in names))
