"""Parquet tables, with their units in the metadata of the columns."""

import io

from fits.io._extras import need
from fits.io._read_file import refuse_large
from fits.io._table import Table, of_frame
from fits.io.formats._base import Format, register


def open_parquet(path: str, data: bytes) -> Table:
    """Read all columns of numbers and times."""
    parquet = need("pyarrow.parquet", "io")
    file = parquet.ParquetFile(io.BytesIO(data))
    refuse_large(path, 8 * file.metadata.num_rows * file.metadata.num_columns)
    table = file.read()
    told = {each.name: {**(each.metadata or {})} for each in table.schema}
    units = {name: (of.get(b"unit") or of.get(b"units") or b"").decode() for name, of in told.items()}
    return of_frame(path, table.to_pandas(), units)


register(Format("a Parquet file", (".parquet", ".pq"), (b"PAR1",), open_parquet))
