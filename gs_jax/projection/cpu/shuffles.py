"""Sixteen numbers in another order, in numba."""

from llvmlite import ir
from numba import types
from numba.core import config
from numba.core.codegen import get_host_cpu_features

from .dispatch import WIDTH
from .simd import FLOATS, I32, INTEGERS, VECTOR, intrinsic, pointer_to, splat

_FEATURES = getattr(config, "CPU_FEATURES", None)
# Whether the processor picks sixteen of 32 numbers by their places at once (AVX-512).
PICKS = "+avx512f" in (get_host_cpu_features() if _FEATURES is None else _FEATURES)


def _loads_every_second(first):
    @intrinsic
    def load_some(_, address):
        def code(context, builder, signature, arguments):
            both = builder.load(pointer_to(builder, arguments[0], ir.VectorType(ir.FloatType(), 2 * WIDTH)), align=4)
            mask = ir.Constant(INTEGERS, list(range(first, 2 * WIDTH, 2)))
            return builder.shuffle_vector(both, both, mask)

        return VECTOR(address), code

    return load_some


# Of 32 numbers.
load_even, load_odd = _loads_every_second(0), _loads_every_second(1)


@intrinsic
def store_pairs(_, address, even, odd):
    """32 numbers, in turns from the one and the other."""

    def code(context, builder, signature, arguments):
        kind = ir.VectorType(ir.FloatType(), 2 * WIDTH)
        order = [i // 2 + WIDTH * (i % 2) for i in range(2 * WIDTH)]
        both = builder.shuffle_vector(*arguments[1:], ir.Constant(ir.VectorType(I32, 2 * WIDTH), order))
        builder.store(both, pointer_to(builder, arguments[0], kind), align=4)
        return context.get_dummy_value()

    return types.none(address, even, odd), code


@intrinsic
def pick(_, places, further, first, second):
    """Of 32 numbers those at sixteen places (int32, at an address) and so much further; their last five bits count."""

    def code(context, builder, signature, arguments):
        _, _, first, second = arguments
        return _picked(builder, _places(builder, *arguments[:2]), first, second)

    return VECTOR(places, types.int64, first, second), code


@intrinsic
def pick_of_64(_, places, further, first, second, third, fourth):
    """Of 64 numbers those at sixteen places (int32, at an address) and so much further."""

    def code(context, builder, signature, arguments):
        places, pairs = _places(builder, *arguments[:2]), (arguments[2:4], arguments[4:])
        near, far = (_picked(builder, places, *pair) for pair in pairs)
        last = ir.Constant(INTEGERS, [2 * WIDTH - 1] * WIDTH)
        return builder.select(builder.icmp_signed(">", places, last), far, near)

    return VECTOR(places, types.int64, first, second, third, fourth), code


def _places(builder, address, further):
    places = builder.load(pointer_to(builder, address, INTEGERS), align=4)
    return builder.add(places, splat(builder, builder.trunc(further, I32)))


def _picked(builder, places, first, second):
    name, kind = "llvm.x86.avx512.vpermi2var.ps.512", ir.FunctionType(FLOATS, [FLOATS, INTEGERS, FLOATS])
    permute = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
    return builder.call(permute, [first, places, second])


@intrinsic
def transpose(_, source, target):
    """Sixteen rows of sixteen numbers to columns."""

    def code(context, builder, signature, arguments):
        place = lambda address, number: builder.add(address, ir.IntType(64)(4 * WIDTH * number))
        row = lambda address, number: pointer_to(builder, place(address, number), FLOATS)
        rows = [builder.load(row(arguments[0], number), align=4) for number in range(WIDTH)]
        # Squares of 1, 2, 4 and 8 a side change places across the diagonal.
        size = 1
        while size < WIDTH:
            upper = [i if i & size == 0 else WIDTH + i - size for i in range(WIDTH)]
            lower = [i + size if i & size == 0 else WIDTH + i for i in range(WIDTH)]
            for one in (i for i in range(WIDTH) if i & size == 0):
                pair = rows[one], rows[one + size]
                for number, order in ((one, upper), (one + size, lower)):
                    rows[number] = builder.shuffle_vector(*pair, ir.Constant(INTEGERS, order))
            size *= 2
        for number, value in enumerate(rows):
            builder.store(value, row(arguments[1], number), align=4)
        return context.get_dummy_value()

    return types.none(source, target), code
