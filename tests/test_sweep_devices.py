"""Sweeps on several local devices, for which CPUs stand in."""

import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from _command import OFF
from _sweeps import parsed, small

from fits.sweeps._run import run_sweep

# Five blocks in two chunks, of which four are in the first: neither two nor three devices divide them.
_DESIGN = """
seed = {seed}
[design]
method = "random"
rows = {rows}
[run]
chunk_rows = {chunk}
"""
_HEAD = 'schema = "microid.sweep/1"\nkind = "{kind}"'
_LARGE, _SMALL = {"rows": 1100, "chunk": 1024}, {"rows": 140, "chunk": 128}
_CONTROL = """
[reference]
shape = "step"
samples = 40
interval_s = 1e-3
amplitude_um = 5.0
[[axis]]
parameter = "controller.integral_V_per_um_s"
low = 10.0
high = 400.0
"""
_SENSITIVITY = """
[sensitivity]
axes = ["x"]
[[axis]]
parameter = "geometry.t1_mm"
relative = true
low = 0.8
high = 1.2
"""
_FIT = """
[fit]
levels = 6
weights = true
[program]
shape = "decay"
samples = 120
interval_s = 0.05
offset_V = 60.0
amplitude_V = 60.0
frequency_Hz = 0.8
[[axis]]
parameter = "hysteresis.density.packed_um"
relative = true
low = 0.7
high = 1.3
[[axis]]
parameter = "records.noise_um"
low = 0.0
high = 0.1
"""

# Runs each sweep of a folder, and says by how many rows the first chunk of the simulations grew each time.
_RUN = """
import sys
from pathlib import Path
import jax
jax.config.update("jax_enable_x64", True)
from fits.sweeps._spec import compute_chunk
from fits.sweeps._run import run_sweep
from fits.sweeps._spec import read_sweep
folder = Path(sys.argv[1])
for file in sorted(folder.glob("*.toml")):
    run_sweep(read_sweep(file), str(folder / file.stem))
told = []
compute_chunk(read_sweep(folder / "simulate.toml"), 0, told.append)
print(*told)
"""

# Responds on two devices, and to the second half alone.
_SHARDED = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec
from fits.sweeps._devices import place
from fits.sweeps._stages import memory_before, nominal_stage, respond

stage, first, second = nominal_stage(), *jax.local_devices()
frequency_Hz, voltage_V = np.linspace(80, 160, 8), np.linspace(0, 100, 8 * 40).reshape(8, 40)

def moved(rows, voltage):
    values, memory = {"mechanics.natural_frequency_Hz": rows}, memory_before(stage, "negative")
    return respond(stage, values, (), jnp.asarray(1e-3), voltage, memory)

found = moved(place(frequency_Hz), place(voltage_V))
assert found.sharding.spec == PartitionSpec("rows"), found.sharding
places = {shard.device: shard.index[0] for shard in found.addressable_shards}
assert places == {first: slice(0, 4), second: slice(4, 8)}
assert {shard.data.shape for shard in found.addressable_shards} == {(4, 40)}
alone = moved(jnp.asarray(frequency_Hz[4:]), jnp.asarray(voltage_V[4:]))
assert alone.devices() == {first}
np.testing.assert_array_equal(found[4:], alone)
# What cannot be shared evenly stays on one device.
assert place(np.zeros((3, 2))).devices() == {first}
"""


def on_devices(count, script, *arguments):
    flags = {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={count}"}
    command = [sys.executable, "-c", script, *map(str, arguments)]
    root = Path(__file__).parents[1]
    done = subprocess.run(
        command, cwd=root, env=os.environ | OFF | flags, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def texts(seed):
    """A sweep of each kind whose rows are computed together."""

    def text(kind, body, size):
        return _HEAD.format(kind=kind) + _DESIGN.format(seed=seed, **size) + body

    return {
        "simulate": small(seed, **_LARGE),
        "control": text("control", _CONTROL, _LARGE),
        "sensitivity": text("sensitivity", _SENSITIVITY, _LARGE),
        "fit": text("fit", _FIT, _SMALL),
    }


@pytest.mark.parametrize(
    ("devices", "told", "kinds"),
    [
        (2, "512 512", ["simulate"]),
        pytest.param(3, "768 256", ["simulate", "control", "sensitivity", "fit"], marks=pytest.mark.study),
    ],
)
@pytest.mark.study
def test_several_devices_give_the_same_bits(tmp_path, seed, devices, told, kinds):
    chosen = {kind: text for kind, text in texts(seed).items() if kind in kinds}
    for kind, text in chosen.items():
        (tmp_path / f"{kind}.toml").write_text(text)
    assert on_devices(devices, _RUN, tmp_path).strip() == told
    for kind, text in chosen.items():
        run_sweep(parsed(text), str(tmp_path / "alone" / kind))
        here, there = (pd.read_parquet(tmp_path / place / kind / "results.parquet") for place in ("alone", "."))
        pd.testing.assert_frame_equal(here, there, check_exact=True)
        assert (here["status"] == 1).sum() > len(here) / 2


@pytest.mark.study
def test_rows_are_sharded_over_the_devices():
    on_devices(2, _SHARDED)
