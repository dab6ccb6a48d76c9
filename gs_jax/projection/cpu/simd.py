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

from .dispatch import WIDTH

# What XLA calls the types of pixels; an image of ones is a bool.
BOOL, UINT8, UINT16 = 1, 6, 7
# Any order of sums, but NaN stays NaN.
FLAGS = ("reassoc", "nsz", "arcp", "contract", "afn")
FAST = {"fastmath": set(FLAGS), "error_model": "numpy"}
FLOATS = ir.VectorType(ir.FloatType(), WIDTH)
I32 = ir.IntType(32)
INTEGERS = ir.VectorType(I32, WIDTH)
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
        super().__init__(manager, kind, FLOATS)


def splat(builder, number):
    first = builder.insert_element(ir.Constant(ir.VectorType(number.type, WIDTH), ir.Undefined), number, I32(0))
    return builder.shuffle_vector(first, first, ir.Constant(INTEGERS, [0] * WIDTH))


def _arithmetic(operation, instruction):
    @type_callable(operation)
    def kind(_):
        def of(a, b):
            if {a, b} == {VECTOR} or {a, b} == {VECTOR, types.float32}:
                return VECTOR

        return of

    def code(context, builder, signature, arguments):
        both = [a if kind == VECTOR else splat(builder, a) for a, kind in zip(arguments, signature.args, strict=True)]
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


def pointer_to(builder, address, kind):
    return builder.inttoptr(address, kind.as_pointer())


@intrinsic
def load(_, address):
    """From an address that is a multiple of four."""
    return VECTOR(address), lambda context, builder, signature, arguments: builder.load(
        pointer_to(builder, arguments[0], FLOATS), align=4
    )


@intrinsic
def load_pixels(_, kind, address, number):
    """Sixteen pixels from a number on, of the types that XLA numbers so: bytes, words of 16 bits, or else float32."""

    def code(context, builder, signature, arguments):
        kind, address, number = arguments
        values = []
        found = builder.append_basic_block("found")
        for wanted, bits in ((UINT8, 8), (UINT16, 16)):
            here, elsewhere = builder.append_basic_block(), builder.append_basic_block()
            builder.cbranch(builder.icmp_signed("==", kind, kind.type(wanted)), here, elsewhere)
            builder.position_at_end(here)
            place = builder.add(address, builder.mul(number, number.type(bits // 8)))
            integers = builder.load(pointer_to(builder, place, ir.VectorType(ir.IntType(bits), WIDTH)), align=1)
            values.append((builder.uitofp(integers, FLOATS), here))
            builder.branch(found)
            builder.position_at_end(elsewhere)
        place = builder.add(address, builder.mul(number, number.type(4)))
        values.append((builder.load(pointer_to(builder, place, FLOATS), align=4), elsewhere))
        builder.branch(found)
        builder.position_at_end(found)
        value = builder.phi(FLOATS)
        for pixels, block in values:
            value.add_incoming(pixels, block)
        return value

    return VECTOR(types.int64, types.int64, types.int64), code


@intrinsic
def store(_, address, vector):
    """To an address that is a multiple of four."""

    def code(context, builder, signature, arguments):
        builder.store(arguments[1], pointer_to(builder, arguments[0], FLOATS), align=4)
        return context.get_dummy_value()

    return types.none(address, vector), code


@intrinsic
def clipped(_, vector):
    """To 0 ... 1."""

    def code(context, builder, signature, arguments):
        (value,) = arguments
        zero, one = (splat(builder, ir.Constant(ir.FloatType(), number)) for number in (0.0, 1.0))
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
            halves = (ir.Constant(ir.VectorType(I32, count), list(range(start, start + count))) for start in (0, count))
            low, high = (builder.shuffle_vector(value, value, half) for half in halves)
            value = builder.fadd(low, high)
        return builder.extract_element(value, I32(0))

    return types.float32(vector), code


@intrinsic
def zeros(_):
    return VECTOR(), lambda context, builder, signature, arguments: ir.Constant(FLOATS, [0.0] * WIDTH)


@intrinsic
def copy_two(_, source, target):
    """Two neighbours, 64 bits, from and to addresses that are multiples of four."""

    def code(context, builder, signature, arguments):
        both = ir.IntType(64)
        value = builder.load(pointer_to(builder, arguments[0], both), align=4)
        builder.store(value, pointer_to(builder, arguments[1], both), align=4)
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
        there = pointer_to(builder, arguments[1], both)
        value = builder.load(pointer_to(builder, arguments[0], both), align=4)
        builder.store(builder.fadd(builder.load(there, align=4), value), there, align=4)
        return context.get_dummy_value()

    return types.none(source, target), code


@intrinsic
def load_one(_, address):
    return types.float32(address), lambda context, builder, signature, arguments: builder.load(
        pointer_to(builder, arguments[0], ir.FloatType())
    )


@intrinsic
def load_int(_, address):
    """An int32."""
    return types.int32(address), lambda context, builder, signature, arguments: builder.load(
        pointer_to(builder, arguments[0], I32)
    )


@intrinsic
def store_one(_, address, number):
    def code(context, builder, signature, arguments):
        builder.store(arguments[1], pointer_to(builder, arguments[0], ir.FloatType()))
        return context.get_dummy_value()

    return types.none(address, number), code


@intrinsic
def either(_, first, second):
    """All bits of both: zero where both are."""

    def code(context, builder, signature, arguments):
        bits = [builder.bitcast(value, INTEGERS) for value in arguments]
        return builder.bitcast(builder.or_(*bits), FLOATS)

    return VECTOR(first, second), code


@intrinsic
def any_light(_, vector):
    """Whether one of the sixteen is not zero."""

    def code(context, builder, signature, arguments):
        lit = builder.fcmp_unordered("!=", arguments[0], ir.Constant(FLOATS, [0.0] * WIDTH))
        return builder.icmp_unsigned("!=", builder.bitcast(lit, ir.IntType(WIDTH)), ir.IntType(WIDTH)(0))

    return types.boolean(vector), code


@intrinsic
def split(_, pixel, fraction, top, low, right):
    """Sixteen pixels (int32) and fractions of the way to the next, to pixels from zero to a top and their fractions."""

    def code(context, builder, signature, arguments):
        pixel, fraction, top, low, right = arguments
        pixel = builder.load(pointer_to(builder, pixel, INTEGERS), align=4)
        fraction = builder.load(pointer_to(builder, fraction, FLOATS), align=4)
        zero, top = ir.Constant(INTEGERS, [0] * WIDTH), splat(builder, builder.trunc(top, I32))
        inside = builder.select(builder.icmp_signed(">", pixel, zero), pixel, zero)
        inside = builder.select(builder.icmp_signed("<", inside, top), inside, top)
        builder.store(inside, pointer_to(builder, low, INTEGERS), align=4)
        beyond = builder.sitofp(builder.sub(pixel, inside), FLOATS)
        builder.store(builder.fadd(fraction, beyond, flags=FLAGS), pointer_to(builder, right, FLOATS), align=4)
        return context.get_dummy_value()

    return types.none(pixel, fraction, top, low, right), code


@intrinsic
def subtract(_, address, number):
    """A number from sixteen integers (int32)."""

    def code(context, builder, signature, arguments):
        there = pointer_to(builder, arguments[0], INTEGERS)
        less = builder.sub(builder.load(there, align=4), splat(builder, builder.trunc(arguments[1], I32)))
        builder.store(less, there, align=4)
        return context.get_dummy_value()

    return types.none(address, number), code


@intrinsic
def fetch(_, address):
    """Ask for what is at an address, which need not be one, before it is read or written."""

    def code(context, builder, signature, arguments):
        byte = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, I32, I32, I32])
        prefetch = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        builder.call(prefetch, [pointer_to(builder, arguments[0], ir.IntType(8)), I32(0), I32(3), I32(1)])
        return context.get_dummy_value()

    return types.none(address), code
