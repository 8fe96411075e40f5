"""Parquet files whose end is missing, made whole again up to the last row group that is there.

What a parquet file holds and where is said at its end (the footer), which a writer adds when it is
closed. A killed recorder leaves the rows without it. But every page of values begins with a header
of its own [1], and what columns there are is known from the dataset, so the footer can be made
anew: each row group is followed page by page until the file ends.

References:
    [1] Apache Parquet, "File format", parquet-format/README.md and parquet.thrift.
"""

from __future__ import annotations

import io
import mmap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from xop_lerobot.curate.row_files import to_arrow
from xop_lerobot.curate.thrift import (
    I16,
    I32,
    I64,
    LIST,
    STRUCT,
    Field,
    Malformed,
    Reader,
    Struct,
    write_struct,
)

_MAGIC = b"PAR1"
_SAMPLE = 3
"""Rows of the file that shows how the columns are written."""
# Numbers of fields in parquet.thrift.
_META_ROWS, _META_GROUPS = 3, 4
_GROUP_COLUMNS, _GROUP_BYTES, _GROUP_ROWS, _GROUP_OFFSET, _GROUP_PACKED = 1, 2, 3, 5, 6
_GROUP_ORDINAL = 7
_CHUNK_OFFSET, _CHUNK_META = 2, 3
_COLUMN_ENCODINGS, _COLUMN_VALUES, _COLUMN_BYTES, _COLUMN_PACKED = 2, 5, 6, 7
_COLUMN_DATA, _COLUMN_DICTIONARY = 9, 11
_COLUMN_KEPT = (1, 2, 3, 4)
_PAGE_TYPE, _PAGE_BYTES, _PAGE_PACKED, _PAGE_V1, _PAGE_DICTIONARY, _PAGE_V2 = 1, 2, 3, 5, 7, 8
_IS_DICTIONARY = 2
_RLE = 3


@dataclass(frozen=True)
class _Page:
    """A page of values.

    Attributes:
        start: Where its header begins.
        stop: Where it ends.
        values: How many values it holds, of which a dictionary counts none.
        encoding: How they are encoded.
        size: Its size with header, not compressed.
        is_dictionary: Whether it is the dictionary of the pages after it.
    """

    start: int
    stop: int
    values: int
    encoding: int
    size: int
    is_dictionary: bool


class CannotSalvage(ValueError):
    """Nothing of the file can be made readable; the message says why."""


def salvage(path: Path, schema: pa.Schema, target: Path) -> int:
    """Write to `target` the row groups of `path` that are whole.

    Args:
        path: A parquet file whose end may be missing.
        schema: Its columns, as LeRobot writes them.
        target: Where the readable file goes.

    Returns:
        How many row groups it has.

    Raises:
        CannotSalvage: If it has none.
    """
    footer, sizes = _make_template(schema)
    if path.stat().st_size <= len(_MAGIC):
        raise CannotSalvage("the file is empty")
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if data[: len(_MAGIC)] != _MAGIC:
            raise CannotSalvage("it does not begin as a parquet file")
        pages = list(_read_pages(data))
    groups = _find_groups(pages, sizes)
    if not groups:
        raise CannotSalvage("not a single row group in it is whole")
    end = groups[-1][-1][-1].stop
    _fill(footer, groups, sizes)
    tail = write_struct(footer)
    target.parent.mkdir(parents=True, exist_ok=True)
    with path.open("rb") as file, target.open("wb") as out:
        _copy(file, out, end)
        out.write(tail + len(tail).to_bytes(4, "little") + _MAGIC)
    return _drop_broken(target, footer, groups)


def _copy(source: io.BufferedReader, target: io.BufferedWriter, count: int) -> None:
    while count:
        piece = source.read(min(count, 1 << 20))
        count -= len(piece)
        target.write(piece)


def _drop_broken(target: Path, footer: Struct, groups: Sequence[object]) -> int:
    """Read every row group, and leave out the first that is not readable and all after it."""
    with pq.ParquetFile(target) as file:
        good = 0
        for group in range(len(groups)):
            try:
                file.read_row_group(group, use_threads=False)
            except (pa.ArrowException, OSError):
                break
            good += 1
    if not good:
        target.unlink()
        raise CannotSalvage("not a single row group in it can be decoded")
    if good < len(groups):
        kind, rows = footer[_META_GROUPS].value
        footer[_META_GROUPS] = Field(LIST, (kind, rows[:good]))
        footer[_META_ROWS] = Field(I64, sum(row[_GROUP_ROWS].value for row in rows[:good]))
        tail = write_struct(footer)
        with target.open("ab") as out:
            out.write(tail + len(tail).to_bytes(4, "little") + _MAGIC)
    return good


def _make_template(schema: pa.Schema) -> tuple[Struct, list[int]]:
    """Write a small file of the same columns; return its footer, and the values a row by column."""
    arrays = [_make_sample(field.type) for field in schema]
    buffer = io.BytesIO()
    writer = pq.ParquetWriter(buffer, schema=schema, compression="snappy", use_dictionary=True)
    writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
    writer.close()
    data = buffer.getvalue()
    length = int.from_bytes(data[-8:-4], "little")
    footer = Reader(data, len(data) - 8 - length).read_struct()
    (group,) = footer[_META_GROUPS].value[1]
    sizes = []
    for chunk in group[_GROUP_COLUMNS].value[1]:
        count = chunk[_CHUNK_META].value[_COLUMN_VALUES].value
        sizes.append(count // _SAMPLE)
    return footer, sizes


def _make_sample(kind: pa.DataType) -> pa.Array:
    if pa.types.is_fixed_size_list(kind):
        return to_arrow(np.zeros((_SAMPLE, kind.list_size), np.int64), kind)
    if pa.types.is_struct(kind):
        return pa.array([{"bytes": b"", "path": ""}] * _SAMPLE, kind)
    if pa.types.is_string(kind):
        return pa.array([""] * _SAMPLE, kind)
    try:
        return to_arrow(np.zeros(_SAMPLE, np.int64), kind)
    except pa.ArrowException as error:
        raise CannotSalvage(f"columns of {kind} cannot be followed") from error


def _read_pages(data: mmap.mmap) -> Iterator[_Page]:
    """Follow the pages from the beginning until one is cut off or makes no sense."""
    place, view = len(_MAGIC), memoryview(data)
    try:
        while place < len(data):
            reader = Reader(view, place)
            try:
                page = _make_page(reader.read_struct(), place, reader.place)
            except (Malformed, KeyError, AttributeError, TypeError):
                return
            if page.stop > len(data):
                return
            yield page
            place = page.stop
    finally:
        view.release()


def _make_page(header: Struct, start: int, place: int) -> _Page:
    is_dictionary = header[_PAGE_TYPE].value == _IS_DICTIONARY
    part = header.get(_PAGE_V1) or header.get(_PAGE_V2) or header[_PAGE_DICTIONARY]
    values, v2 = part.value[1].value, _PAGE_V2 in header
    encoding = part.value[4 if v2 else 2].value
    packed = header[_PAGE_PACKED].value
    if packed < 0 or values < 0:
        raise Malformed("a negative size")
    return _Page(
        start=start,
        stop=place + packed,
        values=0 if is_dictionary else values,
        encoding=encoding,
        size=place - start + header[_PAGE_BYTES].value,
        is_dictionary=is_dictionary,
    )


def _find_groups(pages: list[_Page], sizes: list[int]) -> list[list[list[_Page]]]:
    """Sort pages into row groups and columns, as far as whole row groups go."""
    groups, place = [], 0
    while place < len(pages):
        found = _find_group(pages, place, sizes)
        if found is None:
            break
        groups.append(found)
        place += sum(map(len, found))
    return groups


def _find_group(pages: list[_Page], place: int, sizes: list[int]) -> list[list[_Page]] | None:
    """Sort the pages of one row group into columns; None if it is not whole.

    How many rows it has is not said anywhere: each number is tried at which the first column may
    end, until all columns come out even.
    """
    values = 0
    for end in range(place, len(pages)):
        if end > place and pages[end].is_dictionary:
            break
        values += pages[end].values
        if values and values % sizes[0] == 0:
            columns = _sort_columns(pages, place, values // sizes[0], sizes)
            if columns is not None:
                return columns
    return None


def _sort_columns(
    pages: list[_Page], place: int, rows: int, sizes: list[int]
) -> list[list[_Page]] | None:
    columns = []
    for size in sizes:
        column, left = [], rows * size
        while left > 0:
            if place == len(pages) or (column and pages[place].is_dictionary):
                return None
            column.append(pages[place])
            left -= pages[place].values
            place += 1
        if left:
            return None
        columns.append(column)
    return columns


def _fill(footer: Struct, groups: list[list[list[_Page]]], sizes: list[int]) -> None:
    """Let the footer of the template say where the pages of `groups` are."""
    (template,) = footer[_META_GROUPS].value[1]
    rows = [_make_group(template, group, i, sizes) for i, group in enumerate(groups)]
    footer[_META_GROUPS] = Field(LIST, (STRUCT, rows))
    footer[_META_ROWS] = Field(I64, sum(row[_GROUP_ROWS].value for row in rows))


def _make_group(
    template: Struct, group: list[list[_Page]], number: int, sizes: list[int]
) -> Struct:
    chunks = []
    for shape, pages in zip(template[_GROUP_COLUMNS].value[1], group, strict=True):
        known = shape[_CHUNK_META].value
        meta = {field: known[field] for field in _COLUMN_KEPT if field in known}
        encodings = sorted({page.encoding for page in pages} | {_RLE})
        data = next(page for page in pages if not page.is_dictionary)
        meta |= {
            _COLUMN_ENCODINGS: Field(LIST, (I32, encodings)),
            _COLUMN_VALUES: Field(I64, sum(page.values for page in pages)),
            _COLUMN_BYTES: Field(I64, sum(page.size for page in pages)),
            _COLUMN_PACKED: Field(I64, pages[-1].stop - pages[0].start),
            _COLUMN_DATA: Field(I64, data.start),
        }
        if pages[0].is_dictionary:
            meta[_COLUMN_DICTIONARY] = Field(I64, pages[0].start)
        chunks.append({_CHUNK_OFFSET: Field(I64, 0), _CHUNK_META: Field(STRUCT, meta)})
    metas = [chunk[_CHUNK_META].value for chunk in chunks]
    return {
        _GROUP_COLUMNS: Field(LIST, (STRUCT, chunks)),
        _GROUP_BYTES: Field(I64, sum(meta[_COLUMN_BYTES].value for meta in metas)),
        _GROUP_ROWS: Field(I64, metas[0][_COLUMN_VALUES].value // sizes[0]),
        _GROUP_OFFSET: Field(I64, group[0][0].start),
        _GROUP_PACKED: Field(I64, sum(meta[_COLUMN_PACKED].value for meta in metas)),
        _GROUP_ORDINAL: Field(I16, number),
    }
