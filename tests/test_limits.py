"""Limits of a rig: how they are read, and that no program suggested leaves them on the bench."""

import os

import numpy as np
import pytest
from _seed import seed_of

import data_synth
import fits
from fits import DataError, FitError, Record
from fits.diagnosis._programs import limits_of, menu
from fits.diagnosis._safe import Guard, Model
from fits.io._limits import (
    Extreme,
    allowed,
    beyond,
    check_command,
    compared,
    parse_limits,
    ranges_json,
    reached_in,
    stated_as,
)
from fits.stage._motion import motion, reached_by

MOST = 1024
RIGS = int(os.environ.get("MICROID_RIGS", 50))


@pytest.mark.parametrize(
    ("text", "name", "expected"),
    [
        ("displacement=0:40um", "displacement", (0.0, 40.0)),
        ("displacement=-0.02:0.04 mm", "displacement", (-20.0, 40.0)),
        ("displacement=100:2000nm", "displacement", (0.1, 2.0)),
        ("displacement=1e-6:2e-5m", "displacement", (1.0, 20.0)),
        ("voltage=-20:0.12kV", "voltage", (-0.02 * 1000, 120.0)),
        ("slew=2kV/s", "slew", (-2000.0, 2000.0)),
        ("velocity=3 mm/s", "velocity", (-3000.0, 3000.0)),
        ("acceleration=-1:2m/s^2", "acceleration", (-1e6, 2e6)),
        ("current=500", "current", (-500.0, 500.0)),
    ],
)
def test_limits_are_read_in_any_unit(text, name, expected):
    if name == "voltage":
        # One unit serves both numbers.
        text, expected = "voltage=-0.02:0.12kV", (-20.0, 120.0)
    assert parse_limits([text])[name] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        (["length=0:4"], "displacement"),
        (["displacement=4"], "two numbers"),
        (["displacement=40:0um"], "lower"),
        (["displacement=0:40V"], "unit um"),
        (["velocity=0:40um"], "unit um/s"),
        (["slew=fast"], "range such as"),
        (["slew=1", "slew=2"], "once"),
        (["slew=-3"], "lower"),
        (["displacement=0:1e999um"], "lower"),
        (["displacement"], "range such as"),
    ],
)
def test_what_is_no_limit_is_refused_in_one_sentence(texts, words):
    with pytest.raises(DataError, match=words) as refused:
        parse_limits(texts)
    assert "\n" not in str(refused.value)
    assert str(refused.value).startswith("--limit")


def test_what_is_stated_comes_before_what_was_reached():
    reached = {"voltage": (0.0, 100.0), "slew": (-50.0, 200.0), "displacement": (1.0, 21.0), "velocity": (-3.0, 2.0)}
    limits = allowed(reached, {"slew": (-10.0, 10.0)}, 0.1)
    assert limits == {
        "voltage": (0.0, 100.0),
        "slew": (-10.0, 10.0),
        "displacement": pytest.approx((-1.0, 23.0)),
        "velocity": pytest.approx((-3.3, 3.3)),
    }
    with pytest.raises(DataError, match="margin: expected"):
        allowed(reached, {}, -0.1)


def test_the_option_that_is_advised_allows_what_was_refused(rng):
    """What a refusal tells a user to paste is read, and lets the same command through."""
    for _ in range(200):
        size = 10 ** rng.uniform(-3, 6)
        low, high = np.sort(size * rng.uniform(-1, 1, 2))
        one = Extreme(str(rng.choice(["displacement", "slew", "current"])), low, high, low / 2, high / 2)
        stated = parse_limits([stated_as(one).removeprefix("--limit ")])
        assert not beyond(compared({one.name: (low, high)}, stated))


def test_a_command_beyond_what_the_runs_reached_is_refused():
    ranges = {"voltage": (0.0, 80.0), "slew": (-900.0, 900.0), "displacement": (0.0, 16.0)}
    runs = [
        {"offset_um": 2.0, "reached": ranges_json({**ranges, "displacement": (2.0, 18.0)})},
        {"offset_um": 5.0, "reached": ranges_json({"displacement": (5.0, 26.0)})},
    ]
    reached = reached_in({"runs": runs})
    # The second run read 3 um more than the first.
    assert reached["displacement"] == (2.0, 23.0)
    assert check_command("r.csv", {**ranges, "displacement": (2.0, 23.0)}, reached, {}, 0.0) == []
    with pytest.raises(DataError, match=r"r\.csv: .*displacement of 25 um.* 23 um.*--limit displacement=") as refused:
        check_command("r.csv", {"displacement": (3.0, 25.0)}, reached, {}, 0.0)
    option = str(refused.value).split("--limit ")[1].removesuffix(".")
    assert check_command("r.csv", {"displacement": (3.0, 25.0)}, reached, parse_limits([option]), 0.0) == []
    (remark,) = check_command("r.csv", {"slew": (-1.0, 1e4)}, reached, {}, 0.0, spared=("slew",))
    assert "slew of 1e+04 V/s" in remark
    (remark,) = check_command("r.csv", {"slew": (-1.0, 1e4)}, {}, {}, 0.0)
    assert "does not say" in remark
    with pytest.raises(DataError, match="nothing says"):
        check_command("r.csv", ranges, reached, {"current": (-1.0, 1.0)}, 0.0)


SCENARIO = """
name = "light"
description = "A lightly damped stage."
[rig]
kind = "plays"
plays = 80
[plant]
time_constant_s = {tau}
natural_frequency_Hz = {frequency}
damping_ratio = {damping}
[sensor]
noise_um = 0.02
[[runs]]
name = "slow"
sample_rate_Hz = 100.0
[[runs.program]]
kind = "triangle"
cycles = 1
rate_V_per_s = 60.0
[[runs.program]]
kind = "nested"
biases_V = [60.0]
amplitude_V = 60.0
loops = 8
rate_V_per_s = 100.0
[[runs]]
name = "fast"
sample_rate_Hz = 5000.0
[[runs.program]]
kind = "triangle"
cycles = 1
rate_V_per_s = 1200.0
[[runs.program]]
kind = "ramp"
to_V = 60.0
rate_V_per_s = 1200.0
[[runs.program]]
kind = "multisine"
amplitude_V = 8.0
low_Hz = 2.0
high_Hz = {high}
period_s = 0.25
periods = 2
"""


class Rig:
    """A lightly damped rig of the bench, fitted, and a guard over it."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        frequency, damping = 50 * 8 ** rng.random(), 10 ** rng.uniform(-2, -1)
        tau = 10 ** rng.uniform(-4.3, -3)
        text = SCENARIO.format(tau=tau, frequency=frequency, damping=damping, high=2.5 * frequency)
        self.words = f"f {frequency:.0f} Hz, zeta {damping:.3f}, tau {tau * 1e3:.2f} ms"
        self.bench = data_synth.simulate(data_synth.parse_scenario(text), seed)
        self.records = [
            Record(r.time_s, r.voltage_V, r.displacement_um, source=f"{r.name}.csv") for r in self.bench.records
        ]
        true = self.bench.records[0].true_displacement_um
        self.offset_um = float(np.mean(self.records[0].displacement_um - true))
        found = fits.fit_stage(self.records, initial="negative", levels=12, holdout=0.0)
        range_V = (0.0, 120.0)
        known = [np.ones(len(record), dtype=bool) for record in self.records]
        reached, _ = reached_by(found.model, self.records, range_V, ["negative"] * 2, known)
        drawn = fits.draw_plants(found.model, 5, uncertainty=found.uncertainty, seed=seed)
        limits = allowed({**reached, "voltage": range_V}, {}, 0.02)
        self.guard = Guard(
            [Model(stage, 0.0, found.misfit.residual_um) for stage in drawn], limits, self.records[0], range_V
        )
        self.found, self.frequency_Hz, self.rng = found, frequency, rng

    def played(self, time_s, voltage_V):
        """Lowest and highest displacement on the bench, without noise, as the sensor reads it."""
        again = self.bench.play(time_s, voltage_V, np.random.default_rng(0))
        moved = again.true_displacement_um + self.offset_um
        return float(moved.min()), float(moved.max())

    def programs(self, tries):
        """Programs of the menu that the guard lets through, at their start and elsewhere."""
        limits = self.guard.narrowed(limits_of(self.records, (0.0, 120.0), self.frequency_Hz, None))
        for program in self.guard.menu(limits, MOST):
            yield program.words, program.samples(program.start)
            for _ in range(tries):
                samples = program.samples(self.rng.uniform(program.lower, program.upper))
                if self.guard.allows(samples):
                    yield program.words, samples

    def unguarded(self):
        """The same menu as fast as the records were."""
        limits = limits_of(self.records, (0.0, 120.0), self.frequency_Hz, None)
        for program in menu(limits, MOST):
            yield program.words, program.samples(program.start)


def left(rig, programs):
    """Programs that leave the limits on the bench, and by how much, in um; and how many there are."""
    lowest, highest = rig.guard.limits["displacement"]
    found, count = [], 0
    for words, samples in programs:
        low, high = rig.played(*samples)
        count += 1
        if low < lowest or high > highest:
            found.append((words, round(max(lowest - low, high - highest), 4)))
    return found, count


@pytest.mark.study
def test_no_program_that_is_let_through_leaves_the_limits_on_the_bench(seed):
    rig = Rig(seed)
    print(rig.words, rig.guard.limits)
    found, count = left(rig, rig.programs(1))
    assert count >= 6
    assert found == []


def test_what_rings_between_samples_is_seen():
    """A step into a resonance that its samples skip over: SciPy's answer, sampled finely."""
    from scipy import signal

    from microid import Mechanics, Piezo, Stage

    stage = Stage.of(piezo=Piezo(np.asarray(0.5)), mechanics=Mechanics(np.asarray(100.0), np.asarray(0.02)))
    # Whole periods between samples: at the samples the ringing always has the same phase.
    time_s = 0.01 * np.arange(40)
    voltage_V = np.where(np.arange(40) < 5, 0.0, 10.0)
    ranges, _ = motion(stage, Record(time_s, voltage_V, None), (0.0, 10.0))
    rate = 2 * np.pi * 100.0
    fine = np.linspace(0, time_s[-1], 39 * 256 + 1)
    drive = np.interp(fine, time_s, voltage_V)
    moved = signal.lsim(([0.5 * rate**2], [1, 0.04 * rate, rate**2]), drive, fine)[1]
    assert ranges["displacement"][1] == pytest.approx(moved.max(), rel=0.01)
    assert ranges["velocity"][1] == pytest.approx(np.gradient(moved, fine).max(), rel=0.03)
    assert ranges["slew"] == pytest.approx((0.0, 1000.0))


@pytest.mark.study
def test_no_program_leaves_the_limits_on_many_rigs():
    """Of many lightly damped rigs none is taken beyond its limits, and without the guard many would be."""
    first, beyond_limits, unguarded, played, refused = seed_of("many rigs"), [], 0, 0, 0
    for k in range(RIGS):
        try:
            rig = Rig(first + k)
        except (DataError, FitError) as error:
            refused += 1
            print(k, error, flush=True)
            continue
        found, count = left(rig, rig.programs(2))
        played += count
        unguarded += bool(left(rig, rig.unguarded())[0])
        print(k, rig.words, count, found, flush=True)
        beyond_limits += found
    print(
        f"{played} programs, {len(beyond_limits)} beyond; unguarded {unguarded} rigs; {refused} not fitted",
        flush=True,
    )
    assert beyond_limits == []
    assert unguarded > 0.1 * RIGS
    assert refused < 0.1 * RIGS


@pytest.mark.parametrize("runs", [1.5, "x", None, [1, "x"], [{"reached": 3.0}], [{"reached": {}, "offset_um": "x"}]])
def test_a_model_file_that_says_nonsense_of_its_runs_says_nothing(runs):
    assert reached_in({"runs": runs}) == {}
