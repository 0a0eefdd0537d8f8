"""The two truths, against the definition, scipy's quadrature and the laws of Preisach hysteresis."""

import numpy as np
import pytest
import scipy.integrate

import data_synth as ds

INITIAL = ["negative", "positive", "demagnetised", "random"]
KINDS = ["relays", "plays"]


def small_rig(rng, kind="relays", **settings):
    return ds.random_rig(rng, kind=kind, **{"relays": 60, "plays": 50} | settings)


def awkward_voltages(rng, rig, n=150):
    """Jumps, small moves, rests, values on the thresholds and beyond the range."""
    jumps_V = rng.uniform(rig.lower_V - 3, rig.upper_V + 3, n)
    walk_V = np.clip(60 + rng.normal(0, 2, n).cumsum(), rig.lower_V, rig.upper_V)
    thresholds_V = rng.choice(rig.hysteresis().thresholds_V, n)
    return np.concatenate([jumps_V, walk_V, np.repeat(thresholds_V, 2)])


@pytest.mark.parametrize("initial", INITIAL)
def test_fast_relays_are_the_plain_relays(initial, rng):
    n = int(rng.integers(2, 24))
    rig = small_rig(rng, relays=n, lower_V=-20.0, upper_V=110.0)
    history_V = ds.initial_history(initial, rig.lower_V, rig.upper_V, rng)
    voltage_V = awkward_voltages(rng, rig)
    expected_um = ds.plain_relays(rig.irreversible, n, np.concatenate([history_V, voltage_V]))[len(history_V) :]
    hysteresis = rig.hysteresis()
    hysteresis.play(history_V)
    # In two calls: the memory has to last from one to the next.
    played_um = np.concatenate([hysteresis.play(voltage_V[:200]), hysteresis.play(voltage_V[200:])])
    np.testing.assert_allclose(played_um, expected_um, rtol=0, atol=1e-12)


def test_a_single_relay_switches_at_its_thresholds():
    """Two cells a side: the relay (1, 0) goes on at 3 and off below 1, and the diagonal ones have no memory."""
    ridge = ds.Ridge("gaussian", width=1e6, slope=0.0, skew=0.0, bend=0.0)  # so wide that it is flat
    flat = ds.Density(0.0, 4.0, (ridge,), (1.0,))
    played_um = ds.RelayGrid(flat, 2).play(np.array([0.5, 1.0, 2.9, 3.0, 2.9, 1.0, 0.9]))
    # Cells of 2 V by 2 V and 1 um / V^2: 4 um for the relay (1, 0), 2 um for each on the diagonal.
    np.testing.assert_allclose(played_um, [0, 2, 2, 8, 6, 6, 0], atol=1e-9)


def everett_um(density, high_V, low_V):
    """The density integrated over `low <= beta <= alpha <= high`, by scipy."""
    value, _ = scipy.integrate.dblquad(density, low_V, high_V, lambda beta: beta, high_V, epsabs=1e-9, epsrel=1e-9)
    return value


def test_relay_sums_converge_to_the_everett_integral_at_second_order(rng):
    rig = small_rig(rng)
    density, step_V = rig.irreversible, 120.0 / 16
    # At multiples of range / 16 the voltage is at the edge of a cell for every N below.
    pairs_V = [(16 * step_V, 0.0), (11 * step_V, 0.0), (13 * step_V, 4 * step_V), (7 * step_V, 5 * step_V)]
    exact_um = np.array([everett_um(density, high_V, low_V) for high_V, low_V in pairs_V])
    sizes, errors_um = np.array([16, 32, 64, 128]), []
    for n in sizes:
        fallen_um = []
        for high_V, low_V in pairs_V:
            top_um, bottom_um = ds.RelayGrid(density, int(n)).play(np.array([high_V, low_V]))
            fallen_um.append(top_um - bottom_um)
        errors_um.append(np.linalg.norm(np.array(fallen_um) - exact_um))
    order = -np.polyfit(np.log(sizes), np.log(errors_um), 1)[0]
    print(f"order {order:.3f}, errors {errors_um} um")
    assert 1.8 < order < 2.6
    assert errors_um[-1] < 1e-3 * exact_um[0]


def test_gliding_relays_remember_where_the_voltage_turned(rng):
    """Not the edge of a cell before: chirps turn often, and a part of a cell each time adds up to a lead."""
    rig = small_rig(rng)
    density = rig.irreversible
    sizes, errors_um = np.array([25, 50, 100, 200]), []
    pairs_V = [np.sort(rng.uniform(5, 115, 2))[::-1] for _ in range(12)]
    exact_um = np.array([everett_um(density, high_V, low_V) for high_V, low_V in pairs_V])
    for n in sizes:
        fallen_um = []
        for high_V, low_V in pairs_V:
            relays = ds.RelayGrid(density, int(n))
            fallen_um.append(relays.glide(np.array([high_V]))[0] - relays.glide(np.array([low_V]))[0])
        errors_um.append(np.array(fallen_um) - exact_um)
    worst_um = np.abs(errors_um).max(axis=1)
    order = -np.polyfit(np.log(sizes), np.log(worst_um), 1)[0]
    print(f"order {order:.3f}, worst {worst_um} um of {exact_um}")
    assert order > 1.5
    assert worst_um[-1] < 2e-4 * rig.stroke_um


def test_within_a_cell_the_staircase_converges_at_first_order(rng):
    rig = small_rig(rng)
    voltage_V = np.linspace(rig.lower_V, rig.upper_V, 4001)
    voltage_V = np.concatenate([voltage_V, voltage_V[::-1]])
    fine_um = ds.RelayGrid(rig.irreversible, 2048).play(voltage_V)
    sizes = np.array([16, 32, 64, 128])
    errors_um = [np.abs(ds.RelayGrid(rig.irreversible, int(n)).play(voltage_V) - fine_um).max() for n in sizes]
    order = -np.polyfit(np.log(sizes), np.log(errors_um), 1)[0]
    assert 0.8 < order < 1.2


def test_plays_are_pistons_with_backlash(rng):
    rig = small_rig(rng, "plays", plays=30, lower_V=-30.0, upper_V=50.0)
    voltage_V = rng.uniform(rig.lower_V, rig.upper_V, 300)
    shape = rig.irreversible
    expected_um = np.zeros(len(voltage_V))
    for radius_V, weight in zip(shape.radii_V, shape.weights_um_per_V, strict=True):
        piston_V = lowest_V = rig.lower_V + radius_V
        for sample, voltage in enumerate(voltage_V):
            if voltage > piston_V + radius_V:
                piston_V = voltage - radius_V
            elif voltage < piston_V - radius_V:
                piston_V = voltage + radius_V
            expected_um[sample] += weight * (piston_V - lowest_V)
    np.testing.assert_allclose(rig.hysteresis().play(voltage_V), expected_um, rtol=0, atol=1e-10)


@pytest.mark.parametrize("kind", KINDS)
def test_wiping_out(kind, rng):
    """A loop inside of another leaves no trace once the voltage is back where it left."""
    rig = small_rig(rng, kind)
    before_V = rng.uniform(10, 110, 6)
    low_V, high_V = np.sort(rng.uniform(10, 110, 2))
    inner_V = rng.uniform(low_V, high_V, 25)
    after_V = rng.uniform(0, 120, 10)
    start_V = np.concatenate([before_V, [0.0, high_V, low_V]])
    # Between low and high, then back to low: what went on between is forgotten.
    straight, detour = rig.hysteresis(), rig.hysteresis()
    straight.play(start_V)
    detour.play(np.concatenate([start_V, inner_V, [high_V, low_V]]))
    np.testing.assert_allclose(detour.play(after_V), straight.play(after_V), rtol=0, atol=1e-11)


@pytest.mark.parametrize("kind", KINDS)
def test_congruency(kind, rng):
    """Loops between the same two voltages have the same shape, whatever came before; only their height differs."""
    rig = small_rig(rng, kind)
    low_V, high_V = 50.0, 70.0
    loop_V = np.concatenate([np.linspace(low_V, high_V, 40), np.linspace(high_V, low_V, 40)])
    heights_um = []
    loops_um = []
    for initial in ["negative", "positive"]:
        hysteresis = rig.hysteresis()
        hysteresis.play(ds.initial_history(initial, rig.lower_V, rig.upper_V, rng))
        hysteresis.play(loop_V)  # the first passage may still leave the major branch
        displacement_um = hysteresis.play(loop_V)
        heights_um.append(displacement_um[0])
        loops_um.append(displacement_um - displacement_um[0])
    np.testing.assert_allclose(*loops_um, rtol=0, atol=1e-11)
    assert heights_um[1] - heights_um[0] > 0.002 * rig.stroke_um


@pytest.mark.parametrize("kind", KINDS)
def test_histories_end_in_the_states_they_name(kind, rng):
    rig = small_rig(rng, kind, relays=120)
    whole_um = rig.stroke_um * (1 - rig.reversible_share)
    hysteresis = rig.hysteresis()

    def state(initial):
        history_V = ds.initial_history(initial, rig.lower_V, rig.upper_V, rng)
        return history_V[-1], hysteresis.play(history_V)[-1]

    # In turn, on one stage: each history wipes out the one before.
    for initial in rng.permutation(INITIAL):
        rest_V, rest_um = state(initial)
        if initial == "negative":
            assert (rest_V, rest_um) == (rig.lower_V, pytest.approx(0, abs=1e-11))
        elif initial == "positive":
            assert (rest_V, rest_um) == (rig.upper_V, pytest.approx(whole_um, rel=2e-3))
        elif initial == "demagnetised":
            assert rest_V == 60.0
            # On are the relays that a voltage decaying to the middle leaves on: bias below the middle.
            if kind == "relays":
                t = (np.arange(600) + 0.5) / 600 * 120
                on = (t[:, None] >= t) & (t[:, None] + t < 120)
                on_um = np.sum(rig.irreversible(t[:, None], t) * on) * (120 / 600) ** 2
                assert rest_um == pytest.approx(on_um, rel=0.03)
            else:  # plays have come to rest in the middle, and every one goes half of its way
                assert rest_um == pytest.approx(whole_um / 2, rel=0.02)
        else:
            assert rig.lower_V <= rest_V <= rig.upper_V
    assert state("random") != state("random")


def test_rigs_are_what_they_say(rng):
    """Stroke and loop width, measured on a loop; rising everywhere; in the ranges that are promised."""
    for k in range(24):
        rig = ds.random_rig(rng, kind=KINDS[k % 2], relays=240)
        assert 10 <= rig.stroke_um <= 100
        assert 0.5 <= rig.reversible_share <= 0.8
        assert 0.08 <= rig.loop_width <= 0.20
        up_V = np.linspace(rig.lower_V, rig.upper_V, 241)
        voltage_V = np.concatenate([up_V, up_V[::-1]])
        displacement_um = rig.reversible(voltage_V) + rig.hysteresis().play(voltage_V)
        up_um, down_um = displacement_um[:241], displacement_um[:240:-1]
        assert up_um[0] == pytest.approx(0, abs=1e-9)
        assert up_um[-1] == pytest.approx(rig.stroke_um, rel=1e-3)
        assert np.max(down_um - up_um) == pytest.approx(rig.loop_width * rig.stroke_um, rel=0.01)
        assert np.all(np.diff(up_um) > 0)
        assert np.all(np.diff(down_um) > 0)
        assert np.all(np.diff(rig.reversible(up_V)) > 0)
        if rig.kind == "relays":
            assert np.all(rig.irreversible(up_V[:, None], up_V)[np.tri(241, dtype=bool)] > 0)


def test_what_is_stated_of_a_rig_is_kept(rng):
    rig = ds.random_rig(
        rng, kind="plays", lower_V=-30.0, upper_V=150.0, stroke_um=12.0, reversible_share=0.55, loop_width=0.15
    )
    assert (rig.kind, rig.lower_V, rig.upper_V, rig.stroke_um) == ("plays", -30.0, 150.0, 12.0)
    assert (rig.reversible_share, rig.loop_width) == (0.55, 0.15)


@pytest.mark.parametrize("kind", KINDS)
def test_a_loop_wider_than_its_memory_is_refused(kind, rng):
    with pytest.raises(ValueError, match="loop_width must be between"):
        ds.random_rig(rng, kind=kind, reversible_share=0.8, loop_width=0.19)
