"""What a further column is: its name, its unit, how it is recognised, and how it is cleaned."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fits.io._quantity import FloatArray, Quantity, split_unit
from fits.io._record import Record


@dataclass(frozen=True)
class Column:
    """A column besides time, voltage and displacement. To add one, put one file that registers it into this folder.

    Headers of the name of the `quantity` in one of its units are recognised when a file is read, and converted.
    `name` is what effects call it in `needs`, that of the quantity if empty. `recognised` tells whether a column of
    some header, with its values of shape `(n,)` in a record, is this one; by default one of its name is. Effects get
    what `cleaned` makes of the values, shape `(n,)`, in the unit of the quantity: without what would mislead them.
    `shown_if_constant` says whether one that does not change says something, `optional` whether effects that use it
    do without where it is missing. The `title` is as in "the residual goes with the temperature"; a diagnosis does
    not look whether it does if empty. `use` is why the next experiment should record it, behind its name.
    """

    quantity: Quantity
    name: str = ""
    recognised: Callable[[str, FloatArray, Record], bool] | None = None
    cleaned: Callable[[FloatArray, Record], FloatArray] = lambda values, record: values
    shown_if_constant: bool = False
    optional: bool = False
    title: str = ""
    use: str = ""

    @property
    def key(self) -> str:
        """The name that effects know."""
        return self.name or self.quantity.column

    def takes(self, header: str, values: FloatArray, record: Record) -> bool:
        """Whether a column of a record is this one and shows something."""
        if not np.all(np.isfinite(values)) or (np.ptp(values) == 0 and not self.shown_if_constant):
            return False
        if self.recognised is None:
            return header in (self.key, self.quantity.column)
        return self.recognised(header, values, record)


# By the name that effects know, in the order of the files.
COLUMNS: dict[str, Column] = {}


def register(column: Column) -> Column:
    """Make a column known."""
    COLUMNS[column.key] = column
    return column


def columns_beside(record: Record) -> dict[str, FloatArray]:
    """Further columns of a record under the names that effects know, shape `(n,)` each, in their own units."""
    found: dict[str, FloatArray] = {}
    for header, values in record.extra.items():
        column = next((each for each in COLUMNS.values() if each.takes(header, values, record)), None)
        if column is not None and column.key not in found:
            unit = split_unit(header)[1]
            if unit in column.quantity.powers:
                values = column.quantity.convert(values, str(unit))
            found[column.key] = column.cleaned(values, record)
    return found
