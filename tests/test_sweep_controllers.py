"""Controllers of every kind in a sweep, each row against the same controller in a loop by itself."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _command import refused, run
from _sweeps import parsed

import fits
from fits.control._gains import GAINS
from fits.control._period import strongest_Hz
from fits.io._record import Reference
from fits.sweeps._spec import chunk_count, compute_chunk
from fits.sweeps._stages import memory_before, nominal_stage, varied
from microid import Start
from microid.control import BPPID, CMACPID, PID, ResonantPID, margins, simulate_loop

HEAD = """
schema = "microid.sweep/1"
kind = "control"
[reference]
shape = "sine"
samples = 120
interval_s = 5e-4
offset_um = 4.0
amplitude_um = 3.0
frequency_Hz = 25.0
[controller]
kind = "{kind}"
delay_samples = 1
{stated}
"""
INTERVAL_s, DELAY = 5e-4, 1
LIMITS = {"lower_V": 0.0, "upper_V": 120.0}
# Of each kind: what is stated, and ranges of what varies from row to row.
CASES = {
    "pid": ("", {"integral_V_per_um_s": (20, 80), "reference_weight": (0, 1)}),
    "bp-pid": (
        "derivative_V_s_per_um = 2e-5\nspan = 2.0",
        {
            "proportional_V_per_um": (0.05, 0.1),
            "integral_V_per_um_s": (20, 60),
            "learning_rate_per_um2": (0.05, 0.5),
            "momentum": (0, 0.5),
            "seed": (0, 99),
        },
    ),
    "cmac-pid": ("proportional_V_per_um = 0.05", {"integral_V_per_um_s": (20, 60), "learning_rate": (0.1, 1)}),
    "resonant": ("integral_V_per_um_s = 40", {"frequency_Hz": (20, 30), "proportional_V_per_um": (0, 0.1)}),
}
STAGE = {"mechanics.natural_frequency_Hz": (150, 250)}


def axes(values):
    return "".join(
        f'[[axis]]\nparameter = "{name}"\nvalues = {np.asarray(each).tolist()}\nzip = "a"\n'
        for name, each in values.items()
    )


def drawn(kind, rng, rows):
    ranges = {f"controller.{name}": ends for name, ends in CASES[kind][1].items()} | STAGE
    values = {name: rng.uniform(*ends, rows) for name, ends in ranges.items()}
    return {name: np.round(each) if name == "controller.seed" else each for name, each in values.items()}


def by_hand(kind, stage, given, wanted_um):
    """The controller of a row, from `microid` and from what `microid control` would take for it."""
    gains = (jnp.asarray(given.get(name, default)) for name, default in zip(GAINS, (0.0, 100.0, 0.0), strict=True))
    pid = PID(*gains, INTERVAL_s, reference_weight=given.get("reference_weight", 1.0), **LIMITS)
    slope = fits.steepest_slope(stage)
    if kind == "pid":
        return pid
    if kind == "resonant":
        frequency = given["frequency_Hz"]
        return ResonantPID.around(
            pid, stage, jnp.asarray([frequency]), frequency / 3, delay=DELAY, slope_um_per_V=jnp.asarray(slope)
        )
    # From rest under 0 V, where the nominal stage stands at 0 um, to the crest of the reference.
    low, high = min(0.0, wanted_um.min()), wanted_um.max()
    if kind == "bp-pid":
        more = {name: given[name] for name in ("learning_rate_per_um2", "momentum")}
        key = jax.random.key(int(given["seed"]))
        return BPPID.around(
            pid, key, 2.0, slope_um_per_V=float(stage.static_gain) * slope, scale_um=(high - low) / 10, **more
        )
    steps = np.abs(np.diff(wanted_um, prepend=0.0)).max() / INTERVAL_s
    reference = Reference(np.arange(len(wanted_um)) * INTERVAL_s, wanted_um, "")
    static = fits.compensate(stage, reference, clip=True).voltage_V
    aside = 0.02 * (high - low)
    numbers = low - aside, high + aside, 1.02 * steps, given["learning_rate"], 0.5 * static.max()
    return CMACPID(pid, *map(jnp.asarray, numbers))


def stated_of(kind):
    return {name: float(value) for name, value in (line.split(" = ") for line in CASES[kind][0].splitlines())}


# Those that learn take a while to compile.
KINDS = ["pid", *(pytest.param(kind, marks=pytest.mark.study) for kind in ("resonant", "bp-pid", "cmac-pid"))]


@pytest.mark.parametrize("kind", KINDS)
def test_rows_agree_with_loops_by_themselves(kind, rng):
    nominal, values = nominal_stage(), drawn(kind, rng, 3)
    found = compute_chunk(parsed(HEAD.format(kind=kind, stated=CASES[kind][0]) + axes(values)), 0)
    wanted = 4.0 + 3.0 * np.sin(2 * np.pi * 25 * np.arange(120) * INTERVAL_s)
    start = Start(None, memory_before(nominal, "negative"))
    for row in range(3):
        own = {name: each[row] for name, each in values.items()}
        given = stated_of(kind) | {name.removeprefix("controller."): each for name, each in own.items()}
        controller = by_hand(kind, nominal, given, wanted)
        stage = varied(nominal, {name: jnp.asarray(own[name]) for name in STAGE}, ())
        alone = eqx.filter_jit(simulate_loop)(controller, stage, jnp.asarray(wanted), delay=DELAY, start=start)
        error = np.asarray(alone.error_um)
        assert found.reasons[row] == ""
        assert found.outputs["error_rms_um"][row] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-10)
        assert found.outputs["error_final_um"][row] == pytest.approx(error[-1], rel=1e-10, abs=1e-10)
        assert found.outputs["command_max_V"][row] == pytest.approx(float(alone.command_V.max()), rel=1e-10)
        linear = controller if kind in ("pid", "resonant") else getattr(controller, "pid", None)
        if kind == "bp-pid":
            linear = controller.pid(controller.init())
        slope = jnp.asarray(fits.steepest_slope(stage))
        radius = float(margins(linear, stage, delay=DELAY, slope_um_per_V=slope).radius)
        # The slope of a sweep is looked at on fewer voltages.
        assert found.outputs["pole_radius"][row] == pytest.approx(radius, rel=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_rows_do_not_depend_on_chunks(kind, rng):
    text = HEAD.format(kind=kind, stated=CASES[kind][0]) + axes(drawn(kind, rng, 520))
    small, large = (parsed(f"{text}[run]\nchunk_rows = {rows}\n") for rows in (256, 1024))
    assert (chunk_count(small), chunk_count(large)) == (3, 1)
    parts, whole = [compute_chunk(small, chunk) for chunk in range(3)], compute_chunk(large, 0)
    assert set(whole.reasons) == {""}
    for name, values in whole.outputs.items():
        assert np.array_equal(np.concatenate([part.outputs[name] for part in parts]), values, equal_nan=True)


TABLE = 'schema = "microid.sweep/1"\nkind = "control"\n[controller]\nkind = "{kind}"\n{stated}\n'
STEP = 'shape = "step"\nsamples = 40\ninterval_s = 1e-3\namplitude_um = 5.0'


def made(
    kind, stated="", reference="", axis='parameter = "controller.integral_V_per_um_s"\nvalues = [50.0]', **files
):
    return parsed(f"{TABLE.format(kind=kind, stated=stated)}[reference]\n{reference}\n[[axis]]\n{axis}\n", **files)


@pytest.mark.study
def test_learning_controllers_are_laid_out_for_the_way_from_rest(rng):
    """A step at the first sample is none in the reference, but from where the stage stands."""
    numbers = made("bp-pid", reference=STEP).job.controllers.numbers
    assert float(numbers["scale_um"]) == pytest.approx(0.5)
    numbers = made("cmac-pid", "learning_rate = 0.3", STEP).job.controllers.numbers
    assert float(numbers["lower_um"]) == pytest.approx(-0.1)
    assert float(numbers["upper_um"]) == pytest.approx(5.1)
    # 5 um of the stage take some 40 V, of which the table holds half.
    assert 10 < float(numbers["limit_V"]) < 30
    assert float(numbers["learning_rate"]) == 0.3
    stated = made("cmac-pid", "limit_V = 7.0", STEP).job.controllers.numbers
    assert float(stated["limit_V"]) == 7.0


def test_resonators_are_at_the_frequency_of_the_reference(rng):
    sine = 'shape = "sine"\nsamples = 200\ninterval_s = 1e-3\nfrequency_Hz = 33.0'
    assert float(made("resonant", reference=sine).job.controllers.numbers["frequency_Hz"]) == 33.0
    time_s, frequency = np.arange(400) * 1e-3, rng.uniform(20, 60)
    lines = [f"{t},{np.sin(2 * np.pi * frequency * t)}" for t in time_s]
    content = "\n".join(["time_s,displacement_um", *lines]).encode()
    sweep = made("resonant", reference='file = "wanted.csv"', wanted=content)
    assert float(sweep.job.controllers.numbers["frequency_Hz"]) == pytest.approx(frequency, rel=1e-3)
    # What is stated is not made around the PID controller.
    own = made("resonant", "resonant_V_per_um_s = 12.0\nlead_deg = 30.0", sine).job.controllers
    assert own.plant is None
    assert float(own.at({}).lead_deg[0]) == 30.0


@pytest.mark.parametrize("middle", [0.1, 0.35, 0.5, 0.8])
def test_a_single_move_has_no_period(middle, rng):
    """Wherever in the record it is, and in whichever direction; a sine of few periods beside it has one."""
    x = np.linspace(0, 1, 500)
    move = rng.choice([-1, 1]) * np.clip((x - middle) / rng.uniform(0.05, 0.2) + 0.5, 0, 1)
    assert strongest_Hz(move, 1e-2) is None
    assert strongest_Hz(np.zeros(500), 1e-2) is None
    periods = rng.uniform(3, 50)
    assert strongest_Hz(move / 50 + np.sin(2 * np.pi * periods * x), 1e-2) == pytest.approx(periods / 5, rel=0.02)


@pytest.mark.parametrize("samples", [200, 201])
def test_one_period_of_a_sine_has_one_and_a_move_there_and_back_has_none(samples, rng):
    """With its last sample or without; a move there and back in lines, as long as the sine, has another shape."""
    time_s, turn = np.arange(samples) * 1e-3, rng.uniform(0, 2 * np.pi)
    sine = 7 + rng.uniform(0.1, 30) * np.sin(2 * np.pi * 5.0 * time_s + turn)
    assert strongest_Hz(sine, 1e-3) == pytest.approx(5.0, rel=1e-3)
    there_and_back = np.clip(np.minimum(time_s, 0.2 - time_s) / rng.uniform(0.02, 0.08), 0, 1)
    assert strongest_Hz(there_and_back, 1e-3) is None


@pytest.mark.study
def test_gains_that_nothing_can_be_learnt_around_and_unstable_loops_fail_as_rows(rng):
    values = drawn("bp-pid", rng, 3)
    values["controller.integral_V_per_um_s"][[0, 2]] = 0.0, 9000.0
    found = compute_chunk(parsed(HEAD.format(kind="bp-pid", stated=CASES["bp-pid"][0]) + axes(values)), 0)
    assert found.reasons[0].startswith("controller.integral_V_per_um_s = 0 lies outside its bounds, 1e-12 to inf")
    assert found.reasons[1] == ""
    assert "unstable where the hysteresis is steepest" in found.reasons[2]


@pytest.mark.parametrize(
    ("kind", "stated", "words"),
    [
        (
            "resonnant",
            "",
            'controller.kind: expected one of pid, bp-pid, cmac-pid, resonant, found "resonnant"; did you',
        ),
        ("pid", "learning_rate = 0.1", 'found "learning_rate", which is of cmac-pid; '),
        ("bp-pid", "learning_rate = 0.1", "which is of cmac-pid; did you mean learning_rate_per_um2?"),
        ("bp-pid", "reference_weight = 0.5", 'expected a known key of bp-pid, found "reference_weight"'),
        ("cmac-pid", "learnin_rate = 0.1", 'found "learnin_rate"; did you mean learning_rate?'),
        ("cmac-pid", "learning_rate = 2.5", "expected 0 to 2, found 2.5"),
        pytest.param(
            "cmac-pid",
            "lower_um = 9.0",
            "controller.lower_um: expected less than upper_um, which is 5.1 um, found 9",
            marks=pytest.mark.study,
        ),
        pytest.param(
            "cmac-pid",
            "fastest_um_per_s = 0.0",
            "controller.fastest_um_per_s: expected 1e-09 to inf um/s, found 0",
            marks=pytest.mark.study,
        ),
        ("bp-pid", "derivative_V_s_per_um = 0.0", "controller.derivative_V_s_per_um: expected 1e-12 to inf V s/um"),
        ("bp-pid", "span = 1", "controller.span: expected more than 1, found 1"),
        ("bp-pid", "seed = 1.5", "controller.seed: controller.seed is a whole number, found 1.5"),
        (
            "resonant",
            "",
            "controller.frequency_Hz: no period stands out in the reference, such as in a single move;",
        ),
        ("resonant", "frequency_Hz = 600.0", "controller.frequency_Hz: expected 1e-09 to 499.999 Hz, found 600"),
    ],
)
def test_what_is_wrong_with_a_controller_is_a_sentence(tmp_path, kind, stated, words):
    with pytest.raises(fits.DataError) as error:
        made(kind, stated, STEP)
    file = tmp_path / "sweep.toml"
    file.write_text(f"{TABLE.format(kind=kind, stated=stated)}[reference]\n{STEP}\n")
    refused(run("sweep", file, "--out", tmp_path / "out"), words)
    assert words in str(error.value)


def test_axes_of_another_kind_are_refused_with_the_nearest_names():
    with pytest.raises(fits.DataError, match=r"no parameter \"controller.learning_rate\"; did you mean controller\."):
        made("bp-pid", reference=STEP, axis='parameter = "controller.learning_rate"\nvalues = [0.1]')
    short = STEP.replace("samples = 40", "samples = 8")
    with pytest.raises(fits.DataError, match=r"controller.limit_V: no default is found \(.*16 samples.*\); state it"):
        made("cmac-pid", reference=short)
