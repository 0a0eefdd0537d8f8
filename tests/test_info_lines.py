"""`info` tells a hum by the amplitudes and phases of its lines, as the report does, and not by cosines and sines."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from _command import run

from fits import default_stage, save_model
from fits.loop._line_words import with_amplitudes
from microid.effects import extend
from microid.effects.mains_hum import MainsHum

MAINS_Hz = 50.02


@pytest.fixture
def hum(rng):
    """Cosines and sines of three lines, of which the last is not there."""
    return rng.uniform(-0.05, 0.05, (2, 3)) * [1, 1, 0]


def lines_of(hum):
    """Amplitude in um and phase in degrees of each line, read off the wave itself."""
    angle = np.linspace(-np.pi, np.pi, 200_001)
    for cosine, sine in hum.T:
        wave = cosine * np.cos(angle) + sine * np.sin(angle)
        yield wave.max(), np.rad2deg(angle[np.argmax(wave)])


def estimates(hum, sd):
    named = {
        f"mains_hum.{name}_um[{k}]": x
        for name, row in zip(("cosine", "sine"), hum, strict=True)
        for k, x in enumerate(row)
    }
    rows = [
        {"name": name, "unit": "um", "value": x, "sd": sd, "lower": x - sd, "upper": x + sd}
        for name, x in named.items()
    ]
    base = {
        "name": "mains_hum.frequency_Hz",
        "unit": "Hz",
        "value": MAINS_Hz,
        "sd": 1e-3,
        "lower": 50.0,
        "upper": 50.1,
    }
    return [*rows, base]


def test_lines_of_a_model_have_amplitude_and_phase(hum, tmp_path):
    stage = extend(default_stage(), MainsHum(*map(jnp.asarray, hum), jnp.asarray(MAINS_Hz)))
    fit = {"part_of": "diagnosis", "sources": ["a.csv"], "parameters": estimates(hum, 0.002)}
    save_model(tmp_path / "extended.json", stage, None, fit)
    model, _, fitted = run("info", tmp_path / "extended.json").stdout.partition("written by 'microid diagnose'")
    assert "sine" not in model + fitted
    for k, (size_um, turn_deg) in enumerate(lines_of(hum)):
        place = f"{(k + 1) * MAINS_Hz:.5g} Hz"
        (told,) = re.findall(rf"mains_hum at {place} +(\S+) um(?:, phase (\S+) degrees)?\n", model)
        assert float(told[0]) == pytest.approx(size_um, abs=1e-6)
        assert (told[1] == "") == (size_um == 0)
        assert not told[1] or float(told[1]) == pytest.approx(turn_deg, abs=0.51)
        (value,) = re.findall(rf"mains_hum\.amplitude at {place} +(\S+) ± 0\.002 .* um\n", fitted)
        assert float(value) == pytest.approx(size_um, abs=1e-4)


def test_what_is_of_one_run_or_not_known_or_alone_is_kept(hum):
    first, *rest = estimates(hum, 0.002)
    # Without its sine a cosine is itself.
    assert with_amplitudes([first]) == [first]
    of_run = [one | {"name": f"{one['name']} in run 2"} for one in (first, rest[2])]
    (told,) = with_amplitudes(of_run)
    assert told["name"] == "mains_hum.amplitude of line 1 in run 2"
    (unknown,) = with_amplitudes([first | {"sd": None}, rest[2]])
    assert unknown["value"] is None
