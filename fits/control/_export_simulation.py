"""A stage with hysteresis inside its mechanics as C: its simulation, one sample at a time."""

import dataclasses
import math
import os
from collections.abc import Sequence
from functools import reduce
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import microid as m
from fits.control._export_c import TEMPLATES, controller_texts, filled, lines_of, require_name, write_texts
from fits.io._errors import DataError
from fits.io._version import written_by


def export_simulation_c(
    stage: m.Stage, folder: str | os.PathLike[str], name: str, interval_s: float, *, size: int = 128
) -> list[Path]:
    """Write a header and a source in C99 that simulate `stage`, sample by sample at one interval.

    The stage is one of linear parts around a `HystereticMechanics`; each interval is divided as the stage says. A
    command in steps runs in steps, any other in lines. The C needs `<math.h>` and allocates nothing. The paths of
    `name.h` and `name.c` come back, and those of `export_c` for the law, as `name_law`, where that is a `Preisach`;
    then `size` extremes are remembered.

    A `DataError` says that the stage has other parts, the name is not one in C, or a file cannot be written.
    """
    require_name(name)
    if not 0 < interval_s < math.inf:
        raise DataError(f"expected a positive interval between samples, found {interval_s:g} s.")
    place = next((n for n, part in enumerate(stage.parts) if isinstance(part, m.HystereticMechanics)), 0)
    part = stage.parts[place]
    if not isinstance(part, m.HystereticMechanics):
        raise DataError("expected a stage with hysteresis inside its mechanics; use export_c.", of_model=True)
    law = f"laws/{type(part.law).__name__}.c"
    around = [its for its in stage.parts if its is not part and not isinstance(its, m.AbstractLinear)]
    for other in around or ([] if (TEMPLATES / law).is_file() else [part.law]):
        raise DataError(f"a {type(other).__name__} has no form in C here; leave it out.", of_model=True)
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(stage)):
        raise DataError("the model holds numbers that are not finite; fit it again.", of_model=True)
    held = stage.hold == "zero"
    fields = {
        "name": name,
        "NAME": name.upper(),
        "provenance": f"Written by {written_by()}; do not edit, export again.",
        "interval_s": repr(float(interval_s)),
        "steps": str(stage.substeps),
        "runs": "steps" if held else "lines",
        "share": "((n == STEPS) ? 1.0 : 0.0)" if held else "((double)n / (double)STEPS)",
    }
    step_s = jnp.asarray(interval_s / stage.substeps)
    linear: list[Any] = list(stage.parts)
    fields |= _linear(linear[:place], part.inner, linear[place + 1 :], step_s, held)
    if isinstance(part.law, m.Preisach):
        fields |= {"include": f'\n#include "{name}_law.h"\n', "memory": f"typedef {name}_law_state {name}_memory;"}
        texts, constants = controller_texts(part.law, f"{name}_law", size), ""
    else:
        constants, count = _constants(part.law)
        fields |= {"include": "", "memory": f"typedef struct {{\n    double x[{count}];\n}} {name}_memory;"}
        texts = {}
    fields["law"] = constants + filled(law, fields)
    own = {f"{name}.{ending}": filled(f"simulation.{ending}", fields) for ending in ("h", "c")}
    return write_texts(folder, own | texts)


def _constants(law: m.AbstractHysteresis) -> tuple[str, int]:
    """Parameters of a law in C, each named after its field, and how many numbers it remembers."""
    lines, count = [], 0
    for field in dataclasses.fields(law):
        value = getattr(law, field.name)
        if np.ndim(value) == 0:
            lines.append(f"#define LAW_{field.name} ({value if isinstance(value, int) else float(value)!r})")
        else:
            count = len(value)
            lines.append(f"static const double LAW_{field.name}[{count}] = {{\n{lines_of(value, 4)}\n}};")
    return "\n".join([*lines, *([f"#define LAW_COUNT ({count})"] if count else []), "", ""]), count or 2


# As one program: one operation after the other they would be compiled each by itself.
@eqx.filter_jit
def _systems(
    before: Sequence[m.AbstractLinear],
    inner: m.Mechanics,
    after: Sequence[m.AbstractLinear],
    step_s: Float[Array, ""],
    held: bool,
) -> tuple[m.LinearSystem, m.LinearSystem, m.LinearSystem, tuple[Array, Array], Array]:
    """From the command to the reading and to the mass, from the force to the reading; what a step makes of states."""

    def joined(parts: Sequence[m.AbstractLinear]) -> m.LinearSystem:
        return reduce(m.LinearSystem.then, (part.system() for part in parts), m.Sensor(jnp.ones(())).system())

    ahead, own, behind = joined(before), inner.system(), joined(after)
    mass, push = ahead.then(own), own.then(behind)
    whole = mass.then(behind)
    # A force takes from what goes into the mechanics, and leaves what is ahead of them alone.
    rest = jnp.concatenate([jnp.zeros(ahead.order), -push.rest])
    forced = m.LinearSystem(whole.rate_per_s, rest, whole.read, -push.gain, jnp.zeros(()))
    keep, taken = whole.advance(step_s[None], "zero" if held else "first")
    return whole, mass, forced, (keep[..., 0], taken[:, 0]), forced.advance(step_s[None], "first")[1][:, 0]


def _linear(
    before: Sequence[m.AbstractLinear],
    inner: m.Mechanics,
    after: Sequence[m.AbstractLinear],
    step_s: Float[Array, ""],
    held: bool,
) -> dict[str, str]:
    """The linear parts in numbers."""
    whole, mass, forced, (keep, taken), pushed = _systems(before, inner, after, step_s, held)
    rows = [f"    {{\n{lines_of(row, 8)}\n    }}," for row in np.asarray(keep)]
    numbers = {
        "mass_gain": inner.gain,
        "mass_offset_um": mass.offset,
        "mass_per_V": mass.gain,
        "offset_um": whole.offset,
        "per_V": whole.gain,
        "force_gain": -forced.gain,
    }
    columns = {
        "command": -taken,
        "force": -pushed,
        "mass": jnp.pad(mass.read, (0, whole.order - mass.order)),
        "reading": whole.read,
        "rest": whole.rest,
    }
    return (
        {"order": str(whole.order), "keep": "\n".join(rows)}
        | {name: repr(float(value)) for name, value in numbers.items()}
        | {name: lines_of(np.asarray(column), 4) for name, column in columns.items()}
    )
