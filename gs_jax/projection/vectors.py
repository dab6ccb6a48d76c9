"""Sixteen numbers at once in numba: a type with arithmetic, and what loads and stores it.

LLVM vectorises loops of unknown length by itself, but leaves up to 63 of their turns to a scalar loop, which for rows
of a hundred voxels is half of the time. It cuts the sixteen into what the processor has.
"""

import operator
from inspect import unwrap
from typing import Any

from llvmlite import ir
from numba import carray as _carray, extending, njit, types  # pyright: ignore[reportPrivateImportUsage]
from numba.extending import lower_builtin, models, register_model, type_callable

from .native import WIDTH

# Any order of sums, but NaN stays NaN.
FLAGS = ("reassoc", "nsz", "arcp", "contract", "afn")
FAST = {"fastmath": set(FLAGS), "error_model": "numpy"}
_FLOATS = ir.VectorType(ir.FloatType(), WIDTH)
_I32 = ir.IntType(32)
# What it makes of a function takes one argument less, which type checkers cannot know.
intrinsic: Any = extending.intrinsic
carray: Any = _carray


def inline(function):
    """A function for kernels, without what type checkers have wrapped around it."""
    return njit(inline="always", **FAST)(unwrap(function))


def function(function):
    """A function for kernels that is compiled once, however often it is called."""
    return njit(**FAST)(unwrap(function))


class Vector(types.Type):
    """Sixteen float32."""

    def __init__(self):
        super().__init__(name=f"float32x{WIDTH}")


VECTOR = Vector()


@register_model(Vector)
class _Model(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _FLOATS)


def _splat(builder, number):
    first = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), number, _I32(0))
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(_I32, WIDTH), [0] * WIDTH))


def _arithmetic(operation, instruction):
    @type_callable(operation)
    def kind(_):
        def of(a, b):
            if {a, b} == {VECTOR} or {a, b} == {VECTOR, types.float32}:
                return VECTOR

        return of

    def code(context, builder, signature, arguments):
        both = [a if kind == VECTOR else _splat(builder, a) for a, kind in zip(arguments, signature.args, strict=True)]
        return getattr(builder, instruction)(*both, flags=FLAGS)

    for pair in ((VECTOR, VECTOR), (VECTOR, types.float32), (types.float32, VECTOR)):
        lower_builtin(operation, *pair)(code)


for _operation, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _arithmetic(_operation, _instruction)


def _pointer(builder, address, kind):
    return builder.inttoptr(address, kind.as_pointer())


@intrinsic
def load(_, address):
    """From an address that is a multiple of four."""
    return VECTOR(address), lambda context, builder, signature, arguments: builder.load(
        _pointer(builder, arguments[0], _FLOATS), align=4
    )


def _loads_integers(bits):
    @intrinsic
    def load_integers(_, address):
        def code(context, builder, signature, arguments):
            kind = ir.VectorType(ir.IntType(bits), WIDTH)
            return builder.uitofp(builder.load(_pointer(builder, arguments[0], kind), align=1), _FLOATS)

        return VECTOR(address), code

    return load_integers


load_uint8, load_uint16 = _loads_integers(8), _loads_integers(16)


@intrinsic
def store(_, address, vector):
    """To an address that is a multiple of four."""

    def code(context, builder, signature, arguments):
        builder.store(arguments[1], _pointer(builder, arguments[0], _FLOATS), align=4)
        return context.get_dummy_value()

    return types.none(address, vector), code


def _loads_every_second(first):
    @intrinsic
    def load_some(_, address):
        def code(context, builder, signature, arguments):
            both = builder.load(_pointer(builder, arguments[0], ir.VectorType(ir.FloatType(), 2 * WIDTH)), align=4)
            mask = ir.Constant(ir.VectorType(_I32, WIDTH), list(range(first, 2 * WIDTH, 2)))
            return builder.shuffle_vector(both, both, mask)

        return VECTOR(address), code

    return load_some


# Of 32 numbers.
load_even, load_odd = _loads_every_second(0), _loads_every_second(1)


@intrinsic
def clipped(_, vector):
    """To 0 ... 1."""

    def code(context, builder, signature, arguments):
        (value,) = arguments
        zero, one = (_splat(builder, ir.Constant(ir.FloatType(), number)) for number in (0.0, 1.0))
        value = builder.select(builder.fcmp_ordered(">", value, zero), value, zero)
        return builder.select(builder.fcmp_ordered("<", value, one), value, one)

    return VECTOR(vector), code


@intrinsic
def total(_, vector):
    """The sum of the sixteen."""

    def code(context, builder, signature, arguments):
        (value,) = arguments
        count = WIDTH
        while count > 1:
            count //= 2
            halves = (
                ir.Constant(ir.VectorType(_I32, count), list(range(start, start + count))) for start in (0, count)
            )
            low, high = (builder.shuffle_vector(value, value, half) for half in halves)
            value = builder.fadd(low, high)
        return builder.extract_element(value, _I32(0))

    return types.float32(vector), code


@intrinsic
def zeros(_):
    return VECTOR(), lambda context, builder, signature, arguments: ir.Constant(_FLOATS, [0.0] * WIDTH)


@intrinsic
def copy_two(_, source, target):
    """Two neighbours, 64 bits, from and to addresses that are multiples of four."""

    def code(context, builder, signature, arguments):
        both = ir.IntType(64)
        value = builder.load(_pointer(builder, arguments[0], both), align=4)
        builder.store(value, _pointer(builder, arguments[1], both), align=4)
        return context.get_dummy_value()

    return types.none(source, target), code


@intrinsic
def pointer(_, address):
    """An address as a pointer."""
    return types.voidptr(address), lambda context, builder, signature, arguments: builder.inttoptr(
        arguments[0], context.get_value_type(types.voidptr)
    )


@intrinsic
def add_two(_, source, target):
    """Two neighbours, added to two others."""

    def code(context, builder, signature, arguments):
        both = ir.VectorType(ir.FloatType(), 2)
        there = _pointer(builder, arguments[1], both)
        value = builder.load(_pointer(builder, arguments[0], both), align=4)
        builder.store(builder.fadd(builder.load(there, align=4), value), there, align=4)
        return context.get_dummy_value()

    return types.none(source, target), code


@intrinsic
def store_pairs(_, address, even, odd):
    """32 numbers, in turns from the one and the other."""

    def code(context, builder, signature, arguments):
        kind = ir.VectorType(ir.FloatType(), 2 * WIDTH)
        order = [i // 2 + WIDTH * (i % 2) for i in range(2 * WIDTH)]
        both = builder.shuffle_vector(*arguments[1:], ir.Constant(ir.VectorType(_I32, 2 * WIDTH), order))
        builder.store(both, _pointer(builder, arguments[0], kind), align=4)
        return context.get_dummy_value()

    return types.none(address, even, odd), code


@intrinsic
def load_one(_, address):
    return types.float32(address), lambda context, builder, signature, arguments: builder.load(
        _pointer(builder, arguments[0], ir.FloatType())
    )


@intrinsic
def store_one(_, address, number):
    def code(context, builder, signature, arguments):
        builder.store(arguments[1], _pointer(builder, arguments[0], ir.FloatType()))
        return context.get_dummy_value()

    return types.none(address, number), code


@intrinsic
def either(_, first, second):
    """All bits of both: zero where both are."""

    def code(context, builder, signature, arguments):
        bits = [builder.bitcast(value, ir.VectorType(_I32, WIDTH)) for value in arguments]
        return builder.bitcast(builder.or_(*bits), _FLOATS)

    return VECTOR(first, second), code


@intrinsic
def any_light(_, vector):
    """Whether one of the sixteen is not zero."""

    def code(context, builder, signature, arguments):
        lit = builder.fcmp_unordered("!=", arguments[0], ir.Constant(_FLOATS, [0.0] * WIDTH))
        return builder.icmp_unsigned("!=", builder.bitcast(lit, ir.IntType(WIDTH)), ir.IntType(WIDTH)(0))

    return types.boolean(vector), code


@intrinsic
def transpose(_, source, target):
    """Sixteen rows of sixteen numbers to columns."""

    def code(context, builder, signature, arguments):
        place = lambda address, number: builder.add(address, ir.IntType(64)(4 * WIDTH * number))
        row = lambda address, number: _pointer(builder, place(address, number), _FLOATS)
        rows = [builder.load(row(arguments[0], number), align=4) for number in range(WIDTH)]
        # Squares of 1, 2, 4 and 8 a side change places across the diagonal.
        size = 1
        while size < WIDTH:
            upper = [i if i & size == 0 else WIDTH + i - size for i in range(WIDTH)]
            lower = [i + size if i & size == 0 else WIDTH + i for i in range(WIDTH)]
            for one in (i for i in range(WIDTH) if i & size == 0):
                pair = rows[one], rows[one + size]
                for number, order in ((one, upper), (one + size, lower)):
                    rows[number] = builder.shuffle_vector(*pair, ir.Constant(ir.VectorType(_I32, WIDTH), order))
            size *= 2
        for number, value in enumerate(rows):
            builder.store(value, row(arguments[1], number), align=4)
        return context.get_dummy_value()

    return types.none(source, target), code


@intrinsic
def fetch(_, address):
    """Ask for what is at an address, which need not be one, before it is read or written."""

    def code(context, builder, signature, arguments):
        byte = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, _I32, _I32, _I32])
        prefetch = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        builder.call(prefetch, [_pointer(builder, arguments[0], ir.IntType(8)), _I32(0), _I32(3), _I32(1)])
        return context.get_dummy_value()

    return types.none(address), code
