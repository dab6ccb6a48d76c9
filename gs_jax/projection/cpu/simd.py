"""SIMD for numba: a type of sixteen float32 with arithmetic, loads, stores and permutations.

LLVM vectorises loops of unknown length by itself, but leaves up to 63 of their iterations to a scalar loop, which for
rows of a hundred voxels is half of the time. It splits the sixteen into the registers that the processor has.
"""

import inspect
import operator
from typing import Any

from llvmlite import ir
from numba import extending, njit, types  # pyright: ignore[reportPrivateImportUsage]
from numba.core import config
from numba.core.codegen import get_host_cpu_features
from numba.extending import lower_builtin, models, register_model, type_callable
from numba.np.arrayobj import populate_array

WIDTH = 16
# XLA's numbers of pixel types. An image of ones is one bool.
BOOL, UINT8, UINT16 = 1, 6, 7
# Sums may be reordered, but NaN stays NaN.
FLAGS = ("reassoc", "nsz", "arcp", "contract", "afn")
FAST = {"fastmath": set(FLAGS), "error_model": "numpy"}
# Of functions that only kernels call.
_WITHIN = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
I8, I32, I64, F32 = ir.IntType(8), ir.IntType(32), ir.IntType(64), ir.FloatType()
FLOATS, INTEGERS = ir.VectorType(F32, WIDTH), ir.VectorType(I32, WIDTH)
TWO, PAIRS = ir.VectorType(F32, 2), ir.VectorType(F32, 2 * WIDTH)
_FEATURES = getattr(config, "CPU_FEATURES", None)
# Whether one instruction permutes 32 numbers.
HAS_AVX512 = "+avx512f" in (get_host_cpu_features() if _FEATURES is None else _FEATURES)


def inline(function):
    """Compile a function into its callers. Type checkers' wrappers are removed."""
    return njit(forceinline=True, **_WITHIN, **FAST)(inspect.unwrap(function))


def function(function):
    """Compile a function once."""
    return njit(**_WITHIN, **FAST)(inspect.unwrap(function))


def instruction(result) -> Any:
    """Make `emit(builder, *values)`, which writes LLVM code, callable in kernels. Integer arguments arrive as int64.

    Of an array (C-contiguous) it returns the address and the sizes.
    """

    def decorate(emit):
        def define(_, *kinds):
            kinds = [types.int64 if isinstance(kind, types.Integer) else kind for kind in kinds]

            def code(context, builder, signature, values):
                value = emit(builder, *values)
                if isinstance(result, types.Array):
                    return _array(context, builder, result, *value)
                return context.get_dummy_value() if result is types.none else value

            return result(*kinds), code

        define.__name__, define.__signature__ = emit.__name__, inspect.signature(emit)  # pyright: ignore
        return extending.intrinsic(define)

    return decorate


def _array(context, builder, kind, address, sizes):
    array = context.make_array(kind)(context, builder)
    strides = [I64(kind.dtype.bitwidth // 8)]
    for size in reversed(sizes[1:]):
        strides.insert(0, builder.mul(strides[0], size))
    data = builder.inttoptr(address, array.data.type)
    populate_array(array, data=data, shape=sizes, strides=strides, itemsize=strides[-1], meminfo=None)
    return array._getvalue()


class Vector(types.Type):
    """Sixteen float32."""

    def __init__(self):
        super().__init__(name=f"float32x{WIDTH}")


VECTOR = Vector()


@register_model(Vector)
class _Model(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, FLOATS)


def _arithmetic(operation, name):
    @type_callable(operation)
    def kind(_):
        def of(a, b):
            if {a, b} == {VECTOR} or {a, b} == {VECTOR, types.float32}:
                return VECTOR

        return of

    def code(context, builder, signature, arguments):
        both = [a if kind == VECTOR else _splat(builder, a) for a, kind in zip(arguments, signature.args, strict=True)]
        return getattr(builder, name)(*both, flags=FLAGS)

    for pair in ((VECTOR, VECTOR), (VECTOR, types.float32), (types.float32, VECTOR)):
        lower_builtin(operation, *pair)(code)


_arithmetic(operator.add, "fadd")
_arithmetic(operator.sub, "fsub")
_arithmetic(operator.mul, "fmul")
_arithmetic(operator.truediv, "fdiv")


def _splat(builder, number):
    first = builder.insert_element(ir.Constant(ir.VectorType(number.type, WIDTH), ir.Undefined), number, I32(0))
    return builder.shuffle_vector(first, first, ir.Constant(INTEGERS, [0] * WIDTH))


def _constant(number):
    return ir.Constant(FLOATS, [number] * WIDTH)


def _order(builder, first, second, order):
    return builder.shuffle_vector(first, second, ir.Constant(ir.VectorType(I32, len(order)), order))


def _load(builder, address, kind, align=4):
    return builder.load(builder.inttoptr(address, kind.as_pointer()), align=align)


def _store(builder, value, address):
    builder.store(value, builder.inttoptr(address, value.type.as_pointer()), align=4)


def load_number(builder, address, place):
    """The number of 64 bits at a place of a list."""
    return _load(builder, _place(builder, address, place), I64)


def _place(builder, address, place):
    return builder.add(address, builder.mul(place, I64(8)))


@instruction(types.int64)
def call(builder, function, first, second, third):
    """Call a C function by its address; one with fewer arguments ignores the rest."""
    kind = ir.FunctionType(I64, [I64, I64, I64]).as_pointer()
    return builder.call(builder.inttoptr(function, kind), [first, second, third])


zeros = instruction(VECTOR)(lambda builder: _constant(0.0))
load = instruction(VECTOR)(lambda builder, address: _load(builder, address, FLOATS))
# So many numbers from an address on.
floats = instruction(types.Array(types.float32, 1, "C"))(lambda builder, address, count: (address, [count]))
integers = instruction(types.Array(types.int32, 1, "C"))(lambda builder, address, count: (address, [count]))
load_one = instruction(types.float32)(lambda builder, address: _load(builder, address, F32))
load_int = instruction(types.int32)(lambda builder, address: _load(builder, address, I32))
load_long = instruction(types.int64)(lambda builder, address, place: load_number(builder, address, place))
store = instruction(types.none)(lambda builder, address, vector: _store(builder, vector, address))
store_long = instruction(types.none)(
    lambda builder, address, place, number: _store(builder, number, _place(builder, address, place))
)
store_one = instruction(types.none)(lambda builder, address, number: _store(builder, number, address))
# Two neighbours, as 64 bits.
copy_two = instruction(types.none)(lambda builder, source, target: _store(builder, _load(builder, source, I64), target))


@instruction(types.none)
def add_two(builder, source, target):
    """Add two neighbours to two others."""
    value = _load(builder, source, TWO)
    _store(builder, builder.fadd(_load(builder, target, TWO), value), target)


@instruction(types.none)
def prefetch(builder, address):
    """Read a line into the cache; the address need not exist."""
    kind = ir.FunctionType(ir.VoidType(), [I8.as_pointer(), I32, I32, I32])
    call = builder.module.declare_intrinsic("llvm.prefetch", [I8.as_pointer()], kind)
    builder.call(call, [builder.inttoptr(address, I8.as_pointer()), I32(0), I32(3), I32(1)])


@instruction(VECTOR)
def load_pixels(builder, kind, address, number):
    """Sixteen pixels from a number on, of `UINT8`, `UINT16` or float32."""
    values = []
    done = builder.append_basic_block("done")
    for wanted, bits in ((UINT8, 8), (UINT16, 16)):
        here, elsewhere = builder.append_basic_block(), builder.append_basic_block()
        builder.cbranch(builder.icmp_signed("==", kind, kind.type(wanted)), here, elsewhere)
        builder.position_at_end(here)
        place = builder.add(address, builder.mul(number, number.type(bits // 8)))
        integers = _load(builder, place, ir.VectorType(ir.IntType(bits), WIDTH), align=1)
        values.append((builder.uitofp(integers, FLOATS), here))
        builder.branch(done)
        builder.position_at_end(elsewhere)
    place = builder.add(address, builder.mul(number, number.type(4)))
    values.append((_load(builder, place, FLOATS), elsewhere))
    builder.branch(done)
    builder.position_at_end(done)
    value = builder.phi(FLOATS)
    for pixels, block in values:
        value.add_incoming(pixels, block)
    return value


@instruction(VECTOR)
def clip(builder, vector):
    """To 0 ... 1."""
    zero, one = _constant(0.0), _constant(1.0)
    vector = builder.select(builder.fcmp_ordered(">", vector, zero), vector, zero)
    return builder.select(builder.fcmp_ordered("<", vector, one), vector, one)


@instruction(types.float32)
def total(builder, vector):
    """The sum of the sixteen."""
    count = WIDTH
    while count > 1:
        count //= 2
        low, high = (_order(builder, vector, vector, list(range(n, n + count))) for n in (0, count))
        vector = builder.fadd(low, high)
    return builder.extract_element(vector, I32(0))


@instruction(VECTOR)
def bitwise_or(builder, first, second):
    bits = [builder.bitcast(value, INTEGERS) for value in (first, second)]
    return builder.bitcast(builder.or_(*bits), FLOATS)


@instruction(types.boolean)
def any_nonzero(builder, vector):
    nonzero = builder.bitcast(builder.fcmp_unordered("!=", vector, _constant(0.0)), ir.IntType(WIDTH))
    return builder.icmp_unsigned("!=", nonzero, nonzero.type(0))


@instruction(types.none)
def clamp_pixels(builder, pixel, fraction, top, low, right):
    """Move sixteen pixels (int32) at `pixel` to 0 ... `top`, and correct their fractions of the way to the next."""
    pixel, fraction = _load(builder, pixel, INTEGERS), _load(builder, fraction, FLOATS)
    zero, top = ir.Constant(INTEGERS, [0] * WIDTH), _splat(builder, builder.trunc(top, I32))
    inside = builder.select(builder.icmp_signed(">", pixel, zero), pixel, zero)
    inside = builder.select(builder.icmp_signed("<", inside, top), inside, top)
    _store(builder, inside, low)
    beyond = builder.sitofp(builder.sub(pixel, inside), FLOATS)
    _store(builder, builder.fadd(fraction, beyond, flags=FLAGS), right)


@instruction(types.none)
def subtract(builder, address, number):
    """A number from sixteen integers (int32)."""
    _store(
        builder, builder.sub(_load(builder, address, INTEGERS), _splat(builder, builder.trunc(number, I32))), address
    )


def _load_every_second(builder, address, first):
    both = _load(builder, address, PAIRS)
    return _order(builder, both, both, list(range(first, 2 * WIDTH, 2)))


load_even = instruction(VECTOR)(lambda builder, address: _load_every_second(builder, address, 0))
load_odd = instruction(VECTOR)(lambda builder, address: _load_every_second(builder, address, 1))


@instruction(types.none)
def store_pairs(builder, address, even, odd):
    """32 numbers, by turns from the one and the other."""
    _store(builder, _order(builder, even, odd, [i // 2 + WIDTH * (i % 2) for i in range(2 * WIDTH)]), address)


@instruction(VECTOR)
def permute(builder, places, shift, first, second):
    """Of 32 numbers those at sixteen places (int32, at an address) plus `shift`; only the last five bits count."""
    return _permute(builder, _places(builder, places, shift), first, second)


@instruction(VECTOR)
def permute_64(builder, places, shift, first, second, third, fourth):
    """Of 64 numbers those at sixteen places (int32, at an address) plus `shift`."""
    places = _places(builder, places, shift)
    near, far = _permute(builder, places, first, second), _permute(builder, places, third, fourth)
    last = ir.Constant(INTEGERS, [2 * WIDTH - 1] * WIDTH)
    return builder.select(builder.icmp_signed(">", places, last), far, near)


def _places(builder, address, shift):
    return builder.add(_load(builder, address, INTEGERS), _splat(builder, builder.trunc(shift, I32)))


def _permute(builder, places, first, second):
    if not HAS_AVX512:  # compiled, but never run
        return first
    name, kind = "llvm.x86.avx512.vpermi2var.ps.512", ir.FunctionType(FLOATS, [FLOATS, INTEGERS, FLOATS])
    call = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
    return builder.call(call, [first, places, second])


@instruction(types.none)
def transpose(builder, source, target):
    """Sixteen rows of sixteen numbers to columns."""
    rows = [_load(builder, builder.add(source, I64(4 * WIDTH * number)), FLOATS) for number in range(WIDTH)]
    # Squares of 1, 2, 4 and 8 a side change places across the diagonal.
    size = 1
    while size < WIDTH:
        upper = [i if i & size == 0 else WIDTH + i - size for i in range(WIDTH)]
        lower = [i + size if i & size == 0 else WIDTH + i for i in range(WIDTH)]
        for one in (i for i in range(WIDTH) if i & size == 0):
            pair = rows[one], rows[one + size]
            rows[one], rows[one + size] = _order(builder, *pair, upper), _order(builder, *pair, lower)
        size *= 2
    for number, row in enumerate(rows):
        _store(builder, row, builder.add(target, I64(4 * WIDTH * number)))
