"""Random models, and compiled functions that several test files share: compiling takes longer than all the rest."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _reference import interpolated

import microid as m

LEVELS, SAMPLES, PLACES = 7, 240, 24
TRACES: list[str] = []

# Programs that run for a millisecond are not worth optimising.
compiled = functools.partial(eqx.filter_jit, compiler_options={"xla_backend_optimization_level": 0})


def random_model(rng, levels=LEVELS):
    """A grid of random weights over a random range, no two alike."""
    lower_V, upper_V = rng.uniform(-30, 5), rng.uniform(60, 150)
    density = m.densities.GridDensity(rng.exponential(0.3, levels * (levels + 1) // 2), lower_V, upper_V)
    reversible = m.Reversible(rng.uniform(0.05, 0.4, levels), lower_V, upper_V)
    return m.Preisach(density, reversible, rng.normal(0, 5))


def without_a_cpu(monkeypatch):
    """Let models run as on an accelerator: what is traced from now on takes the other algorithms."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *operands, default, **_: default(*operands))


def limits_V(model):
    return float(model.density.lower_V), float(model.density.upper_V)


def densities_of(model):
    """The density and the slope of the reversible part as NumPy functions of voltages."""
    lower_V, upper_V = limits_V(model)
    nodes = np.asarray(model.density.nodes_um_per_V2())
    slopes = np.asarray(model.reversible.slope_um_per_V)
    levels_V = np.linspace(lower_V, upper_V, len(slopes))
    return lambda a, b: interpolated(nodes, lower_V, upper_V, a, b), lambda v: np.interp(v, levels_V, slopes)


def stroke_um(model):
    """Largest change of the output: all weights of a grid, and the integral of the reversible slope."""
    slopes = np.asarray(model.reversible.slope_um_per_V)
    return float(np.sum(model.density.packed_um) + np.mean((slopes[1:] + slopes[:-1]) / 2) * np.ptp(limits_V(model)))


def ends_um(model):
    """Smallest and largest displacement."""
    return float(model.offset_um), float(model.offset_um) + stroke_um(model)


def starts(model, **size):
    """Memories to begin with by name."""
    lower_V, upper_V = limits_V(model)
    return {
        "negative": m.negative_saturation(lower_V, **size),
        "positive": m.positive_saturation(lower_V, upper_V, **size),
        "demagnetised": m.demagnetised(lower_V, upper_V, **size),
    }


def linear_stage_of(plant, gain_um_per_V, offset_um):
    """A stage without hysteresis; a plant is a time constant in s, a natural frequency in Hz and a damping ratio."""
    time_constant_s, natural_frequency_Hz, damping_ratio = map(float, plant)
    return m.Stage.of(
        driver=m.Driver(time_constant_s),
        piezo=m.Piezo(gain_um_per_V, offset_um),
        mechanics=m.Mechanics(natural_frequency_Hz, damping_ratio),
    )


def flat(tree):
    """All numbers of a tree, shape `(k,)`."""
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])


def matrix(jacobian):
    """Derivatives of outputs of shape `(n,)` in all numbers of a tree, shape `(n, k)`."""
    return np.concatenate([np.reshape(leaf, (len(leaf), -1)) for leaf in jax.tree.leaves(jacobian)], axis=1)


@compiled
def respond(model, voltage_V, start):
    """Displacement, the memory along the record and the one at its end."""
    TRACES.append("respond")
    memory = m.remember(voltage_V, start)
    return model.respond(memory), memory, memory.end()


def play(model, voltage_V, start=None):
    """Displacement of up to `SAMPLES` voltages, and the memory at the end.

    Records are filled up to one length with their last voltage, which moves nothing, so that all share one program.
    """
    if start is None:
        start = m.negative_saturation(model.density.lower_V, PLACES)
    fill = SAMPLES - len(voltage_V)
    displacement_um, _, end = respond(model, jnp.asarray(np.pad(voltage_V, (0, fill), mode="edge")), start)
    return np.asarray(displacement_um)[: len(voltage_V)], end


@compiled
def _everett_um(model, high_V, low_V):
    return model.everett(high_V, low_V)


def lost_um(model, high_V, low_V):
    """The Everett surface at up to `SAMPLES` pairs of voltages."""
    high_V, low_V = np.broadcast_arrays(high_V, low_V)
    fill = (0, SAMPLES - len(high_V))
    return np.asarray(_everett_um(model, np.pad(high_V, fill), np.pad(low_V, fill)))[: len(high_V)]


def nested_voltages(rng, lower_V, upper_V, n):
    """Random reversals: jumps over the whole range, small moves and rests."""
    jumps = rng.uniform(lower_V, upper_V, n)
    walk = np.clip(
        rng.uniform(lower_V, upper_V) + rng.normal(0, (upper_V - lower_V) / 20, n).cumsum(), lower_V, upper_V
    )
    mixed = np.where(np.repeat(rng.uniform(size=n // 10 + 1), 10)[:n] < 0.5, jumps, walk)
    return np.where(rng.uniform(size=n) < 0.1, np.roll(mixed, 1), mixed)
