"""Sparse matrices as arrays, by rows and by columns, and their products with dense ones."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

# Rows of a table with at most so many entries are summed entry by entry, without a copy.
_FEW = 8


class Entries(eqx.Module):
    """Entries of a sparse matrix, row after row, as arrays.

    `start`: the first entry of each row. `place`, `share`: column and value of each. `parts`: places and shares
    `(row, entry)` of the rows with 1, 2, 3-4, ... entries, filled up with zeros; `order`: these rows' order in the
    matrix. `columns`: number of columns.
    """

    start: Int[Array, " start"]
    place: Int[Array, " entry"]
    share: Float[Array, " entry"]
    parts: list[tuple[Int[Array, "_ _"], Float[Array, "_ _"]]]
    order: Int[Array, " _"]
    columns: int = eqx.field(static=True)

    @classmethod
    def by_row(cls, row, place, share, shape: tuple[int, int]) -> "Entries":
        """The matrix of a shape with these entries, in any order; `ValueError` if one is beyond it. Host code."""
        rows, columns = shape
        if row.size and not (0 <= min(row.min(), place.min()) and row.max() < rows and place.max() < columns):
            raise ValueError(f"entries must lie within {rows} x {columns}.")
        sorting = np.argsort(row, kind="stable")
        start = np.searchsorted(row[sorting], np.arange(rows + 1)).astype(np.int32)
        place, share = place[sorting].astype(np.int32), share[sorting]
        parts, order = _equal_parts(start, place, share)
        # Tables are kept: they must not belong to a program that is being traced.
        with jax.ensure_compile_time_eval():
            own = jax.device_put((start, place, share, parts, order))
        return cls(own[0], own[1], own[2], own[3], own[4], columns)


def _equal_parts(start, place, share):
    count = np.diff(start)
    size = np.ceil(np.log2(np.maximum(count, 1))).astype(int)
    parts = []
    for own in np.unique(size):
        number = np.arange(max(count[size == own].max(), 1))
        exists = number < count[size == own][:, None]
        at = np.where(exists, start[:-1][size == own][:, None] + number, 0)
        parts.append((np.where(exists, place[at], 0), np.where(exists, share[at], 0)))
    return parts, np.argsort(np.argsort(size, kind="stable")).astype(np.int32)


class SparseTable(eqx.Module):
    """A sparse matrix by rows and by columns; `side` is that of the square of pixels."""

    side: int = eqx.field(static=True)
    rows: Entries
    columns: Entries

    @classmethod
    def of(cls, side: int, row, column, share, shape: tuple[int, int]) -> "SparseTable":
        rows, columns = shape
        by_row, by_column = (row, column, share, (rows, columns)), (column, row, share, (columns, rows))
        return cls(side, Entries.by_row(*by_row), Entries.by_row(*by_column))

    @property
    def T(self) -> "SparseTable":
        """The transpose."""
        return SparseTable(self.side, self.columns, self.rows)


def times_entries(entries: Entries, x: Float[Array, "column lens"]) -> Float[Array, "row lens"]:
    """The product with a dense matrix. Both directions gather whole rows: the scatter of a transpose is much slower."""
    products = [_times_part(place, share.astype(x.dtype), x) for place, share in entries.parts]
    return jnp.concatenate(products).at[entries.order].get(mode="promise_in_bounds")


def _times_part(index, weight, columns):
    def take(at):
        return columns.at[at].get(mode="promise_in_bounds")

    if index.shape[1] > _FEW:
        return jnp.einsum("re,rec->rc", weight, take(index))
    total = jnp.zeros((len(index), columns.shape[1]), columns.dtype)
    for at, share in zip(index.T, weight.T, strict=True):
        total = total + share[:, None] * take(at)
    return total
