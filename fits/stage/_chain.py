"""A stage in the coordinates of its fit, beside the columns of its hysteresis."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.loop._design import Grid
from fits.stage._run import place_of_hysteresis
from microid import Coordinates, ParameterInfo, Stage


def offsets_out(stage: Stage, grid: bool) -> Coordinates[Stage]:
    """Coordinates of what is free but for offsets and the `grid`'s own; a `ValueError` where nothing is left."""
    place = place_of_hysteresis(stage)
    name = None if place is None or not grid else stage.names[place]

    def moves(info: ParameterInfo) -> bool:
        path = stage.named(info.path)
        return stage.free(info) and not path.endswith("offset_um") and path.partition(".")[0] != name

    return Coordinates(stage, moves)


class Chain(eqx.Module):
    """A stage in the coordinates of its fit; the grid and its place are None where no grid is fitted."""

    coordinates: Coordinates[Stage]
    place: int | None = eqx.field(static=True)
    grid: Grid | None

    @classmethod
    def of(cls, stage: Stage, grid: Grid | None) -> "Chain":
        """Coordinates of a stage whose hysteresis is fitted on a grid, if there is one."""
        place = None if grid is None else place_of_hysteresis(stage)
        return cls(offsets_out(stage, grid is not None), place, grid)

    @property
    def size(self) -> int:
        """Number of columns, `D`."""
        return 0 if self.grid is None else self.grid.columns

    @property
    def levels(self) -> int:
        return 0 if self.grid is None else self.grid.levels

    def stage(self, z: Float[Array, " p"], columns_um: Float[Array, " D"] | None) -> Stage:
        """The stage with these coordinates and columns, and no offset; without columns, with those that it has."""
        stage = self.coordinates(z)
        if self.grid is None or self.place is None or columns_um is None:
            return stage
        return stage.swap(stage.names[self.place], self.grid.model(columns_um, jnp.zeros(())))

    def parameters(self, z: np.ndarray) -> tuple[list[tuple[str, str]], np.ndarray, np.ndarray]:
        """Names and units of the parameters outside the grid, values, and derivatives by their own coordinates."""
        point = jnp.asarray(z)
        stage = self.coordinates(point)
        named = [
            (stage.named(info.path) + ("" if info.shape == () else str(list(place))), info.spec.unit)
            for info in self.coordinates.table
            for place in np.ndindex(info.shape)
        ]
        value, slope = jax.jvp(self.coordinates.values, (point,), (jnp.ones_like(point),))
        return named, np.asarray(value), np.asarray(slope)
