"""Sums of convolutions in numba, by overlap-save: tiles of the images are transformed in the cache.

A kernel `(job, part)` as in `kernels`. Two tiles are transformed at once, as the real and the imaginary part of one
complex tile: the kernels are real, so the two stay apart. A tile is kept in strips of sixteen columns, real parts
before imaginary ones, so that sixteen columns are transformed at once. Rows become columns in between, and the spectrum
stays transposed; its frequencies stay in the order in which the transform leaves them. So do the kernels' spectra.
"""

import numpy as np

from . import rows, simd
from .gather import align
from .rows import BUFFERS, HALF, PER_BUFFER, ZERO
from .simd import WIDTH, function, inline

# Buffers: a plan, cosines and sines, spectra; images follow, and sums of them.
_PLAN, _TURNS, _SPECTRA, _IMAGES = range(4)
# Bytes of sixteen numbers.
_STEP = 4 * WIDTH
_SIN_60 = np.float32(np.sqrt(0.75))


def overlap_save(job, part, _):
    """Images to sums of their convolutions, or one image to its convolutions; a part is some of the pairs of tiles."""
    # A sum's pixel i starts to read an image at i + shift; a tile gives `kept` pixels each way.
    plan = rows.integer_list(job, _PLAN)
    images, sums, shift, kept = np.int64(plan[0]), np.int64(plan[1]), np.int64(plan[2]), np.int64(plan[3])
    turns, side = rows.address(job, _TURNS), rows.size(job, _TURNS, 0)
    strip = 2 * plane_bytes(side)
    tile = strip * (side // WIDTH)
    memory = rows.allocate(job, 3 * tile // 4 + WIDTH)
    if memory == 0:
        return rows.FAILED
    at_tile = align(memory)
    at_sum, at_last, at_edge = at_tile + tile, at_tile + 2 * tile, at_tile + 3 * tile
    tall, wide = rows.size(job, _IMAGES + images, 0), rows.size(job, _IMAGES + images, 1)
    across = (wide + kept - 1) // kept
    tiles = (tall + kept - 1) // kept * across
    pairs = (tiles + 1) // 2
    for pair in range(part * pairs // rows.parts(job), (part + 1) * pairs // rows.parts(job)):
        # The last may have no second, which then lies below the image.
        one, two = 2 * pair, 2 * pair + 1
        row1, column1 = kept * (one // across), kept * (one % across)
        row2, column2 = kept * (two // across), kept * (two % across)
        lit = False
        for result in range(sums):
            fresh = True
            for number in range(images):
                if result == 0:
                    place = BUFFERS + PER_BUFFER * (_IMAGES + number)
                    lit1 = _read(job, place, row1 + shift, column1 + shift, at_last, side, at_edge)
                    lit2 = _read(job, place, row2 + shift, column2 + shift, at_last + plane_bytes(side), side, at_edge)
                    lit = lit1 or lit2
                    if lit:
                        for s in range(side // WIDTH):
                            transform(at_last + strip * s, side, turns)
                            _transpose(at_last + strip * s, at_tile, s, side)
                        for s in range(side // WIDTH):
                            transform(at_tile + strip * s, side, turns)
                if lit:
                    factors = rows.address(job, _SPECTRA) + 8 * side * side * (result if images == 1 else number)
                    _multiply(at_tile, factors, at_sum, side, fresh)
                    fresh = False
            if not fresh:
                for s in range(side // WIDTH):
                    transform_back(at_sum + strip * s, side, turns)
                    _transpose(at_sum + strip * s, at_last, s, side)
            place = BUFFERS + PER_BUFFER * (_IMAGES + images + result)
            if not fresh:
                for s in range((kept + WIDTH - 1) // WIDTH):
                    transform_back(at_last + strip * s, side, turns)
            _write(job, place, row1, column1, at_last, side, kept, fresh, at_edge)
            _write(job, place, row2, column2, at_last + plane_bytes(side), side, kept, fresh, at_edge)
    return rows.free(job, memory)


@inline
def plane_bytes(side):
    """Bytes from a strip's real parts to its imaginary ones; a line more, or all rows would share few cache lines."""
    return _STEP * (side + 1)


@function
def _read(job, place, row, column, at, side, at_edge):
    """Copy a tile of an image, zero beyond it, to one plane of the strips; returns whether any pixel is not zero."""
    tall, wide, strip = simd.load_long(job, place + 2), simd.load_long(job, place + 3), 2 * plane_bytes(side)
    inside, seen = column >= 0 and column + side <= wide, simd.zeros()
    for y in range(side):
        exists = row + y >= 0 and row + y < tall
        source, target = simd.load_long(job, place) + 4 * ((row + y) * wide + column), at + _STEP * y
        for s in range(side // WIDTH):
            value = simd.zeros()
            if exists and inside:
                value = simd.load(source + _STEP * s)
            elif exists:
                value = _load_some(source + _STEP * s, column + WIDTH * s, wide, at_edge)
            seen = simd.bitwise_or(seen, value)
            simd.store(target + strip * s, value)
    return simd.any_nonzero(seen)


@inline
def _load_some(address, column, wide, at_edge):
    """Sixteen pixels, some of which may lie beyond the image."""
    for n in range(WIDTH):
        exists = column + n >= 0 and column + n < wide
        simd.store_one(at_edge + 4 * n, simd.load_one(address + 4 * n) if exists else ZERO)
    return simd.load(at_edge)


@function
def _write(job, place, row, column, at, side, kept, dark, at_edge):
    """Copy what is kept of a tile from one plane of the strips to an image."""
    tall, wide, strip = simd.load_long(job, place + 2), simd.load_long(job, place + 3), 2 * plane_bytes(side)
    for y in range(min(kept, tall - row)):
        source, target = at + _STEP * y, simd.load_long(job, place) + 4 * ((row + y) * wide + column)
        for s in range(kept // WIDTH):
            value = simd.zeros() if dark else simd.load(source + strip * s)
            left = wide - column - WIDTH * s
            if left >= WIDTH:
                simd.store(target + _STEP * s, value)
            elif left > 0:
                simd.store(at_edge, value)
                for n in range(left):
                    simd.store_one(target + _STEP * s + 4 * n, simd.load_one(at_edge + 4 * n))


@function
def _transpose(at_strip, at_tile, number, side):
    """Copy a strip's rows to columns of a tile."""
    plane = plane_bytes(side)
    for block in range(side // WIDTH):
        source, target = at_strip + _STEP * WIDTH * block, at_tile + 2 * plane * block + _STEP * WIDTH * number
        simd.transpose(source, target)
        simd.transpose(source + plane, target + plane)


@function
def _multiply(at_tile, at_factors, at_sum, side, fresh):
    """Add the product of a tile and a spectrum to the sum, or begin it."""
    plane, place, factor = plane_bytes(side), 0, at_factors
    for _ in range(side // WIDTH):
        for _ in range(side):
            a, b = simd.load(at_tile + place), simd.load(at_tile + place + plane)
            c, d = simd.load(factor), simd.load(factor + _STEP * side)
            x, y = a * c - b * d, a * d + b * c
            if not fresh:
                x, y = x + simd.load(at_sum + place), y + simd.load(at_sum + place + plane)
            simd.store(at_sum + place, x)
            simd.store(at_sum + place + plane, y)
            place, factor = place + _STEP, factor + _STEP
        place, factor = place + 2 * plane - _STEP * side, factor + _STEP * side


@inline
def _turn(turns, number):
    return simd.load_one(turns + 8 * number), simd.load_one(turns + 8 * number + 4)


@inline
def _load_four(at, step):
    return simd.load(at), simd.load(at + step), simd.load(at + 2 * step), simd.load(at + 3 * step)


@inline
def _load_three(at, step):
    return simd.load(at), simd.load(at + step), simd.load(at + 2 * step)


@inline
def _store_three(at, step, a, b, c):
    simd.store(at, a)
    simd.store(at + step, b)
    simd.store(at + 2 * step, c)


@inline
def _store_four(at, step, a, b, c, d):
    simd.store(at, a)
    simd.store(at + step, b)
    simd.store(at + 2 * step, c)
    simd.store(at + 3 * step, d)


@function
def transform(at, side, turns):
    """FFT of the columns of a strip, in place: radix 3 at first and radix 2 at the end where needed, else radix 4."""
    plane, span = plane_bytes(side), side
    if side % 3 == 0:
        _radix_3(at, side, turns)
        span = side // 3
    while span > 2:
        quarter, stride = span // 4, side // span
        q = _STEP * quarter
        for k in range(quarter):
            (c1, s1), (c2, s2) = _turn(turns, k * stride), _turn(turns, 2 * k * stride)
            c3, s3 = _turn(turns, 3 * k * stride)
            for base in range(k, side, span):
                x = at + _STEP * base
                ar, br, cr, dr = _load_four(x, q)
                ai, bi, ci, di = _load_four(x + plane, q)
                sr, si, tr, ti = ar + cr, ai + ci, ar - cr, ai - ci
                ur, ui, wr, wi = br + dr, bi + di, bi - di, dr - br
                er, ei, fr, fi, gr, gi = tr + wr, ti + wi, sr - ur, si - ui, tr - wr, ti - wi
                _store_four(x, q, sr + ur, er * c1 + ei * s1, fr * c2 + fi * s2, gr * c3 + gi * s3)
                _store_four(x + plane, q, si + ui, ei * c1 - er * s1, fi * c2 - fr * s2, gi * c3 - gr * s3)
        span = quarter
    if span == 2:
        _radix_2(at, side)


@function
def transform_back(at, side, turns):
    """The inverse of `transform`, times `side`."""
    plane, last, span = plane_bytes(side), side // 3 if side % 3 == 0 else side, 4
    while span < last:
        span *= 4
    if span > last:
        _radix_2(at, side)
        span = 8
    else:
        span = 4
    while span <= last:
        quarter, stride = span // 4, side // span
        q = _STEP * quarter
        for k in range(quarter):
            (c1, s1), (c2, s2) = _turn(turns, k * stride), _turn(turns, 2 * k * stride)
            c3, s3 = _turn(turns, 3 * k * stride)
            for base in range(k, side, span):
                x = at + _STEP * base
                ar, br, cr, dr = _load_four(x, q)
                ai, bi, ci, di = _load_four(x + plane, q)
                er, ei = br * c1 - bi * s1, bi * c1 + br * s1
                fr, fi = cr * c2 - ci * s2, ci * c2 + cr * s2
                gr, gi = dr * c3 - di * s3, di * c3 + dr * s3
                sr, si, ur, ui = ar + fr, ai + fi, ar - fr, ai - fi
                tr, ti, wr, wi = er + gr, ei + gi, gi - ei, er - gr
                _store_four(x, q, sr + tr, ur + wr, sr - tr, ur - wr)
                _store_four(x + plane, q, si + ti, ui + wi, si - ti, ui - wi)
        span *= 4
    if last < side:
        _radix_3_back(at, side, turns)


@inline
def _radix_3(at, side, turns):
    plane, q = plane_bytes(side), _STEP * (side // 3)
    for k in range(side // 3):
        (c1, s1), (c2, s2), x = _turn(turns, k), _turn(turns, 2 * k), at + _STEP * k
        (ar, br, cr), (ai, bi, ci) = _load_three(x, q), _load_three(x + plane, q)
        sr, si, ur, ui = br + cr, bi + ci, _SIN_60 * (br - cr), _SIN_60 * (bi - ci)
        tr, ti = ar - HALF * sr, ai - HALF * si
        er, ei, fr, fi = tr + ui, ti - ur, tr - ui, ti + ur
        _store_three(x, q, ar + sr, er * c1 + ei * s1, fr * c2 + fi * s2)
        _store_three(x + plane, q, ai + si, ei * c1 - er * s1, fi * c2 - fr * s2)


@inline
def _radix_3_back(at, side, turns):
    plane, q = plane_bytes(side), _STEP * (side // 3)
    for k in range(side // 3):
        (c1, s1), (c2, s2), x = _turn(turns, k), _turn(turns, 2 * k), at + _STEP * k
        (ar, br, cr), (ai, bi, ci) = _load_three(x, q), _load_three(x + plane, q)
        er, ei = br * c1 - bi * s1, bi * c1 + br * s1
        fr, fi = cr * c2 - ci * s2, ci * c2 + cr * s2
        sr, si, ur, ui = er + fr, ei + fi, _SIN_60 * (er - fr), _SIN_60 * (ei - fi)
        tr, ti = ar - HALF * sr, ai - HALF * si
        _store_three(x, q, ar + sr, tr - ui, tr + ui)
        _store_three(x + plane, q, ai + si, ti + ur, ti - ur)


@inline
def _radix_2(at, side):
    for plane in (at, at + plane_bytes(side)):
        for x in range(plane, plane + _STEP * side, 2 * _STEP):
            a, b = simd.load(x), simd.load(x + _STEP)
            simd.store(x, a + b)
            simd.store(x + _STEP, a - b)
