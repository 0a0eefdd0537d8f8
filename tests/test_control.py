"""The controllers against NumPy, one sample after the other, and against what follows by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _models import compiled
from _reference import central_differences
from jax import lax

import microid.control as c

T = 1e-3
SAMPLES = 80


def run(controller, reference_um, measured_um, feedforward_V):
    """Commands along given readings, and the last state."""

    def visit(state, now):
        return controller.step(state, *now)

    start = controller.init(measured_um[0], 0.0)
    return lax.scan(visit, start, (reference_um, measured_um, feedforward_V))


play = compiled(run)


def signals(rng):
    """A reference, a reading that does what it likes, and a feedforward."""
    at = np.arange(SAMPLES) * T
    reference = 3 + 2 * np.sin(2 * np.pi * rng.uniform(5, 30) * at + rng.uniform(0, 6)) + (at > 0.04)
    return reference, reference - rng.normal(0, 0.4, SAMPLES), 20 + 5 * reference + rng.normal(0, 1, SAMPLES)


def random_pid(rng, **others):
    return c.PID(*rng.uniform([0.5, 50, 1e-3], [3, 300, 1e-2]), T, **others)


class NumpyPID:
    """Position form, as in the docstring, with sums written out."""

    def __init__(self, pid, rest_um):
        names = ("proportional_V_per_um", "integral_V_per_um_s", "derivative_V_s_per_um", "filter_s")
        self.kp, self.ki, self.kd, self.tf = (float(getattr(pid, name)) for name in names)
        self.b, self.c = float(pid.reference_weight), float(pid.derivative_weight)
        self.low, self.high, self.track = float(pid.lower_V), float(pid.upper_V), float(pid.tracking_s)
        self.i = self.kp * (1 - self.b) * rest_um
        self.d, self.before = 0.0, (self.c - 1) * rest_um

    def step(self, r, y, ff):
        now = self.c * r - y
        # Backward difference of Tf d' + d = Kd x'.
        self.d = self.tf / (self.tf + T) * self.d + self.kd / (self.tf + T) * (now - self.before)
        self.before = now
        self.i += self.ki * T * (r - y)
        wanted = ff + self.kp * (self.b * r - y) + self.i + self.d
        applied = min(max(wanted, self.low), self.high)
        self.i -= (wanted - applied) * min(1.0, T / self.track if self.track > 0 else 1.0)
        return applied


@pytest.mark.parametrize("tracking_s", [0.0, 0.02, np.inf])
def test_pid_is_that_of_numpy(tracking_s, rng):
    b, d, filter_s = rng.uniform(0, [1, 1, 5e-3])
    free = random_pid(rng, reference_weight=b, derivative_weight=d, filter_s=filter_s, tracking_s=tracking_s)
    given = signals(rng)
    commands = lambda pid: np.array([*map(NumpyPID(pid, given[1][0]).step, *given)])  # noqa: E731
    # Limits that this very controller meets, both of them.
    low, high = np.quantile(commands(free), [0.3, 0.7])
    pid = eqx.tree_at(lambda p: (p.lower_V, p.upper_V), free, (jnp.asarray(low), jnp.asarray(high)))
    expected = commands(pid)
    assert len({*expected} & {low, high}) == 2 < len({*expected})
    np.testing.assert_allclose(play(pid, *given)[1], expected, rtol=0, atol=1e-10)


def test_pid_of_eq_24_sums_a_constant_error(rng):
    """Under a constant error `e` from the first sample on: `K (e + n T e / T_i)`, plus `K T_d e / T` at first."""
    gain, ti, td, e = rng.uniform([0.5, 0.01, 1e-3, 0.1], [2, 0.1, 5e-3, 1])
    pid = c.PID.from_times(gain, ti, td, T)
    state, command = pid.init(), []
    for _ in range(3):
        state, u = pid.step(state, jnp.asarray(e), jnp.asarray(0.0))
        command.append(float(u))
    n = np.arange(1, 4)
    np.testing.assert_allclose(command, gain * (e + n * T * e / ti + (n == 1) * td * e / T), rtol=1e-12)


def test_weights_of_the_reference_start_at_rest_without_a_kick(rng):
    rest = rng.uniform(2, 9)
    pid = random_pid(rng, reference_weight=0.3, derivative_weight=0.0)
    here = jnp.asarray(rest)
    _, command = pid.step(pid.init(rest, 7.0), here, here, 11.0)
    assert float(command) == pytest.approx(18.0, abs=1e-9)


def test_transfer_is_the_response_to_an_impulse(rng):
    pid = random_pid(rng, filter_s=rng.uniform(1e-4, 5e-3))
    z = 1.05 * np.exp(1j * rng.uniform(0.1, 3, 5))
    impulse, n = np.eye(1, 1500)[0], np.arange(1500)
    response = np.asarray(play(pid, np.append(0, impulse), np.zeros(1501), np.zeros(1501))[1])[1:]
    # The z-transform converges outside of the unit circle.
    np.testing.assert_allclose(pid.transfer(jnp.asarray(z)), (response * z[:, None] ** -n).sum(axis=1), rtol=1e-9)


def network_of(rng):
    return c.GainNetwork(*(rng.normal(0, 0.7, shape) for shape in ((3, 3), 3, (3, 3), 3)))


def random_bp(rng, **others):
    ranges = np.array([0.2, 2]), np.array([0.01, 0.2]), np.array([1e-4, 5e-3])
    return c.BPPID(network_of(rng), *ranges, T, slope_um_per_V=0.1, scale_um=0.5, **others)


class NumpyBP:
    """Back-propagation by hand."""

    def __init__(self, bp):
        net = bp.network
        self.w1, self.p1 = np.array(net.hidden_weight), np.array(net.hidden_threshold)
        self.w2, self.p2 = np.array(net.output_weight), np.array(net.output_threshold)
        self.low, self.high = np.array([bp.gain_V_per_um, bp.integral_time_s, bp.derivative_time_s]).T
        self.rate, self.keep = float(bp.learning_rate_per_um2), float(bp.momentum)
        self.sense, self.scale, self.tf = float(bp.slope_um_per_V), float(bp.scale_um), float(bp.filter_s)
        self.limits = float(bp.lower_V), float(bp.upper_V)
        self.change = [np.zeros_like(x) for x in (self.w1, self.p1, self.w2, self.p2)]
        self.e, self.feedback, self.slopes, self.bend, self.chosen = [0.0, 0.0], 0.0, None, 0.0, []

    def forward(self, x):
        """Feedback's increment, and its derivatives by all weights and thresholds."""
        theta = x / self.scale
        up, down = np.exp(self.w1 @ theta - self.p1), np.exp(self.p1 - self.w1 @ theta)
        h = (up - down) / (up + down)
        n = self.w2 @ h - self.p2
        g = np.exp(n) / (np.exp(n) + np.exp(-n))
        kp, ti, td = self.low + (self.high - self.low) * g
        self.chosen.append((kp, ti, td))
        terms = x[0] + T / ti * x[1] + td / T * x[2]
        by_gain = np.array([terms, -kp * T / ti**2 * x[1], kp / T * x[2]])
        by_n = by_gain * (self.high - self.low) * 2 * g * (1 - g)
        by_h = self.w2.T @ by_n * (1 - h**2)
        return kp * terms, (np.outer(by_h, theta), -by_h, np.outer(by_n, h), -by_n)

    def step(self, r, y, ff):
        error = r - y
        if self.slopes is not None:
            self.change = [
                self.rate * error * self.sense * s + self.keep * d
                for s, d in zip(self.slopes, self.change, strict=True)
            ]
            self.w1, self.p1, self.w2, self.p2 = (
                x + d for x, d in zip((self.w1, self.p1, self.w2, self.p2), self.change, strict=True)
            )
        share = T / (self.tf + T)
        self.bend += share * (error - 2 * self.e[-1] + self.e[-2] - self.bend)
        moved, slopes = self.forward(np.array([error - self.e[-1], error, self.bend]))
        self.e.append(error)
        wanted = ff + self.feedback + moved
        applied = np.clip(wanted, *self.limits)
        self.slopes = slopes if applied == wanted else [0 * s for s in slopes]
        self.feedback = applied - ff
        return applied


@pytest.mark.parametrize("limits", [(-np.inf, np.inf), (35.0, 45.0)])
def test_bp_pid_is_that_of_numpy(limits, rng):
    bp = random_bp(rng, learning_rate_per_um2=3.0, momentum=0.3, filter_s=2e-3, lower_V=limits[0], upper_V=limits[1])
    given = signals(rng)
    reference = NumpyBP(bp)
    expected = np.array([reference.step(*now) for now in zip(*given, strict=True)])
    state, command = play(bp, *given)
    assert np.abs(reference.w2 - np.asarray(bp.network.output_weight)).max() > 1e-3
    np.testing.assert_allclose(command, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    np.testing.assert_allclose(state.network.hidden_weight, reference.w1, rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.asarray(bp.gains(state)), reference.chosen[-1], rtol=1e-9)


def test_bp_gains_stay_in_their_ranges_however_fast_they_learn(rng):
    bp = random_bp(rng, learning_rate_per_um2=1e6, momentum=0.9)
    state, command = play(bp, *signals(rng))
    assert np.all(np.isfinite(command))
    for gain, ends in zip(bp.gains(state), (bp.gain_V_per_um, bp.integral_time_s, bp.derivative_time_s), strict=True):
        assert ends[0] <= gain <= ends[1]


def test_bp_pid_around_a_pid_starts_as_that_pid(rng):
    pid = random_pid(rng, filter_s=1e-3, lower_V=-1e3, upper_V=1e3)
    bp = c.BPPID.around(pid, jax.random.key(rng.integers(2**31)), learning_rate_per_um2=0.0)
    start = bp.pid(bp.init())
    for name in ("proportional_V_per_um", "integral_V_per_um_s", "derivative_V_s_per_um", "upper_V", "filter_s"):
        assert float(getattr(start, name)) == pytest.approx(float(getattr(pid, name)), rel=1e-12)
    # Without weights of the output the gains stay as they are, and the velocity form is the position form.
    fixed = eqx.tree_at(lambda bp: bp.network.output_weight, bp, jnp.zeros((3, 3)))
    given = signals(rng)
    given[0][0] = given[1][0]
    np.testing.assert_allclose(play(fixed, *given)[1], play(pid, *given)[1], rtol=1e-9)
    with pytest.raises(ValueError, match="span must be above 1"):
        c.BPPID.around(pid, jax.random.key(0), span=1.0)


def random_cmac(rng, **others):
    pid = random_pid(rng, filter_s=1e-3, lower_V=20.0, upper_V=60.0)
    return c.CMACPID(pid, 0.0, 6.0, 400.0, **{"learning_rate": 0.3, "limit_V": 8.0, "levels": (40, 6), **others})


class NumpyCMAC:
    """A dictionary of cells, each known by its table and the corner of its field."""

    def __init__(self, cmac, rest_um):
        self.pid, self.before, self.cells = NumpyPID(cmac.pid, rest_um), rest_um, {}
        self.count, self.levels = cmac.generalisation, cmac.levels
        self.rate, self.limit = float(cmac.learning_rate), float(cmac.limit_V)
        self.low, self.high, self.fastest = (float(x) for x in (cmac.lower_um, cmac.upper_um, cmac.fastest_um_per_s))

    def keys(self, r, rate):
        q = int(np.clip((r - self.low) / (self.high - self.low) * self.levels[0], 0, self.levels[0] - 1))
        p = int(np.clip((rate + self.fastest) / (2 * self.fastest) * self.levels[1], 0, self.levels[1] - 1))
        return [(k, (q + k) // self.count, (p + k) // self.count) for k in range(self.count)]

    def step(self, r, y, ff):
        keys = self.keys(r, (r - self.before) / T)
        self.before = r
        learnt = sum(self.cells.get(key, 0.0) for key in keys)
        u = self.pid.step(r, y, ff + learnt)
        most = self.limit / self.count
        for key in keys:
            weight = self.cells.get(key, 0.0) + self.rate * (u - ff - learnt) / self.count
            self.cells[key] = min(max(weight, -most), most)
        return u


@pytest.mark.parametrize("levels", [(40, 6), (40, 1)])
def test_cmac_pid_is_that_of_numpy(levels, rng):
    cmac = random_cmac(rng, levels=levels, limit_V=0.8)
    given = signals(rng)
    reference = NumpyCMAC(cmac, given[1][0])
    expected = np.array([reference.step(*now) for now in zip(*given, strict=True)])
    state, command = play(cmac, *given)
    np.testing.assert_allclose(command, expected, rtol=0, atol=1e-10 * 60)
    found, wanted = np.asarray(state.weights_V), np.array(list(reference.cells.values()))
    np.testing.assert_allclose(np.sort(found[found != 0]), np.sort(wanted[wanted != 0]), rtol=0, atol=1e-10)
    assert np.any(np.isclose(np.abs(wanted), 0.1)), "some weight is held at its limit"


def touched(cmac, reference_um, rate=0.0):
    return {*enumerate(np.asarray(cmac.addresses(jnp.asarray(reference_um), jnp.asarray(rate))).tolist())}


@pytest.mark.parametrize("memory", [None, 7])
def test_an_input_touches_as_many_cells_as_the_generalisation_says(memory, rng):
    cmac = random_cmac(rng, memory=memory)
    here = rng.uniform(1, 6)
    given = np.full(2, here), np.array([here, 0]), np.full(2, 30.0)
    state, _ = play(cmac, *given)
    first = {tuple(place) for place in np.argwhere(np.asarray(state.weights_V) != 0)}
    assert len({place[0] for place in first}) == len(first) == cmac.generalisation
    assert state.weights_V.shape == (cmac.generalisation, cmac.cells)


def test_neighbours_share_cells(rng):
    cmac = random_cmac(rng, levels=(60, 1))
    quantum = 6.0 / 60
    at = quantum * (rng.integers(0, 40) + 0.5)
    for distance in range(12):
        shared = touched(cmac, at) & touched(cmac, at + distance * quantum)
        assert len(shared) == max(8 - distance, 0)
    assert touched(cmac, -5.0) == touched(cmac, 0.01)
    assert touched(cmac, 99.0) == touched(cmac, 5.99)
    assert touched(cmac, at, -500.0) == touched(cmac, at, 500.0), "one level of the rate"
    assert touched(random_cmac(rng), at, -500.0) != touched(random_cmac(rng), at, 500.0)


def test_addresses_fill_the_tables_and_no_more(rng):
    cmac = random_cmac(rng, levels=(13, 5), generalisation=4)
    r, v = np.meshgrid((np.arange(13) + 0.5) * 6 / 13, (np.arange(5) - 2.0) * 160)
    found = np.asarray(jax.vmap(cmac.addresses)(jnp.asarray(r.ravel()), jnp.asarray(v.ravel())))
    assert (found.min(), found.max()) == (0, cmac.cells - 1)
    # Cells that are told apart by their corners are so by their addresses.
    reference = NumpyCMAC(cmac, 0.0)
    keys = [reference.keys(*pair) for pair in zip(r.ravel(), v.ravel(), strict=True)]
    assert len({key for some in keys for key in some}) == len({(k, a) for row in found for k, a in enumerate(row)})


def test_the_table_takes_over_what_the_pid_controller_does(rng):
    """Under a reading that never changes, a proportional controller adds `K e` for ever, and the table learns it.

    With rate 1 the table holds `u_p` after one sample, `2 u_p` after two: it integrates, up to its limit.
    """
    e = rng.uniform(0.1, 0.5)
    pid = c.PID(2.0, 0.0, 0.0, T)
    cmac = c.CMACPID(pid, 0.0, 6.0, 1.0, learning_rate=1.0, limit_V=7.0, levels=(10, 1))
    command = np.asarray(play(cmac, np.full(60, 3.0), np.full(60, 3 - e), np.zeros(60))[1])
    np.testing.assert_allclose(command, np.minimum(2 * e * np.arange(60), 7) + 2 * e, rtol=1e-12)


def test_a_table_without_cells_is_refused(rng):
    for wrong in ({"levels": (0, 1)}, {"generalisation": 0}, {"memory": 0}):
        with pytest.raises(ValueError, match="must be 1 or more"):
            random_cmac(rng, **wrong)


@compiled
def slopes_of(controller, given):
    def loss(controller):
        return jnp.sum(jnp.sin(run(controller, *given)[1]))

    return loss(controller), eqx.filter_grad(loss)(controller)


@pytest.mark.parametrize("name", ["pid", "bp", "cmac"])
def test_derivatives_are_those_of_finite_differences(name, rng):
    make, picks = {
        "pid": (
            lambda: random_pid(rng, filter_s=2e-3, tracking_s=0.01, lower_V=33.0, upper_V=42.0),
            lambda x: [x.proportional_V_per_um, x.integral_V_per_um_s, x.derivative_V_s_per_um, x.filter_s],
        ),
        "bp": (
            lambda: random_bp(rng, learning_rate_per_um2=1.0),
            lambda x: [x.learning_rate_per_um2, x.momentum, x.network.output_threshold, x.gain_V_per_um],
        ),
        "cmac": (
            lambda: random_cmac(rng, limit_V=1e3),
            lambda x: [x.pid.proportional_V_per_um, x.pid.integral_V_per_um_s, x.learning_rate],
        ),
    }[name]
    controller, given = make(), signals(rng)
    found = slopes_of(controller, given)[1]
    flat, slopes = (np.concatenate([np.ravel(x) for x in picks(one)]) for one in (controller, found))

    def loss(vector):
        pieces = np.split(vector, np.cumsum([np.size(x) for x in picks(controller)])[:-1])
        values = [jnp.asarray(p.reshape(np.shape(x))) for p, x in zip(pieces, picks(controller), strict=True)]
        return np.asarray(slopes_of(eqx.tree_at(picks, controller, values), given)[0])

    # Learning may amplify a change ten-thousandfold: of two steps, extrapolated (Richardson).
    wide, near = (central_differences(loss, flat, step * np.abs(flat)) for step in (2e-6, 1e-6))
    expected, scale = near + (near - wide) / 3, np.abs(near * flat).max()
    np.testing.assert_allclose(slopes * flat / scale, expected * flat / scale, rtol=0, atol=1e-6)


@pytest.mark.parametrize("make", [random_pid, random_bp, random_cmac])
def test_many_at_once_are_each_what_they_are_alone(make, rng):
    given = signals(rng)
    several = [make(rng) for _ in range(3)]
    together = jax.tree.map(lambda *x: jnp.stack(x), *several)
    batched = eqx.filter_vmap(lambda one: run(one, *given)[1])(together)
    for alone, found in zip(several, batched, strict=True):
        np.testing.assert_allclose(found, play(alone, *given)[1], rtol=1e-10)
