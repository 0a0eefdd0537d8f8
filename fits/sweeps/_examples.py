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

# Axes with values or with low, high and count are crossed, and the last one runs fastest; those with the same `zip`
# run together.
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

_CONTROL = (
    _HEAD
    + """\
kind = "control"
title = "A map of PID gains for a step of 5 um"
model = "nominal"         # a stage of common size, or a file that `microid fit` wrote
initial = "negative"      # memory before each row: negative, positive or demagnetised

[reference]               # what each loop is to follow, from rest at 0 V
shape = "step"            # step, sine, triangle, decay or chirp; or file = "reference.csv"
samples = 1000
interval_s = 5e-4         # also that of the controller
amplitude_um = 5.0
step_s = 0.0

# What does not vary. Every kind has gains, filter_s, lower_V and upper_V of a PID controller, and delay_samples. All
# but bp-pid have reference_weight and derivative_weight, and
#   bp-pid    learning_rate_per_um2, momentum, slope_um_per_V, scale_um, seed (of its first weights) and span,
#   cmac-pid  learning_rate, limit_V, lower_um, upper_um and fastest_um_per_s,
#   resonant  frequency_Hz, resonant_V_per_um_s and lead_deg of one resonator.
# Gains are not tuned. What else is left out is made as `microid control` does, for the stage and the reference stated
# here and not for those of a row: zip controller.frequency_Hz with reference.frequency_Hz where the latter varies.
# All may be axes but kind, delay_samples, span, lower_V, upper_V, lower_um, upper_um and fastest_um_per_s.
[controller]
kind = "pid"              # pid, bp-pid, cmac-pid or resonant
derivative_V_s_per_um = 0.0
delay_samples = 1         # by which readings are late

# Both axes have a count, so they are crossed: 32 x 32 rows. Rows whose loop is unstable where the hysteresis is
# steepest fail, and say so; of a controller that learns it is the loop before it learns that counts.
[[axis]]
parameter = "controller.integral_V_per_um_s"
low = 5.0
high = 500.0
count = 32
spacing = "log"

[[axis]]
parameter = "controller.proportional_V_per_um"
low = 0.0
high = 1.0
count = 32
"""
)

_SENSITIVITY = (
    _HEAD
    + """\
kind = "sensitivity"
title = "Gain, stroke and resonance as dimensions vary"
stage = "paper"           # the paper's, or a file that `microid sensitivity --write-stage` wrote
seed = 1

[sensitivity]
axes = ["x", "z"]         # some of x, y, z, alpha, beta, gamma

[design]
method = "latin_hypercube"
rows = 1000

[[axis]]
parameter = "geometry.t1_mm"
unit = "um"               # converted to mm
low = 700.0
high = 900.0

[[axis]]
parameter = "geometry.t2_mm"
low = 0.9
high = 1.1

[[axis]]
parameter = "geometry.alpha1_rad"
relative = true           # times the stage's own
low = 0.8
high = 1.2

[[axis]]
parameter = "material.youngs_modulus_GPa"
mean = 206.0
sd = 5.0
"""
)

_RECORDS = """\
# The records: simulated here with noise of a sensor. For your own, delete model, initial, [program], the axes and
# [design], and write: files = "data/*.csv", one row each, as `microid synth quickstart --out data` makes.
[records]
noise_um = 0.02

[program]
shape = "decay"           # a sine that decays to nothing, so that loops nest
samples = {samples}
interval_s = {interval}
offset_V = 60.0
amplitude_V = 60.0
frequency_Hz = {frequency}
"""

_FIT = (
    _HEAD
    + """\
kind = "fit"
title = "How well loops are identified under noise"
seed = 1                  # of the noise and of what is drawn
model = "nominal"
initial = "negative"

# All but method, samples and weights may be axes: parameter = "fit.levels" with values = [6, 8, 12], or "fit.initial"
# with values = ["unknown", "negative"]. Each block of a batch is fitted on every number of levels there is in it, so
# put the axis of the levels first, where it runs slowest.
[fit]
method = "batch"          # all rows of a block at once on one grid; one_by_one is `microid fit` for each
levels = 8
# initial = "unknown"     # or negative, positive, demagnetised; left out: that of what is simulated, unknown of files
smoothness = 0.01         # of a batch; one_by_one finds it from the data
holdout = 0.2
weights = false           # true keeps the weights of every row, where the levels do not vary

"""
    + _RECORDS.format(samples=400, interval=0.02, frequency=0.8)
    + """
[design]
method = "sobol"
rows = 1024

[[axis]]
parameter = "hysteresis.density.packed_um"
relative = true           # an array: all its weights times this factor
low = 0.6
high = 1.4

[[axis]]
parameter = "records.noise_um"
low = 0.005
high = 0.1
spacing = "log"
"""
)

_DIAGNOSE = (
    _HEAD
    + """\
# Each row takes a minute or more: run it with --cluster, or with fewer rows first. Runs as smooth as these do not
# show the stage's dynamics to the plain fit, and their lag is what is named.
kind = "diagnose"
title = "What is named in runs that are too smooth to show the dynamics"
seed = 1
model = "nominal"
initial = "negative"

[diagnose]                # each may be an axis
false_alarm = 0.01
holdout = 0.2
# initial = "unknown"     # or negative, positive, demagnetised; left out: that of what is simulated, unknown of files

"""
    + _RECORDS.format(samples=2000, interval=0.001, frequency=5.0)
    + """
[design]
method = "random"
rows = 1000

[[axis]]
parameter = "records.noise_um"
low = 0.005
high = 0.05
spacing = "log"

[[axis]]
parameter = "mechanics.natural_frequency_Hz"
low = 100.0
high = 300.0
"""
)

EXAMPLES = {
    "simulate": _SIMULATE,
    "sensitivity": _SENSITIVITY,
    "fit": _FIT,
    "diagnose": _DIAGNOSE,
    "control": _CONTROL,
}
