"""Rows for sweeps: many simulations against loops, and many small fits against one by one."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _peers import numpy_relays
from _timing import Table, side_by_side
from scipy.signal import StateSpace, lsim

import fits
from fits.sweeps._records import Simulated
from fits.sweeps._spec import parse_sweep
from fits.sweeps._stages import Program, nominal_stage, read_program, varied
from fits.sweeps._types import Block
from fits.sweeps.kinds.simulate import SimulateJob, summary
from microid import Preisach, Stage

_INTERVAL_s = 1e-4
_RELAYS = 100
_NAMES = (
    "mechanics.natural_frequency_Hz",
    "mechanics.damping_ratio",
    "driver.time_constant_s",
    "program.amplitude_V",
    "program.frequency_Hz",
)
_ENDS = ((100.0, 400.0), (0.01, 0.1), (5e-4, 2e-3), (10.0, 50.0), (5.0, 50.0))
_SINGLES = 50

_FIT = """
schema = "microid.sweep/1"
kind = "fit"
seed = {seed}
[fit]
levels = 8
[records]
noise_um = 0.02
[program]
shape = "decay"
samples = 400
interval_s = 0.02
offset_V = 60.0
amplitude_V = 60.0
frequency_Hz = 0.8
[design]
method = "random"
rows = 1000
[[axis]]
parameter = "hysteresis.density.packed_um"
relative = true
low = 0.6
high = 1.4
"""


@eqx.filter_jit
def _single(stage: Stage, program: Program, row: jax.Array) -> dict[str, jax.Array]:
    values = dict(zip(_NAMES, row, strict=True))
    voltage = program.signal(values, None)
    return summary(voltage, varied(stage, values, ())(jnp.asarray(_INTERVAL_s), voltage))


def _numpy(stage: Stage, weight_um: np.ndarray, centre_V: np.ndarray, row: np.ndarray, samples: int) -> np.ndarray:
    """One stage with `lsim` and a loop of relays."""
    frequency_Hz, damping, tau_s, amplitude_V, drive_Hz = row
    time_s = np.arange(samples) * _INTERVAL_s
    voltage_V = 60 + amplitude_V * np.sin(2 * np.pi * drive_Hz * time_s)
    driver = StateSpace([[-1 / tau_s]], [[1 / tau_s]], [[1.0]], [[0.0]])
    driven_V = lsim(driver, voltage_V, time_s, X0=[voltage_V[0]])[1]
    hysteresis = stage["hysteresis"]
    assert isinstance(hysteresis, Preisach)
    loaded_um = numpy_relays(weight_um, centre_V, driven_V) + 0.1 * driven_V
    rate = 2 * np.pi * frequency_Hz
    plant = StateSpace([[0, 1], [-(rate**2), -2 * damping * rate]], [[0], [rate**2]], [[1, 0]], [[0]])
    moved_um: np.ndarray = lsim(plant, loaded_um, time_s, X0=[loaded_um[0], 0])[1]
    return moved_um


def sweep(samples: int, repeats: int, seed: int, table: Table) -> None:
    """Simulate a full stage many times, and fit many small loops."""
    rng, stage = np.random.default_rng(seed), nominal_stage()
    text = {"shape": "sine", "samples": samples, "interval_s": _INTERVAL_s, "offset_V": 60.0}
    program = read_program(text, "program", "V", lambda _: b"")
    job = SimulateJob(stage, program, "negative")
    count = job.facts.block
    values = {name: rng.uniform(*ends, count) for name, ends in zip(_NAMES, _ENDS, strict=True)}
    block = Block(values, (), np.arange(count), np.zeros(count, dtype=np.int64), 0)
    table_of = np.stack([values[name] for name in _NAMES], axis=1)
    centre_V = 1.2 * (np.arange(_RELAYS) + 0.5)
    hysteresis = stage["hysteresis"]
    assert isinstance(hysteresis, Preisach)
    weight_um = np.asarray(hysteresis.density(*np.meshgrid(centre_V, centre_V, indexing="ij"))) * 1.2**2
    weight_um = np.tril(weight_um) - np.diag(np.diag(weight_um)) / 2
    found = job.compute(block).outputs["displacement_final_um"][0]
    peer = _numpy(stage, weight_um, centre_V, table_of[0], samples)
    off = abs(found - peer[-1]) / np.ptp(peer)

    def ours() -> Any:
        return job.compute(block).outputs

    def singles() -> Any:
        return [jax.block_until_ready(_single(stage, program, row)) for row in jnp.asarray(table_of[:_SINGLES])]

    taken = side_by_side(
        {"ours": ours, "jit": singles, "numpy": lambda: _numpy(stage, weight_um, centre_V, table_of[0], samples)},
        repeats,
    )
    ours_per_row = [value / count for value in taken["ours"]]
    case = f"simulations of a stage, {samples} samples, CPU seconds a row"
    jit = [value / _SINGLES for value in taken["jit"]]
    table.ratio(f"{case}, over a loop of jitted runs", "5x (20x)", jit, ours_per_row)
    note = f"{100 * off:.2g} % of the stroke apart"
    table.ratio(f"{case}, over lsim and relays", "100x (1000x)", taken["numpy"], ours_per_row, note=note)
    _fits(repeats, seed, table)


def _fits(repeats: int, seed: int, table: Table) -> None:
    plan = parse_sweep(_FIT.format(seed=seed), "sweep.toml", lambda _: b"")
    count = plan.facts.block
    rows = np.arange(count)
    relative = ("hysteresis.density.packed_um",)
    block = Block(plan.plan.values(rows), relative, rows, np.zeros(count, dtype=np.int64), seed)
    source = plan.job.records  # type: ignore[attr-defined]
    assert isinstance(source, Simulated)
    records = [record for record in source.records(block) if not isinstance(record, str)]
    few = records[:4]
    taken = side_by_side(
        {
            "batch": lambda: plan.job.compute(block).outputs,
            "alone": lambda: [fits.fit([record], levels=8, initial="negative").noise_um for record in few],
        },
        repeats,
    )
    batch, alone = [value / count for value in taken["batch"]], [value / len(few) for value in taken["alone"]]
    note = "400 samples, N = 8; one by one also finds the smoothness and cross-validates"
    table.ratio("small loop fits in a batch, over one by one, warm", "5x (30x)", alone, batch, note=note)
