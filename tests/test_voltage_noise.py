"""Noise in the readings of the voltage is told from noise of the sensor, and from what the stage follows."""

import re

import numpy as np
import pytest

from fits import Record, fit

TURNS_V = 0, 100, 0, 90, 10, 80, 20, 70, 30, 60, 0, 100, 40, 75, 15, 95, 0


def plays(voltage_V):
    """A sum of thirty plays that begin at 0 V, in um."""
    radii_V, state, found = np.linspace(0.5, 40, 30), np.zeros(30), []
    for volt in voltage_V:
        state = np.clip(state, volt - radii_V, volt + radii_V)
        found.append(0.2 * volt + 0.15 * np.mean(state))
    return np.array(found)


@pytest.fixture
def command_V():
    way_V = np.r_[0, np.cumsum(np.abs(np.diff(TURNS_V)))]
    return np.interp(np.arange(0, way_V[-1], 0.4), way_V, TURNS_V)


def said(voltage_V, moved_um, rng):
    read_um = moved_um + 0.01 * rng.standard_normal(len(moved_um))
    record = Record(0.01 * np.arange(len(voltage_V)), voltage_V, read_um, source="loops.csv")
    return " ".join(fit([record]).remarks)


def test_its_size_is_stated_and_no_lag_is_advised(rng, command_V):
    """A lag was, as it smooths the voltage."""
    noise_V = rng.uniform(0.2, 0.5)
    remarks = said(command_V + noise_V * rng.standard_normal(len(command_V)), plays(command_V), rng)
    found = re.search(r"the voltage carries noise of ([\d.]+) V", remarks)
    assert found, remarks
    assert float(found[1]) == pytest.approx(noise_V, rel=0.15)
    assert "a lag" not in remarks


def test_there_is_none_where_the_stage_follows_it_or_the_sensor_has_it(rng, command_V):
    shaken_V = command_V + 0.3 * rng.standard_normal(len(command_V))
    assert "carries noise" not in said(shaken_V, plays(shaken_V), rng)
    assert "carries noise" not in said(command_V, plays(command_V) + 0.06 * rng.standard_normal(len(command_V)), rng)
