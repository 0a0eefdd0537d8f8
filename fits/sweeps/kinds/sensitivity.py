"""The job `sensitivity`: gains, strokes and resonances of a stage of other dimensions, and what its tolerances do."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Annotated, TypeVar

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import Array, Float
from msgspec import Meta

import microid as m
from fits.io._errors import DataError, shown
from fits.io._typed import typed
from fits.machining._design import LARGEST_ANGLE_RAD, Design, paper_design
from fits.machining._design_file import read_design
from fits.machining._sensitivity import SHORT_um
from fits.sweeps._devices import by_rows, place
from fits.sweeps._types import AbstractJob, Block, Facts, Output, Parameter, Request, Rows, in_a_file
from microid import kinetostatics as ks

_Tree = TypeVar("_Tree", ks.Geometry, ks.Actuation)
KEYS = ("stage", "sensitivity")


class _Options(msgspec.Struct):
    """The table `[sensitivity]`."""

    axes: Annotated[
        tuple[ks.Axis, ...],
        Meta(min_length=1, description=f"some of {', '.join(ks.AXES)} in a list"),
    ] = (
        "x",
        "z",
    )


@dataclasses.dataclass(frozen=True, eq=False)
class SensitivityJob(AbstractJob):
    """Some axes of a stage as its dimensions vary."""

    design: Design
    axes: tuple[ks.Axis, ...]

    @property
    def facts(self) -> Facts:
        """What is known before it runs."""
        outputs = []
        for axis in self.axes:
            unit = ks.MOTIONS[axis].unit
            outputs += [
                Output(f"{axis}_gain_{unit}_per_um", f"{unit}/um", f"{axis} per elongation of the piezo"),
                Output(f"{axis}_stroke_{unit}", unit, f"{axis} at the highest voltage"),
                Output(f"{axis}_resonance_Hz", "Hz", f"first resonance of {axis}"),
                Output(f"{axis}_spread_pct", "%", f"root sum of squares of what the tolerances do to {axis}"),
            ]
        parameters = []
        for name, each in ks.DIMENSIONS.items():
            upper, size = LARGEST_ANGLE_RAD if each.unit == "rad" else math.inf, float(self.design.geometry[name])
            parameters.append(Parameter(f"geometry.{each.field}", each.unit, size, 1e-9, upper))
        for info in m.parameter_table(self.design.actuation):
            value = float(getattr(self.design.actuation, info.path))
            parameters.append(Parameter(f"actuation.{info.path}", info.spec.unit, value, 1e-9))
        modulus_GPa, guides = float(self.design.youngs_modulus_GPa), float(self.design.guides)
        parameters.append(Parameter("material.youngs_modulus_GPa", "GPa", modulus_GPa, 1e-9))
        parameters.append(Parameter("material.guides", "1", guides, 0.0))
        return Facts(tuple(parameters), tuple(outputs), block=256)

    def compute(self, block: Block) -> Rows:
        """Evaluate a block of stages on each device; see `AbstractJob.compute`."""
        design, values = self.design, place(block.values)
        material = jnp.asarray(design.youngs_modulus_GPa), jnp.asarray(design.guides)
        stage, known = (design.geometry, design.actuation, material), [output.name for output in self.facts.outputs]
        found: list[np.ndarray] = []
        for axis in self.axes:
            names = ks.MOTIONS[axis].dimensions
            tolerance = jnp.asarray([design.tolerance[name] for name in names])
            together = jnp.asarray(design.correlation(names))
            found += _evaluate(*stage, values, tolerance, together, block.relative, axis, design.level)
        outputs = {name: np.asarray(value) for name, value in zip(known, found, strict=True)}
        good = np.all([np.isfinite(value) for value in outputs.values()], axis=0)
        reasons = tuple("" if each else "no finite number comes out: such a stage cannot be built" for each in good)
        return Rows(outputs, reasons)


def make(request: Request) -> SensitivityJob:
    """Make the job that a sweep asks for; a `DataError` says what is wrong with it."""
    name = request.table.get("stage", "paper")
    if not isinstance(name, str):
        raise DataError(f'stage: expected "paper" or the name of the TOML of a stage, found {shown(name)}; give one.')
    design = paper_design() if name == "paper" else in_a_file(request.load(name), name, read_design)
    axes = typed(request.table.get("sensitivity", {}), _Options, "sensitivity").axes
    return SensitivityJob(design, tuple(dict.fromkeys(axes)))


@by_rows("values")
def _evaluate(
    geometry: ks.Geometry,
    actuation: ks.Actuation,
    material: tuple[Float[Array, ""], Float[Array, ""]],
    values: Mapping[str, Float[Array, " n"]],
    tolerance: Float[Array, " d"],
    together: Float[Array, "d d"],
    relative: tuple[str, ...],
    axis: ks.Axis,
    level: int,
) -> tuple[Float[Array, " n"], ...]:
    def set_in(tree: _Tree, start: str, values: Mapping[str, Array]) -> _Tree:
        own = {name.removeprefix(f"{start}."): name for name in values if name.startswith(f"{start}.")}
        new = {f: getattr(tree, f) * values[name] if name in relative else values[name] for f, name in own.items()}
        return dataclasses.replace(tree, **new) if new else tree

    def one(values: Mapping[str, Array]) -> tuple[Float[Array, ""], ...]:
        changed, piezos = set_in(geometry, "geometry", values), set_in(actuation, "actuation", values)
        modulus, guides = (
            nominal * values[name] if name in relative else values.get(name, nominal)
            for name, nominal in zip(("material.youngs_modulus_GPa", "material.guides"), material, strict=True)
        )
        constants = ks.constants_of(changed, level, 1e3 * modulus, guides)
        stage = ks.stage_constants(axis, changed, constants, piezos)
        slopes = ks.sensitivity(axis, changed, jnp.asarray(SHORT_um), constants).dimensions
        dimensions = ks.MOTIONS[axis].dimensions
        changes = jnp.stack([slopes[name] for name in dimensions]) / SHORT_um * tolerance / stage.gain
        spread = 100 * jnp.sqrt(jnp.maximum(changes @ together @ changes, 0))
        return stage.gain, stage.stroke, stage.resonance_Hz, spread

    return jax.vmap(one)(values)
