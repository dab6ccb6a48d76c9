"""Sums of convolutions on a processor, in numba: tiles of the images are transformed in the cache (overlap-save).

A kernel `(job, part)` as in `kernels`. Two tiles are transformed at once, as the real and the imaginary part of one:
what they are convolved with is real, so they stay apart. A tile is kept in strips of sixteen columns, real parts before
imaginary ones, so that sixteen columns are transformed at once. Rows become columns in between, which leaves the
spectrum so; and frequencies stay in the order in which the transform leaves them (`order`). Both do not matter to a
product with a spectrum that is given alike.
"""

import numpy as np

from . import rows as r, simd as v
from .rows import BUFFERS, PARTS, PER_BUFFER, ZERO
from .shuffles import transpose
from .simd import WIDTH, carray, function, inline

# Buffers: a plan, cosines and sines, spectra; images follow, and sums of them.
_PLAN, _TURNS, _SPECTRA, _IMAGES = range(4)
# Bytes of sixteen numbers.
_STEP = 4 * WIDTH


def overlap_save(job_address, part, _):
    """Images to sums of their convolutions, or one image to its convolutions; a part is some of the pairs of tiles."""
    job = carray(v.pointer(job_address), 256, np.int64)
    # A sum's pixel i starts to read an image at i + shift; a tile gives `kept` pixels each way.
    plan = r.integers(job, _PLAN)[:, 0, 0]
    images, sums, shift, kept = np.int64(plan[0]), np.int64(plan[1]), np.int64(plan[2]), np.int64(plan[3])
    turns, side = r.address(job, _TURNS), r.size(job, _TURNS, 0)
    strip = 2 * _plane(side)
    tile = strip * (side // WIDTH)
    scratch = np.empty(3 * tile // 4 + WIDTH, np.float32)
    edge = np.zeros(WIDTH, np.float32)
    at_edge = np.int64(edge.ctypes.data)
    at_tile = (np.int64(scratch.ctypes.data) + _STEP - 1) // _STEP * _STEP
    at_sum, at_last = at_tile + tile, at_tile + 2 * tile
    tall, wide = r.size(job, _IMAGES + images, 0), r.size(job, _IMAGES + images, 1)
    across = (wide + kept - 1) // kept
    tiles = (tall + kept - 1) // kept * across
    pairs = (tiles + 1) // 2
    for pair in range(part * pairs // job[PARTS], (part + 1) * pairs // job[PARTS]):
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
                    lit2 = _read(job, place, row2 + shift, column2 + shift, at_last + _plane(side), side, at_edge)
                    lit = lit1 or lit2
                    if lit:
                        for s in range(side // WIDTH):
                            _transform(at_last + strip * s, side, turns)
                            _turn(at_last + strip * s, at_tile, s, side)
                        for s in range(side // WIDTH):
                            _transform(at_tile + strip * s, side, turns)
                if lit:
                    factors = r.address(job, _SPECTRA) + 8 * side * side * (result if images == 1 else number)
                    _multiply(at_tile, factors, at_sum, side, fresh)
                    fresh = False
            if not fresh:
                for s in range(side // WIDTH):
                    _transform_back(at_sum + strip * s, side, turns)
                    _turn(at_sum + strip * s, at_last, s, side)
            place = BUFFERS + PER_BUFFER * (_IMAGES + images + result)
            if not fresh:
                for s in range((kept + WIDTH - 1) // WIDTH):
                    _transform_back(at_last + strip * s, side, turns)
            _write(job, place, row1, column1, at_last, side, kept, fresh, at_edge)
            _write(job, place, row2, column2, at_last + _plane(side), side, kept, fresh, at_edge)
    r.keep((scratch, edge))


@inline
def _plane(side):
    """Bytes from a strip's real parts to its imaginary ones; a line more, or all rows would share few cache lines."""
    return _STEP * (side + 1)


@function
def _read(job, place, row, column, at, side, at_edge):
    """A tile of an image, zero where the image ends, to one plane of the strips; returns whether there is light."""
    tall, wide, strip = job[place + 2], job[place + 3], 2 * _plane(side)
    inside, seen = column >= 0 and column + side <= wide, v.zeros()
    for y in range(side):
        there = row + y >= 0 and row + y < tall
        source, target = job[place] + 4 * ((row + y) * wide + column), at + _STEP * y
        for s in range(side // WIDTH):
            value = v.zeros()
            if there and inside:
                value = v.load(source + _STEP * s)
            elif there:
                value = _window(source + _STEP * s, column + WIDTH * s, wide, at_edge)
            seen = v.either(seen, value)
            v.store(target + strip * s, value)
    return v.any_light(seen)


@inline
def _window(here, column, wide, at_edge):
    """Sixteen pixels, some of which may lie beyond the image."""
    for rest in range(WIDTH):
        there = column + rest >= 0 and column + rest < wide
        v.store_one(at_edge + 4 * rest, v.load_one(here + 4 * rest) if there else ZERO)
    return v.load(at_edge)


@function
def _write(job, place, row, column, at, side, kept, dark, at_edge):
    """What is kept of a tile, of one plane of the strips, to an image."""
    tall, wide, strip = job[place + 2], job[place + 3], 2 * _plane(side)
    for y in range(min(kept, tall - row)):
        source, target = at + _STEP * y, job[place] + 4 * ((row + y) * wide + column)
        for s in range(kept // WIDTH):
            value = v.zeros() if dark else v.load(source + strip * s)
            left = wide - column - WIDTH * s
            if left >= WIDTH:
                v.store(target + _STEP * s, value)
            elif left > 0:
                v.store(at_edge, value)
                for rest in range(left):
                    v.store_one(target + _STEP * s + 4 * rest, v.load_one(at_edge + 4 * rest))


@function
def _turn(at_strip, at_tile, number, side):
    """A strip's rows to columns of a tile."""
    plane = _plane(side)
    for block in range(side // WIDTH):
        source, target = at_strip + _STEP * WIDTH * block, at_tile + 2 * plane * block + _STEP * WIDTH * number
        transpose(source, target)
        transpose(source + plane, target + plane)


@function
def _multiply(at_tile, at_factors, at_sum, side, fresh):
    """Add a tile's product with a spectrum, or make it the sum."""
    plane, place, factor = _plane(side), 0, at_factors
    for _ in range(side // WIDTH):
        for _ in range(side):
            a, b = v.load(at_tile + place), v.load(at_tile + place + plane)
            c, d = v.load(factor), v.load(factor + _STEP * side)
            x, y = a * c - b * d, a * d + b * c
            if not fresh:
                x, y = x + v.load(at_sum + place), y + v.load(at_sum + place + plane)
            v.store(at_sum + place, x)
            v.store(at_sum + place + plane, y)
            place, factor = place + _STEP, factor + _STEP
        place, factor = place + 2 * plane - _STEP * side, factor + _STEP * side


@inline
def _cosine(turns, number):
    return v.load_one(turns + 8 * number)


@inline
def _sine(turns, number):
    return v.load_one(turns + 8 * number + 4)


@function
def _transform(at, side, turns):
    """The columns of a strip, in place: four rows at a time, at the end two if it must be."""
    plane, span = _plane(side), side
    while span > 2:
        quarter, stride = span // 4, side // span
        q = _STEP * quarter
        for k in range(quarter):
            c1, s1 = _cosine(turns, k * stride), _sine(turns, k * stride)
            c2, s2 = _cosine(turns, 2 * k * stride), _sine(turns, 2 * k * stride)
            c3, s3 = _cosine(turns, 3 * k * stride), _sine(turns, 3 * k * stride)
            for base in range(k, side, span):
                x = at + _STEP * base
                y = x + plane
                ar, br, cr, dr = v.load(x), v.load(x + q), v.load(x + 2 * q), v.load(x + 3 * q)
                ai, bi, ci, di = v.load(y), v.load(y + q), v.load(y + 2 * q), v.load(y + 3 * q)
                sr, si, tr, ti = ar + cr, ai + ci, ar - cr, ai - ci
                ur, ui, wr, wi = br + dr, bi + di, bi - di, dr - br
                v.store(x, sr + ur)
                v.store(y, si + ui)
                er, ei = tr + wr, ti + wi
                v.store(x + q, er * c1 + ei * s1)
                v.store(y + q, ei * c1 - er * s1)
                fr, fi = sr - ur, si - ui
                v.store(x + 2 * q, fr * c2 + fi * s2)
                v.store(y + 2 * q, fi * c2 - fr * s2)
                gr, gi = tr - wr, ti - wi
                v.store(x + 3 * q, gr * c3 + gi * s3)
                v.store(y + 3 * q, gi * c3 - gr * s3)
        span = quarter
    if span == 2:
        _by_two(at, side)


@function
def _transform_back(at, side, turns):
    """`_transform` from its end to its start; the numbers come out `side` times as large."""
    plane, span = _plane(side), 4
    while span < side:
        span *= 4
    if span > side:
        _by_two(at, side)
        span = 8
    else:
        span = 4
    while span <= side:
        quarter, stride = span // 4, side // span
        q = _STEP * quarter
        for k in range(quarter):
            c1, s1 = _cosine(turns, k * stride), _sine(turns, k * stride)
            c2, s2 = _cosine(turns, 2 * k * stride), _sine(turns, 2 * k * stride)
            c3, s3 = _cosine(turns, 3 * k * stride), _sine(turns, 3 * k * stride)
            for base in range(k, side, span):
                x = at + _STEP * base
                y = x + plane
                ar, br, cr, dr = v.load(x), v.load(x + q), v.load(x + 2 * q), v.load(x + 3 * q)
                ai, bi, ci, di = v.load(y), v.load(y + q), v.load(y + 2 * q), v.load(y + 3 * q)
                er, ei = br * c1 - bi * s1, bi * c1 + br * s1
                fr, fi = cr * c2 - ci * s2, ci * c2 + cr * s2
                gr, gi = dr * c3 - di * s3, di * c3 + dr * s3
                sr, si, ur, ui = ar + fr, ai + fi, ar - fr, ai - fi
                tr, ti, wr, wi = er + gr, ei + gi, gi - ei, er - gr
                v.store(x, sr + tr)
                v.store(y, si + ti)
                v.store(x + q, ur + wr)
                v.store(y + q, ui + wi)
                v.store(x + 2 * q, sr - tr)
                v.store(y + 2 * q, si - ti)
                v.store(x + 3 * q, ur - wr)
                v.store(y + 3 * q, ui - wi)
        span *= 4


@inline
def _by_two(at, side):
    for plane in (at, at + _plane(side)):
        for x in range(plane, plane + _STEP * side, 2 * _STEP):
            a, b = v.load(x), v.load(x + _STEP)
            v.store(x, a + b)
            v.store(x + _STEP, a - b)
