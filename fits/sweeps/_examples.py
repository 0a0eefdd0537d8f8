"""Examples of sweeps, one of each kind, that run as they are."""

_HEAD = """\
# A sweep for `microid sweep FILE.toml --out DIR`. Names end in their units; every key below may be left out but
# schema, kind and one axis.
schema = "microid.sweep/1"
"""

_SIMULATE = (
    _HEAD
    + """\
kind = "simulate"
title = "How the stage answers a sine as its mechanics and the drive vary"
seed = 1                  # of what is drawn below
model = "nominal"         # a stage of common size, or a file that `microid fit` wrote
initial = "negative"      # memory before each row: negative, positive or demagnetised

[program]                 # the voltage of each row
shape = "sine"            # sine, triangle, decay, chirp, step; or file = "program.csv" with time_s and voltage_V
samples = 1000
interval_s = 2e-4
offset_V = 60.0
amplitude_V = 40.0
frequency_Hz = 20.0

[outputs]
from_s = 0.05             # figures count from here on
traces = false            # true keeps the displacement over time, at every `every` samples

# Axes with values or with low, high and count are crossed; those with the same `zip` run together.
[[axis]]
parameter = "program.amplitude_V"
values = [10.0, 20.0, 40.0, 60.0]

# Axes without a count are drawn together, as [design] says: random, latin_hypercube or sobol.
[design]
method = "sobol"
rows = 256

[[axis]]
parameter = "mechanics.natural_frequency_Hz"
unit = "Hz"               # kHz would be converted; a unit that does not fit is refused
low = 100.0
high = 400.0
spacing = "log"

[[axis]]
parameter = "mechanics.damping_ratio"
low = 0.01
high = 0.1

[[axis]]
parameter = "hysteresis.density.packed_um"
relative = true           # all weights times this factor: loops of other widths
mean = 1.0
sd = 0.1

[run]
memory_MB = 256           # what a chunk may take
"""
)

EXAMPLES = {"simulate": _SIMULATE}
