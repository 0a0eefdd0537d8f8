"""Pictures of a closed loop: margins are marked where they are, and nothing hides what is drawn."""

import jax.numpy as jnp
import numpy as np
import pytest

import microid as m
import microid.control as c
from fits.control._tune_problem import Goal
from fits.plots._control import plot_control

T = 1e-3


def test_margins_are_marked_on_the_curves_and_all_three_signals_show(rng, tmp_path, monkeypatch):
    pictures = {}
    monkeypatch.setattr("fits.plots._style.save", lambda picture, path: pictures.update({path.stem: picture}) or path)
    plants = [
        m.Stage.of(piezo=m.Piezo(0.1), mechanics=m.Mechanics(f, 0.1)) for f in (120.0, *rng.uniform(100, 140, 2))
    ]
    pid = c.PID(0.0, 400.0, 0.0, T)
    wanted = jnp.asarray(1 - np.cos(2 * np.pi * 10 * T * np.arange(100)))
    run = c.simulate_loop(pid, plants[0], wanted, noise_um=jnp.asarray(rng.normal(0, 0.01, 100)))
    plot_control(run, pid, plants, tmp_path, goal=Goal())
    size, turn, peak = pictures["margins"].axes
    (gain_Hz, gain), (phase_Hz, phase), (peak_Hz, high) = (
        np.ravel([line.get_data() for line in axes.lines if line.get_marker() == "o"]) for axes in (size, turn, peak)
    )
    # On the curves of the model, which are drawn last of those of plants, at -180 degrees, gain 1 and the highest.
    modulus, phases, sensitivity = (axes.lines[2].get_data() for axes in (size, turn, peak))
    assert (gain, phase) == pytest.approx((np.interp(gain_Hz, *modulus), np.interp(phase_Hz, *phases)), rel=1e-2)
    assert np.interp(gain_Hz, *phases) == pytest.approx(-180, abs=0.5)
    assert np.interp(phase_Hz, *modulus) == pytest.approx(1, rel=1e-2)
    assert (high, peak_Hz) == pytest.approx((sensitivity[1].max(), sensitivity[0][sensitivity[1].argmax()]), rel=1e-3)
    for axes, words in zip(
        (size, turn, peak),
        (f"gain margin {1 / gain:.3g} at", f"phase margin {phase + 180:.3g}° at", f"peak {high:.3g} at"),
        strict=True,
    ):
        assert axes.get_title(loc="left").startswith(words)
        # What is no plant looks like none.
        plants_of = [line for line in axes.lines if len(line.get_xdata()) > 2]
        others = [line for line in axes.lines if len(line.get_xdata()) == 2]
        assert {line.get_linestyle() for line in plants_of} == {"-"}
        assert sorted(line.get_linestyle() for line in others) == ["--", ":"]
    (short,) = (line.get_data() for line in size.lines if line.get_linestyle() == "--")
    assert short[0][0] < gain_Hz < short[0][1] < 2 * short[0][0]
    assert list(short[1]) == [0.5, 0.5]
    widths = [line.get_linewidth() for line in pictures["run"].axes[0].lines]
    assert sorted(widths, reverse=True) == widths
    assert len(set(widths)) == 3
