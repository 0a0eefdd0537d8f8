"""Records of the bench with what goes wrong with records: late, thinned, stuck, joined, in other units."""

from dataclasses import replace

import numpy as np
from _seed import seed_of

import data_synth
from fits import Record

SCENARIO = """
name = "checked"
description = "slow loops, and a fast multisine"

[rig]
stroke_um = {stroke}

[plant]
time_constant_s = 0.000799
natural_frequency_Hz = 180.0
damping_ratio = 0.04

[sensor]
noise_um = 0.05

[[runs]]
name = "slow"
sample_rate_Hz = 100.0

[[runs.program]]
kind = "triangle"
cycles = 2
rate_V_per_s = 100.0

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
kind = "ramp"
to_V = 60.0
rate_V_per_s = 500.0

[[runs.program]]
kind = "multisine"
amplitude_V = 15.0
low_Hz = 2.0
high_Hz = 600.0
period_s = 0.25
periods = 4
"""
TRUTH = {
    "driver.time_constant_s": 0.799e-3,
    "mechanics.natural_frequency_Hz": 180.0,
    "mechanics.damping_ratio": 0.04,
}


def bench(stroke_um=40.0, rig=0, first=None):
    """Slow and fast records of a rig; each number is another one, counted from a first seed."""
    seed = (seed_of("bench") if first is None else first) + rig
    made = data_synth.simulate(data_synth.parse_scenario(SCENARIO.format(stroke=stroke_um)), seed)
    return [Record(r.time_s, r.voltage_V, r.displacement_um, source=f"{r.name}.csv") for r in made.records]


def read(record, displacement_um, source=None):
    """The same record with other readings."""
    return Record(record.time_s, record.voltage_V, displacement_um, source=source or record.source)


def delayed(record, samples):
    """Readings that come so many samples late; early where negative."""
    late, early = max(samples, 0), max(-samples, 0)
    n = len(record) - late - early
    columns = record.time_s[late : late + n], record.voltage_V[late : late + n]
    return Record(*columns, record.displacement_um[early : early + n], source=record.source)


def thinned(record, every):
    columns = record.time_s, record.voltage_V, record.displacement_um
    return Record(*(column[::every] for column in columns), source=record.source)


def in_ms(record):
    return replace(record, time_s=1e3 * record.time_s, extra={})


def joined(one, other):
    step = one.time_s[1] - one.time_s[0]
    time = np.concatenate([one.time_s, one.time_s[-1] + step + other.time_s])
    columns = (np.concatenate([getattr(r, name) for r in (one, other)]) for name in ("voltage_V", "displacement_um"))
    return Record(time, *columns, source="joined.csv")


def stuck(record, first, count):
    reading = record.displacement_um.copy()
    reading[first : first + count] = reading[first]
    return read(record, reading)


def with_outliers(rng, record, share=0.03, size_um=50.0):
    """Some readings jump out; the record, and where."""
    hit = rng.random(len(record)) < share
    return read(record, record.displacement_um + np.where(hit, size_um * rng.choice([-1, 1], len(record)), 0.0)), hit


def said(result, word):
    """The only remark of a fit with a word in it."""
    (remark,) = [remark for remark in result.remarks if word in remark]
    return remark
