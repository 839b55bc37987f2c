"""Rows with different columns in one Arrow table, without loss.

An option may be a whole number in one run, text in another and absent in a third. Here every name has one column per
kind of value ("int seed", "text seed"), and every row has a shape: its names and their kinds, in order. Adding and
removing rows does not change the others, so the same rows give the same result whatever was in the table before.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from qnerf.records.parquet import KINDS

KEY, STAMP, SHAPE = "key", "stamp", "shape"
HEAD_SCHEMA = pa.schema([(KEY, pa.string()), (STAMP, pa.string()), (SHAPE, pa.int32())])


@dataclass(frozen=True)
class RowShape:
    """Names of a row's values in order, and the kind of each."""

    names: tuple[str, ...]
    kinds: tuple[str, ...]


@dataclass(frozen=True)
class RaggedRow:
    """key: of which run. stamp: the version of the file that the values were read from."""

    key: str
    stamp: str
    shape: RowShape
    values: Sequence[Any]


@dataclass(frozen=True)
class RaggedTable:
    """table: key, stamp, number of the shape, then one column for each kind of each name, null where a row has none."""

    table: pa.Table
    shapes: tuple[RowShape, ...]

    @classmethod
    def of(cls, rows: Iterable[RaggedRow]) -> "RaggedTable":
        """Raises ValueError, TypeError or OverflowError if a value does not fit the kind in its row's shape."""
        groups: dict[RowShape, list[RaggedRow]] = {}
        for row in rows:
            groups.setdefault(row.shape, []).append(row)
        tables = [_table_of_one_shape(shape, number, rows) for number, (shape, rows) in enumerate(groups.items())]
        return cls(_concat([HEAD_SCHEMA.empty_table(), *tables]), tuple(groups))

    def __add__(self, other: "RaggedTable") -> "RaggedTable":
        numbers = {shape: number for number, shape in enumerate(self.shapes)}
        renumbered = [numbers.setdefault(shape, len(numbers)) for shape in other.shapes]
        column = pc.take(pa.array(renumbered, pa.int32()), other.table[SHAPE])
        table = other.table.set_column(other.table.schema.get_field_index(SHAPE), SHAPE, column)
        return RaggedTable(_concat([self.table, table]), tuple(numbers))

    def take(self, indices: Sequence[int | None]) -> "RaggedTable":
        """These rows; an index None gives a row without any value."""
        if indices == list(range(self.table.num_rows)):
            return self
        return RaggedTable(self.table.take(pa.array(indices, pa.int64())), self.shapes)

    def reindexed(self, keys: Iterable[str]) -> "RaggedTable":
        """The rows with these keys, in this order; without any value where there is no such row."""
        numbers = {key: number for number, key in enumerate(self.keys())}
        return self.take([numbers.get(key) for key in keys])

    def sorted(self) -> "RaggedTable":
        """By key."""
        return RaggedTable(self.table.sort_by(KEY), self.shapes)

    def keys(self) -> list[str]:
        keys: list[str] = self.table[KEY].to_pylist()
        return keys

    def columns(self, names: Collection[str] | None = None) -> dict[str, pa.ChunkedArray]:
        """One column per name, by default all. Names that no row has are left out.

        A column has the one kind of its values; whole and other numbers together are float64; other mixtures are text.
        If no row has a value, the column has Arrow's null type.
        """
        kinds = self._kinds_by_name()
        chosen = kinds if names is None else [name for name in names if name in kinds]
        return {name: _merged({kind: self._column(kind, name) for kind in kinds[name]}) for name in chosen}

    def values(self, name: str) -> list[Any]:
        """Plain values of one column; all None if no row has it."""
        column = self.columns([name]).get(name)
        return [None] * self.table.num_rows if column is None else column.to_pylist()

    def _column(self, kind: str, name: str) -> pa.ChunkedArray:
        return pa.chunked_array([pa.nulls(len(self.table))]) if kind == "none" else self.table[column_name(kind, name)]

    def _kinds_by_name(self) -> dict[str, list[str]]:
        result: dict[str, set[str]] = {}
        for number in self.table[SHAPE].unique().drop_null().to_pylist():
            shape = self.shapes[number]
            for name, kind in zip(shape.names, shape.kinds, strict=True):
                result.setdefault(name, set()).add(kind)
        return {name: sorted(kinds) for name, kinds in result.items()}


def column_name(kind: str, name: str) -> str:
    """Name of the table's column with the values of that kind."""
    return f"{kind} {name}"


def column_names(shapes: Iterable[RowShape], names: Collection[str]) -> list[str]:
    """Names of the table's columns with the values of these names."""
    pairs = chain.from_iterable(zip(shape.kinds, shape.names, strict=True) for shape in shapes)
    return list(dict.fromkeys(column_name(kind, name) for kind, name in pairs if name in names and kind != "none"))


def schema_of(shapes: Iterable[RowShape]) -> pa.Schema:
    """Columns of a table whose rows have these shapes."""
    pairs = chain.from_iterable(zip(shape.kinds, shape.names, strict=True) for shape in shapes)
    columns = {column_name(kind, name): KINDS[kind] for kind, name in pairs if kind != "none"}
    return pa.schema([*HEAD_SCHEMA, *columns.items()])


def _table_of_one_shape(shape: RowShape, number: int, rows: Sequence[RaggedRow]) -> pa.Table:
    head = [pa.array([row.key for row in rows]), pa.array([row.stamp for row in rows])]
    head.append(pa.array([number] * len(rows), pa.int32()))
    columns = dict(zip(HEAD_SCHEMA.names, head, strict=True))
    values_by_column = zip(*(row.values for row in rows), strict=True)
    for name, kind, values in zip(shape.names, shape.kinds, values_by_column, strict=True):
        if kind != "none":
            columns[column_name(kind, name)] = pa.array(values, KINDS[kind])
    return pa.table(columns)


def _concat(tables: Sequence[pa.Table]) -> pa.Table:
    return pa.concat_tables(tables, promote_options="default").combine_chunks()


def _merged(columns: dict[str, pa.ChunkedArray]) -> pa.ChunkedArray:
    """One column out of several, by kind; every row has a value in at most one of them."""
    filled = {kind: column for kind, column in columns.items() if kind != "none"} or columns
    if len(filled) == 1:
        return next(iter(filled.values()))
    if filled.keys() == {"int", "float"}:
        try:
            return pc.coalesce(*(column.cast(pa.float64()) for column in filled.values()))
        except pa.ArrowInvalid:  # a whole number that float64 cannot hold
            pass
    return pc.coalesce(*(column.cast(pa.string()) for column in filled.values()))
