"""Which way of a command between samples a diagnosis takes, by what lines and the other leave."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from fits import Record
from fits.diagnosis._baseline import _hold_of, simulate
from fits.diagnosis._plain_fit import PlainFit
from fits.diagnosis._prepare import _beyond, _hold_of_plateaus
from fits.diagnosis._thresholds import THRESHOLDS
from fits.loop._run import prepare_run
from microid import Driver, Piezo, Stage


def prefers(hold, lines, other, late, late_after=0.0, best=None, best_after=0.0):
    """Of costs under lines and under the other, what a delay takes off either, and what the best effect does."""
    left, after, bad = (np.full(10_000, cost**0.5 / 100) for cost in (lines, other, 1e6))

    def largest_z(at=left):
        return (max(best_after, late_after) if at is after else max(best or 0.0, late) * (at is left)) ** 0.5

    fit = SimpleNamespace(
        holds=("first",),
        left=left,
        left_under=lambda holds: {"first": left, hold: after}.get(holds[0], bad),
        delay_drop=lambda at: late_after if at is after else late * (at is left),
        largest_z=largest_z,
    )
    return PlainFit.better_holds(fit, THRESHOLDS) == (hold,)


def test_steps_are_taken_that_explain_what_a_delay_does():
    assert prefers("zero", lines=9000, other=5010, late=4000)


def test_steps_that_leave_a_delay_are_not():
    assert not prefers("zero", lines=9000, other=8000, late=4000, late_after=150)


@pytest.mark.parametrize("hold", ["zero", "smooth"])
def test_what_another_effect_explains_better_beside_lines_is_no_way_of_the_command(hold):
    # As backlash does, whose readings seem late by a little.
    assert not prefers(hold, lines=39000, other=28700, late=430, best=31800, best_after=16400)
    assert prefers(hold, lines=39000, other=28700, late=430, best=9000, best_after=8900)


def test_without_a_delay_there_are_no_steps():
    assert not prefers("zero", lines=9000, other=5000, late=20)


def test_steps_that_leave_far_less_than_any_effect_need_no_delay():
    """The stage had taken up how late they were: lines left 98,786, and 29,098 beside the best effect."""
    assert prefers("zero", lines=98786, other=12113, late=0.0, best=69688, best_after=3581)
    assert not prefers("zero", lines=98786, other=12113, late=0.0, best=86000, best_after=3581)


def better_holds(taken, table):
    """The ways that are taken where, of 10,000 samples, each of two runs' leaves some, a delay and an effect of that.

    What a delay and the best effect take off is given beside the cost, by what leaves it.
    """
    left = {holds: np.full(10_000, cost**0.5 / 100) for holds, (cost, _, _) in table.items()}
    known = {id(left[holds]): row for holds, row in table.items()}
    fit = SimpleNamespace(
        holds=taken,
        left=left[taken],
        left_under=lambda holds: left.get(holds, np.full(10_000, 1e3)),
        delay_drop=lambda at: known.get(id(at), (0, 0.0, 0.0))[1],
        largest_z=lambda at=left[taken]: known.get(id(at), (0, 0.0, 0.0))[2] ** 0.5,
    )
    return PlainFit.better_holds(fit, THRESHOLDS)


def test_levels_that_looked_like_steps_may_be_lines_beside_an_effect():
    """A driver's slew limit: lines leave a little more, and far less beside it."""
    table = {("first", "zero"): (28000.0, 0.0, 4800.0), ("first", "first"): (28800.0, 0.0, 11800.0)}
    assert better_holds(("first", "zero"), table) == ("first", "first")
    table["first", "first"] = 28800.0, 0.0, 5000.0
    assert better_holds(("first", "zero"), table) == ("first", "zero")


def test_a_delay_beside_lines_does_not_hide_steps_that_need_none():
    """Beside hum, lines and a delay of the readings were worth more than steps, and worse beside the hum."""
    table = {
        ("first", "zero"): (304000.0, 0.0, 286300.0),
        ("first", "first"): (314300.0, 14300.0, 275900.0),
        ("zero", "first"): (314200.0, 14700.0, 275900.0),
        ("zero", "zero"): (302700.0, 0.0, 286200.0),
    }
    assert better_holds(("first", "zero"), table) == ("zero", "zero")


def test_runs_that_go_apart_need_no_effect_to_explain_as_much():
    """Ramps between levels looked like steps, and as steps left a shift of the readings that explained the rest."""
    table = {("zero", "zero"): (20700.0, 0.0, 10770.0), ("first", "zero"): (9910.0, 0.0, 5.0)}
    assert better_holds(("zero", "zero"), table) == ("first", "zero")
    # They go alike where an effect explains more beside that.
    table["zero", "zero"] = 32700.0, 0.0, 22770.0
    table["first", "zero"] = 21900.0, 0.0, 12300.0
    assert better_holds(("zero", "zero"), table) == ("zero", "zero")


def test_curves_that_explain_what_an_effect_does_need_none():
    assert prefers("smooth", lines=9400, other=9010, late=0.0, best=400, best_after=10)
    assert prefers("smooth", lines=13801, other=13541, late=293, best=541, best_after=281)
    assert not prefers("smooth", lines=13801, other=13741, late=0.0, best=541, best_after=481)


def test_curves_are_seen_beside_an_effect_that_hides_them():
    assert prefers("smooth", lines=177000, other=177092, late=8.0, best=166765, best_after=167132)


def test_steps_are_seen_beside_an_effect_that_hides_them():
    """As a clock that is off by 127 ppm did, beside a stage that had taken up how late the readings were."""
    assert prefers("zero", lines=50518, other=73151, late=2291, best=16449, best_after=61377)
    assert not prefers("zero", lines=50518, other=73151, late=2291, best=16449, best_after=39000)
    # Beside what else is there, they leave less than a delay does.
    assert prefers("zero", lines=16457, other=15613, late=893, best=907, best_after=448)
    assert not prefers("zero", lines=16457, other=16057, late=893, best=907, best_after=848)
    assert not prefers("zero", lines=50518, other=67182, late=0.0, best=39000, best_after=55740)


def test_curves_that_leave_a_little_less_of_much_are_no_way_of_the_command():
    assert not prefers("smooth", lines=74000, other=75700, late=0.0, best=50700, best_after=52650)


def test_a_command_that_mostly_stays_where_it_is_goes_in_steps():
    jumps, ramp = np.repeat([0.0, 5.0, 2.0], 4), np.linspace(0.0, 5.0, 12)
    assert _hold_of_plateaus(SimpleNamespace(voltage_V=jumps)) == "zero"
    assert _hold_of_plateaus(SimpleNamespace(voltage_V=ramp)) == "first"


def test_a_run_held_out_that_goes_beyond_what_was_fitted_is_said_to():
    low_V, high_V = -90.0, 92.0
    volts = np.r_[np.linspace(low_V, high_V, 88), np.full(12, 150.0)]
    fitted = Record(np.arange(100.0), volts, np.zeros(100), source="fitted.csv")
    inside, little, far = (
        SimpleNamespace(voltage_V=np.array([low_V, high_V + more]), source=f"{more:g}.csv")
        for more in (-3.0, 1.0, 5.0)
    )
    below = SimpleNamespace(voltage_V=np.array([low_V - 6.0, high_V + 5.0]), source="below.csv")
    assert not _beyond([fitted], [inside, little], 0.12)
    # The end of the record, which is held out, too, is not what was fitted.
    upper, lower = _beyond([fitted], [far, below], 0.12)
    assert upper.startswith("5.csv goes to 97 V, and what was fitted from -90 to 92 V only")
    assert lower.startswith("below.csv goes to -96 V")


@pytest.mark.parametrize(("excess", "mixed"), [(80_000.0, True), (1_600_000.0, False)])
def test_runs_of_one_rig_go_apart_only_where_that_is_more_than_a_small_part_of_the_misfit(excess, mixed):
    # Beside a hysteresis that no density follows, steps in the slow run of two took off a little.
    left, apart, bad = (np.full(10_000, (1 + cost / 1e4) ** 0.5) for cost in (excess, excess - 50_000, 1e8))
    under = {("first", "first"): left, ("zero", "first"): apart}
    fit = SimpleNamespace(
        holds=("first", "first"),
        left=left,
        left_under=lambda holds: under.get(holds, bad),
        delay_drop=lambda at: 50_000.0 * (at is left),
        largest_z=lambda at=left: (0.75 * excess - 40_000 * (at is apart)) ** 0.5 if at is not bad else 0.0,
    )
    assert (PlainFit.better_holds(fit, THRESHOLDS) == ("zero", "first")) == mixed


@dataclass(frozen=True)
class Other:
    """A fit with the command in another way."""

    holds: tuple[str, ...]
    left: np.ndarray
    left_beside_best: float
    lag: float = np.inf

    @property
    def left_beside_late(self):
        return self.lag

    def left_beside_lag(self):
        return self.lag

    def largest_z(self):
        return 30.0

    def in_noise_of(self, _):
        return self


@pytest.mark.parametrize(
    ("curves", "best_z", "kept"), [(22.31, 60.0, True), (22.31, 30.0, False), (22.6, 30.0, True), (10.0, 60.0, False)]
)
def test_lines_are_kept_where_curves_leave_hardly_less_once_they_are_fitted(curves, best_z, kept):
    # In noise variances; as much as 22.5 is left beside lines. The best effect there may explain less than curves.
    lines, there = np.full(10_000, 22.5**0.5), np.full(10_000, curves**0.5)
    late = {"left_beside_late": np.inf, "thresholds": THRESHOLDS}
    fit = SimpleNamespace(left=lines, largest_z=lambda: best_z, left_beside_best=1e5, **late)
    assert PlainFit.outdoes(fit, Other(("smooth",), there, 1e5)) == kept
    # An effect beside one of them leaves half of what is left beside any and the other, or not.
    for less, more, far in ((11_000.0, 20_000.0, True), (16_000.0, 20_000.0, False), (9_000.0, 10_400.0, False)):
        for here, beyond in ((less, more), (more, less)):
            fit.left_beside_best = here
            assert PlainFit.outdoes(fit, Other(("smooth",), there, beyond)) == (here < beyond if far else kept)


@pytest.mark.parametrize(("lag", "kept"), [(9_800.0, True), (9_990.0, False), (11_000.0, False)])
def test_lines_are_kept_where_a_lag_leaves_less_beside_them_than_beside_curves(lag, kept):
    # Beside curves nothing but noise is left with a lag, 10,000, and beside lines as much, less, or more.
    lines, there = np.full(10_000, 3.0**0.5), np.full(10_000, 1.09**0.5)
    late = {"left_beside_late": lag, "left_beside_best": 15_000.0, "thresholds": THRESHOLDS}
    fit = SimpleNamespace(left=lines, largest_z=lambda: 100.0, **late)
    assert PlainFit.outdoes(fit, Other(("smooth",), there, 15_000.0, 10_000.0)) == kept


@pytest.mark.parametrize(
    ("lag", "best", "steps", "steps_lag", "steps_best", "lines"),
    [
        # A lag beside lines leaves noise alone, and nothing does so beside steps, lag or not.
        (9_900.0, 30_000.0, 2.6, 10_900.0, 18_000.0, True),
        # It leaves as much beside either, or little less: steps need no parameter.
        (9_900.0, 30_000.0, 2.6, 9_900.0, 18_000.0, False),
        (19_300.0, 30_000.0, 2.6, 20_000.0, 20_000.0, False),
        # Another effect leaves noise alone beside lines, or beside steps.
        (15_000.0, 9_900.0, 2.6, 14_000.0, 14_000.0, True),
        (15_000.0, 30_000.0, 2.6, 14_000.0, 9_900.0, False),
        # Steps leave noise without any.
        (9_000.0, 30_000.0, 1.0, 10_000.0, 10_000.0, False),
        (9_700.0, 30_000.0, 1.07, 10_700.0, 10_700.0, True),
    ],
)
def test_lines_are_kept_where_a_lag_or_an_effect_leaves_less_than_any_beside_steps(
    lag, best, steps, steps_lag, steps_best, lines
):
    left = np.full(10_000, 3.7**0.5), np.full(10_000, steps**0.5)
    fit = SimpleNamespace(
        left=left[0],
        left_beside_lag=lambda: lag,
        left_beside_best=best,
        largest_z=lambda: 80.0,
        thresholds=THRESHOLDS,
        is_rounded=False,
    )
    assert PlainFit.outdoes(fit, Other(("zero",), left[1], steps_best, steps_lag)) == lines
    # Errors of rounding look like a little more than noise.
    fit.is_rounded = True
    assert PlainFit.outdoes(fit, Other(("zero",), left[1], steps_best, steps_lag)) == (lines and steps > 1.09)


def fitted_to(holds, left, best_z, aside=(), missed_um2=1.0, late=0.0, late_s=0.0):
    """A fit that leaves so many noise variances in each sample, its best effect, and how runs held out go."""
    baseline = SimpleNamespace(aside=[SimpleNamespace(hold=hold) for hold in aside])
    fit = SimpleNamespace(
        holds=holds,
        left=np.full(10_000, left**0.5),
        regression=SimpleNamespace(baseline=baseline),
        largest_z=lambda: best_z,
        thresholds=THRESHOLDS,
        missed_um2=missed_um2,
        delay_drop=lambda _: late,
        in_noise_of=lambda _: fit,
        late=lambda: (late, late_s),
        scales=SimpleNamespace(interval_s=1.0),
    )
    fit.is_half_a_sample_late = PlainFit.is_half_a_sample_late.fget(fit)
    fit.foretold_in_steps = PlainFit.foretold_in_steps.fget(fit)
    return fit


@pytest.mark.parametrize(
    ("fit", "asked"),
    [
        (fitted_to(("first",), 2.0, 50.0, late=100.0), True),
        (fitted_to(("first",), 2.0, 50.0, late=10.0), False),
        (fitted_to(("first",), 2.0, 50.0, aside=("zero",)), True),
        (fitted_to(("first", "zero"), 2.0, 50.0, aside=("zero",)), False),
        (fitted_to(("first",), 1.01, 5.0, late=100.0), False),
        (fitted_to(("zero",), 2.0, 50.0, late=100.0), False),
    ],
)
def test_steps_are_asked_for_where_much_is_late_or_a_run_held_out_goes_so(fit, asked):
    assert PlainFit.may_be_held(fit, THRESHOLDS) == asked


def test_steps_are_taken_that_leave_less_beside_the_best_effect_or_predict_better():
    lines = fitted_to(("first",), 5.0, 100.0)
    assert not PlainFit.explains_more(fitted_to(("zero",), 4.9, 95.0), lines)
    # More is left without any effect, and less beside one that was hidden.
    assert PlainFit.explains_more(fitted_to(("zero",), 7.0, 190.0), lines)
    told, steps = fitted_to(("first",), 5.0, 100.0, ("zero",), 10.0), fitted_to(("zero",), 5.1, 100.0, missed_um2=2.0)
    assert PlainFit.explains_more(steps, told)
    assert not PlainFit.explains_more(fitted_to(("zero",), 5.1, 100.0, missed_um2=9.8), told)
    assert not PlainFit.explains_more(fitted_to(("zero",), 5.5, 100.0, missed_um2=2.0), told)
    assert not PlainFit.explains_more(steps, replace_aside(told))
    # A delay that is one leaves much beside its tangent, and what was held out is predicted worse in steps.
    assert not PlainFit.explains_more(fitted_to(("zero",), 7.0, 190.0, missed_um2=1.1), lines)
    # Of noise alone nothing would leave less.
    assert not PlainFit.explains_more(fitted_to(("zero",), 1.0, 10.0), fitted_to(("first",), 5.0, 199.0))
    # Much is left either way, and what explains most of it beside lines is a delay of half a sample, or of more.
    steps = fitted_to(("zero",), 5.05, 93.0, missed_um2=0.5)
    for late_s, taken in ((0.4, True), (0.7, False), (0.1, False)):
        late = fitted_to(("first",), 5.0, 100.0, late=9_900.0, late_s=late_s)
        assert PlainFit.explains_more(steps, late) == taken


def replace_aside(fit):
    """The same with runs held out that go as those that were fitted."""
    return fitted_to(fit.holds, 5.0, 100.0, fit.holds, 10.0)


@pytest.mark.parametrize(("times", "taken"), [(0.0, "first"), (0.9, "zero"), (1.1, "zero"), (1.5, "first")])
def test_a_held_out_command_goes_in_steps_where_as_much_as_they_make_shows(times, taken):
    """Behind a slew limit a pulse is late, too, but by one and a half times what steps are late by."""
    rng, stage = np.random.default_rng(0), Stage.of(driver=Driver(jnp.asarray(2e-3)), piezo=Piezo(jnp.asarray(1.0)))
    voltage_V = 50 + np.cumsum(rng.normal(size=400))
    record = Record(1e-3 * np.arange(400), voltage_V, voltage_V, source="aside.csv")
    run = prepare_run(record, (float(voltage_V.min()), float(voltage_V.max())), "unknown", 0.0, 4)
    lines, steps = (simulate(stage, replace(run, hold=hold)) for hold in ("first", "zero"))
    reading_um = lines + times * (steps - lines) + 0.05 * rng.normal(size=400)
    read = replace(run, record=replace(record, displacement_um=reading_um))
    assert _hold_of(stage, read, 0.06) == taken
