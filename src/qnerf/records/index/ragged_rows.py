"""Rows of different shapes in one Arrow table, without loss.

A configuration value may be a whole number in one run, text in another and absent in a third. Here every name has one
column a kind ("int seed", "text seed"), and every row tells its shape: the names and kinds it has, in order. Rows come
and go without changing what the others hold, so the same rows give the same columns whatever came before them.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

KINDS = {"int": pa.int64(), "float": pa.float64(), "bool": pa.bool_(), "text": pa.string(), "none": pa.null()}
KIND_OF_TYPE = {
    **dict.fromkeys(("int64", "int32", "int16", "int8", "uint32", "uint16", "uint8"), "int"),
    **dict.fromkeys(("double", "float", "halffloat"), "float"),
    **dict.fromkeys(("string", "large_string"), "text"),
    "bool": "bool",
    "null": "none",
}
"""Name of an Arrow type -> the kind that holds its values."""

KEY, STAMP, SHAPE = "key", "stamp", "shape"
SCHEMA = pa.schema([(KEY, pa.string()), (STAMP, pa.string()), (SHAPE, pa.int32())])


@dataclass(frozen=True)
class Shape:
    """Names of the values in order, and the kind of each."""

    names: tuple[str, ...]
    kinds: tuple[str, ...]


@dataclass(frozen=True)
class Row:
    """key: whose values these are. stamp: of the file that they came from."""

    key: str
    stamp: str
    shape: Shape
    values: Sequence[Any]


@dataclass(frozen=True)
class Rows:
    """table: key, stamp, number of the shape, then a column for every kind of every name, null where a row has none."""

    table: pa.Table
    shapes: tuple[Shape, ...]

    @classmethod
    def of(cls, rows: Iterable[Row]) -> "Rows":
        """Raises ValueError, pyarrow's or Python's own, where a value is not of the kind its shape tells."""
        groups: dict[Shape, list[Row]] = {}
        for row in rows:
            groups.setdefault(row.shape, []).append(row)
        tables = [_uniform(shape, number, group) for number, (shape, group) in enumerate(groups.items())]
        return cls(_concat([SCHEMA.empty_table(), *tables]), tuple(groups))

    def __add__(self, other: "Rows") -> "Rows":
        numbers = {shape: number for number, shape in enumerate(self.shapes)}
        renumbered = [numbers.setdefault(shape, len(numbers)) for shape in other.shapes]
        column = pc.take(pa.array(renumbered, pa.int32()), other.table[SHAPE])
        table = other.table.set_column(other.table.schema.get_field_index(SHAPE), SHAPE, column)
        return Rows(_concat([self.table, table]), tuple(numbers))

    def take(self, indices: Sequence[int]) -> "Rows":
        if indices == list(range(self.table.num_rows)):
            return self
        return Rows(self.table.take(pa.array(indices, pa.int64())), self.shapes)

    def sorted(self) -> "Rows":
        """By key."""
        return Rows(self.table.sort_by(KEY), self.shapes)

    def keys(self) -> list[str]:
        keys: list[str] = self.table[KEY].to_pylist()
        return keys

    def columns(self, names: Collection[str] | None = None) -> dict[str, pa.ChunkedArray]:
        """One column a name, by default all: of the one kind that its values have; of float64 where they are whole
        and other numbers; else of text. All null, of Arrow's null type, where no row has a value.

        Names that no row has are left out.
        """
        kinds = self._kinds()
        wanted = kinds if names is None else [name for name in names if name in kinds]
        return {name: _joined([(kind, self._column(kind, name)) for kind in kinds[name]]) for name in wanted}

    def _column(self, kind: str, name: str) -> pa.ChunkedArray:
        return pa.chunked_array([pa.nulls(len(self.table))]) if kind == "none" else self.table[physical(kind, name)]

    def _kinds(self) -> dict[str, list[str]]:
        found: dict[str, dict[str, None]] = {}
        for number in self.table[SHAPE].unique().to_pylist():
            shape = self.shapes[number]
            for name, kind in zip(shape.names, shape.kinds, strict=True):
                found.setdefault(name, {})[kind] = None
        return {name: sorted(kinds) for name, kinds in found.items()}


def physical(kind: str, name: str) -> str:
    """Name of the table's column that holds the values of that kind."""
    return f"{kind} {name}"


def physicals(shapes: Iterable[Shape], names: Collection[str]) -> list[str]:
    """The table's columns that hold the values of these names."""
    pairs = chain.from_iterable(zip(shape.kinds, shape.names, strict=True) for shape in shapes)
    wanted = dict.fromkeys(physical(kind, name) for kind, name in pairs if name in names and kind != "none")
    return list(wanted)


def _uniform(shape: Shape, number: int, rows: Sequence[Row]) -> pa.Table:
    """Rows of one shape."""
    head = [pa.array([row.key for row in rows]), pa.array([row.stamp for row in rows])]
    head.append(pa.array([number] * len(rows), pa.int32()))
    columns = dict(zip(SCHEMA.names, head, strict=True))
    for name, kind, values in zip(
        shape.names, shape.kinds, zip(*(row.values for row in rows), strict=True), strict=True
    ):
        if kind != "none":
            columns[physical(kind, name)] = pa.array(values, KINDS[kind])
    return pa.table(columns)


def _concat(tables: Sequence[pa.Table]) -> pa.Table:
    return pa.concat_tables(tables, promote_options="default").combine_chunks()


def _joined(parts: Sequence[tuple[str, pa.ChunkedArray]]) -> pa.ChunkedArray:
    """Columns of which every row has a value in one at most."""
    filled = [(kind, column) for kind, column in parts if kind != "none"] or list(parts)
    if len(filled) == 1:
        return filled[0][1]
    if {kind for kind, _ in filled} == {"int", "float"}:
        try:
            return pc.coalesce(*(column.cast(pa.float64()) for _, column in filled))
        except pa.ArrowInvalid:  # a whole number that float64 cannot hold
            pass
    return pc.coalesce(*(column.cast(pa.string()) for _, column in filled))
