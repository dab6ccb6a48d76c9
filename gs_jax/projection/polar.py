"""Between square nodes about a lens and the polar ones of its halo: sparse tables, and their product with columns."""

import dataclasses
import math
from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..optics.field_varying import PolarGrid, polar_weights
from .linear_map import linear_call

# Rings of polar nodes, from the axis on, that are closer to each other than pixels are.
_INNER = 4
# Entries of a row that are gathered one by one, in one pass without a copy.
_FEW = 8


class Rows(NamedTuple):
    """The rows of a sparse matrix, those with about as many entries together.

    `entries`: of each such part `(row, entry)` columns and shares, filled up with zeros. `order`: where among all the
    parts' rows each row is.
    """

    entries: tuple[tuple[np.ndarray, np.ndarray], ...]
    order: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Table:
    """A sparse matrix and its transpose; `patch`: side of the square of pixels."""

    patch: int
    rows: Rows
    transposed: Rows


def apply(table: Table, columns: Float[Array, "row many"]) -> Float[Array, "new many"]:
    """A table times many columns. Both directions gather whole rows: the scatter of a transpose is slower by far."""
    return linear_call(_forth, _back, None, table, (), columns)


def _forth(table, _, columns):
    return _times(table.rows, columns)


def _back(table, _, columns):
    return _times(table.transposed, columns)


def _times(rows, columns):
    parts = [_part(index, weight.astype(columns.dtype), columns) for index, weight in rows.entries]
    return jnp.concatenate(parts).at[rows.order].get(mode="promise_in_bounds")


def _part(index, weight, columns):
    taken = lambda at: columns.at[at].get(mode="promise_in_bounds")
    if index.shape[1] > _FEW:
        return jnp.einsum("re,rec->rc", weight, taken(index))
    total = jnp.zeros((len(index), columns.shape[1]), columns.dtype)
    for at, share in zip(index.T, weight.T, strict=True):
        total = total + share[:, None] * taken(at)
    return total


@cache
def splat_table(halo: PolarGrid) -> Table:
    """From the square nodes about a lens to the polar ones: what each node holds is shared by the four around it."""
    reach = math.ceil(halo.nodes(halo.fields)[-2])
    node, index, share = _polar(halo, halo.fields, reach)
    return _table(2 * reach + 1, node, index, share, halo.fields * halo.angles, to_polar=True)


@cache
def spread_table(halo: PolarGrid) -> Table:
    """From polar nodes to the pixels about a lens: the density of light, interpolated, so that none is lost.

    About the axis the nodes are closer than the pixels, and are shared by the four around them instead.
    """
    reach = math.ceil(halo.nodes(halo.radii)[-2])
    pixel, node, share = _polar(halo, halo.radii, reach)
    outer = (node >= _INNER * halo.angles) & (share > 0)
    pixel, node, share = pixel[outer], node[outer], share[outer]
    total = np.bincount(node, share, halo.radii * halo.angles)
    # The last rings are cut by the window's edge, and have no more light than that.
    whole = node < (halo.radii - 3) * halo.angles
    share = share / np.where(whole, total[node], np.repeat(halo.areas(halo.radii), halo.angles)[node])
    near_pixel, near_node, near_share = _near_axis(halo, reach)
    pixel, node = np.concatenate([pixel, near_pixel]), np.concatenate([node, near_node])
    share = np.concatenate([share, near_share])
    return _table(2 * reach + 1, pixel, node, share, halo.radii * halo.angles, to_polar=False)


def _near_axis(halo: PolarGrid, reach: int):
    """Entries (square node, polar node, share) of the inner polar nodes, each shared by the four pixels around it."""
    node = np.arange(_INNER * halo.angles)
    radius, angle = halo.nodes(_INNER)[node // halo.angles], 2 * np.pi * (node % halo.angles) / halo.angles
    place = np.stack([radius * np.sin(angle), radius * np.cos(angle)], -1) + reach
    whole = np.floor(place).astype(int)
    parts = []
    for corner in np.ndindex(2, 2):
        row, column = (whole + corner).T
        share = np.where(corner, place - whole, 1 - (place - whole)).prod(-1)
        parts.append((row * (2 * reach + 1) + column, node, share))
    return (np.concatenate(part) for part in zip(*parts, strict=True))


def _polar(halo: PolarGrid, count: int, reach: int):
    """Entries (square node, polar node, share) of the bilinear interpolation between polar nodes."""
    side = np.arange(-reach, reach + 1)
    y, x = (part.ravel() for part in np.meshgrid(side, side, indexing="ij"))
    return polar_weights(halo, count, x, y)


def _table(patch, square, polar, share, polars, *, to_polar):
    by_polar, by_square = _by_row(polar, square, share, polars), _by_row(square, polar, share, patch**2)
    return Table(patch, by_polar, by_square) if to_polar else Table(patch, by_square, by_polar)


def _by_row(row, column, share, rows):
    sorting = np.argsort(row, kind="stable")
    row, column, share = row[sorting], column[sorting], share[sorting]
    number = np.arange(row.size) - np.searchsorted(row, row)
    count = np.bincount(row, minlength=rows)
    size = np.ceil(np.log2(np.maximum(count, 1))).astype(int)
    entries = []
    for one in np.unique(size):
        place = np.cumsum(size == one) - 1
        mine = size[row] == one
        shape = np.count_nonzero(size == one), max(count[size == one].max(), 1)
        index, weight = np.zeros(shape, np.int32), np.zeros(shape)
        index[place[row[mine]], number[mine]], weight[place[row[mine]], number[mine]] = column[mine], share[mine]
        entries.append((index, weight))
    return Rows(tuple(entries), np.argsort(np.argsort(size, kind="stable")).astype(np.int32))
