"""A stage drawn at random, measured richly, with effects hidden in it: for studies of diagnoses."""

import math
import secrets
from collections.abc import Sequence
from typing import Any

import numpy as np

from data_synth._bench import Bench, simulate
from data_synth._effect import REGISTRY
from data_synth._environment import OtherAxisSettings, TemperatureSettings
from data_synth._errors import ScenarioError
from data_synth._plant import Hold
from data_synth._rig import Kind
from data_synth._scenario import PlantSettings, RigSettings, Run, Scenario, Segment
from data_synth._second import Truth, second_truth
from data_synth._sensor import Sensor
from data_synth._strength import EffectSettings

_LOWER_V, _UPPER_V = 0.0, 120.0
_LEAST_SAMPLES = 1000


def hidden(
    effects: Sequence[str | EffectSettings] = (),
    *,
    seed: int | None = None,
    noise_um: float | None = None,
    rms_per_noise: float = 5.0,
    slow_samples: int = 4000,
    fast_samples: int = 8000,
    holdout: bool = True,
    temperature: bool | None = None,
    other_axis: bool | None = None,
    kind: Kind | None = None,
    roughness: float | None = None,
    stroke_um: float | None = None,
    relays: int = 2000,
    plays: int | None = None,
    hold: Hold = "first",
    truth: Truth = "first",
) -> Bench:
    """Draw a stage of 0 to 120 V, hide effects in it, and measure it.

    The runs are `slow` (loops at the start and the end, reversal curves, a staircase with holds of 0.2 to 8 s or so,
    minor loops) and `fast` (a loop, chirps up to 2.2 to 3 times the resonance at several biases and amplitudes, steps
    of three heights, triangles at rates over two decades), and, half as long and with other programs, `heldout_slow`
    and `heldout_fast`. They start in negative saturation at the lower voltage. Only the effect `initial_state` has
    them start elsewhere.

    Parameters
    ----------
    effects
        What to hide: names out of `EFFECTS` and `OUTSIDE`, or `EffectSettings`.
    seed
        Where all randomness starts; None for a fresh one.
    noise_um
        Standard deviation of the sensor's noise, in um; drawn from 20 to 50 nm for a stroke of 40 um, and in
        proportion to the stroke.
    rms_per_noise
        How strong each effect named is, alone, over the noise; effects that cannot be are as strong as they can.
    slow_samples, fast_samples
        Samples of the runs; those held out have half.
    holdout
        Whether there are runs held out.
    temperature, other_axis
        Whether there is a column `temperature_C`, or `other_um`. If None, drawn; without the column there is no room
        either. `cross_coupling` always has a second axis.
    kind, roughness, stroke_um
        Of the hysteresis, as in `random_rig`; drawn if None. The stroke is drawn from 20 to 80 um.
    relays, plays
        How fine the hysteresis is, as in `random_rig`; 400 plays if None.
    hold
        Whether the command runs in lines between samples (`first`), or stays and jumps (`zero`).
    truth
        What stage there is beneath the effects. The `second` is in no library of models: 24 to 60 plays of random
        radii and weights, a relaxation of eight exponential terms, a gain that depends on the amplitude, each 0.5 to
        1 times as strong as the noise, and noise whose neighbours are correlated by 0.5 to 0.9. All is drawn; `kind`,
        `roughness` and `plays` that are stated are kept.

    Returns
    -------
    Bench
        Its `effects` hold the truth: what is hidden first, and then the second truth's own.

    Raises
    ------
    ScenarioError
        For an effect that is not known, or a number that makes no sense.
    """
    if seed is None:
        seed = secrets.randbelow(2**32)
    if seed < 0:
        raise ScenarioError(f"the seed must be zero or positive, got {seed}")
    if truth not in ("first", "second"):
        raise ScenarioError(f"truth must be first or second, got {truth!r}")
    if min(slow_samples, fast_samples) < _LEAST_SAMPLES:
        raise ScenarioError(
            f"slow_samples and fast_samples must be {_LEAST_SAMPLES} or more, got {slow_samples} and {fast_samples}"
        )
    # A generator for each thing that is drawn: what is stated changes nothing else.
    stage, noise, extras, *programs = np.random.default_rng((seed, 201)).spawn(7)
    drawn_kind: Kind = "relays" if stage.random() < 0.5 else "plays"
    drawn_roughness = float(stage.random())
    drawn_stroke_um = 20.0 * 4.0 ** float(stage.random())
    frequency_Hz = 80.0 * 5.0 ** float(stage.random())
    stroke_um = stroke_um or drawn_stroke_um
    drawn_noise_um = float(noise.uniform(0.02, 0.05)) * stroke_um / 40
    has_room, has_axis = (extras.random(2) < 0.5).tolist()
    has_room = has_room if temperature is None else temperature
    has_axis = has_axis if other_axis is None else other_axis
    second = None if truth == "first" else second_truth(np.random.default_rng((seed, 202)))
    if second is not None:
        kind, roughness, plays = (
            kind or "plays",
            1.0 if roughness is None else roughness,
            second.plays if plays is None else plays,
        )
    try:
        settings = tuple(
            EffectSettings(effect, {}, rms_per_noise) if isinstance(effect, str) else effect for effect in effects
        )
        names = [effect.name for effect in settings]
        slow_Hz = float(programs[0].choice([64.0, 70.0, 80.0, 90.0]))
        fast_Hz = float(round(frequency_Hz * programs[1].uniform(24, 36), -1))
        starts_V = [None] * 4 if "initial_state" not in names else stage.uniform(30, 90, 4).tolist()
        runs = [
            _run("slow", slow_Hz, _slow(programs[0], slow_samples, slow_Hz), slow_samples, starts_V[0]),
            _run("fast", fast_Hz, _fast(programs[1], fast_samples, fast_Hz, frequency_Hz), fast_samples, starts_V[1]),
        ]
        if holdout:
            slow, fast = slow_samples // 2, fast_samples // 2
            brisk = _heldout_fast(programs[3], fast, fast_Hz, frequency_Hz)
            runs += [
                _run("heldout_slow", slow_Hz, _heldout_slow(programs[2], slow, slow_Hz), slow, starts_V[2]),
                _run("heldout_fast", fast_Hz, brisk, fast, starts_V[3]),
            ]
        scenario = Scenario(
            name="hidden",
            description="A stage drawn at random, with a slow and a fast run.",
            rig=RigSettings(
                random=True,
                kind=kind or drawn_kind,
                lower_V=_LOWER_V,
                upper_V=_UPPER_V,
                stroke_um=stroke_um,
                relays=relays,
                plays=400 if plays is None else plays,
                roughness=drawn_roughness if roughness is None else roughness,
            ),
            runs=tuple(runs),
            sensor=Sensor(
                noise_um=drawn_noise_um if noise_um is None else noise_um,
                quantum_um=1e-5,
                correlation=0.0 if second is None else second.correlation,
            ),
            plant=PlantSettings(random=True, natural_frequency_Hz=frequency_Hz, hold=hold),
            effects=settings if second is None else (*settings, *second.effects),
            temperature=TemperatureSettings() if has_room else None,
            other_axis=OtherAxisSettings()
            if has_axis or any(REGISTRY[name].needs == "other_axis" for name in names)
            else None,
            fine_steps=True,
            seed=seed,
            file="hidden",
        )
    except ScenarioError:
        raise
    except ValueError as error:
        raise ScenarioError(f"hidden: {error}") from error
    return simulate(scenario)


Programs = list[Segment]


def _segment(kind: str, **settings: Any) -> Segment:
    return Segment(kind, settings)


def _run(name: str, sample_rate_Hz: float, program: Programs, samples: int, start_V: float | None) -> Run:
    """A run of just so many samples: it rests at its last voltage for what is left."""
    if start_V is not None:
        # Small moves about the start, which remember what was before it.
        rate_V_per_s = 40.0 * sample_rate_Hz * 12 / samples
        minor = _segment("nested", biases_V=(start_V,), amplitude_V=20.0, loops=2, rate_V_per_s=rate_V_per_s)
        program = [minor, *program]
    run = Run(name=name, sample_rate_Hz=sample_rate_Hz, program=tuple(program), start_V=start_V)
    first_V = _LOWER_V if start_V is None else start_V
    taken = len(run.voltage_V(first_V, _LOWER_V, _UPPER_V, np.random.default_rng(0)))
    if taken >= samples:
        return run
    rest = _segment("hold", duration_s=(samples - taken) / sample_rate_Hz)
    return Run(name=name, sample_rate_Hz=sample_rate_Hz, program=(*program, rest), start_V=start_V)


def _paced(kind: str, path_V: float, samples: float, sample_rate_Hz: float, **settings: Any) -> Segment:
    """A program that travels `path_V` (V) in about so many samples."""
    return _segment(kind, rate_V_per_s=path_V * sample_rate_Hz / samples, **settings)


def _slow(rng: np.random.Generator, samples: int, rate_Hz: float) -> Programs:
    span_V = _UPPER_V - _LOWER_V
    above_V = np.sort(rng.uniform(10, 110, 6))[::-1]
    below_V = np.sort(rng.uniform(10, 110, 6))
    loop = _paced("triangle", 2 * span_V, 0.08 * samples, rate_Hz, lower_V=_LOWER_V, upper_V=_UPPER_V, cycles=1)
    limits: dict[str, Any] = {"lower_V": _LOWER_V, "upper_V": _UPPER_V}
    down_V = float(np.sum(_UPPER_V - above_V)) * 2 + span_V
    up_V = float(np.sum(below_V - _LOWER_V)) * 2 + span_V
    levels_V = np.array([30.0, 75.0, 110.0, 60.0, 20.0]) + rng.uniform(-8, 8, 5)
    holds_s = 0.34 * samples / rate_Hz * rng.permutation(np.array([0.01, 0.04, 0.12, 0.33, 0.5]))
    staircase = [
        _segment("steps", levels_V=(level_V,), dwell_s=hold_s, rate_V_per_s=600.0)
        for level_V, hold_s in zip(levels_V.tolist(), holds_s.tolist(), strict=True)
    ]
    biases_V = np.array([25.0, 60.0, 95.0]) + rng.uniform(-5, 5, 3)
    # Each bias is come to from below, and then from above.
    around: dict[str, Any] = {"amplitude_V": 10.0, "loops": 2}
    minor = [
        _paced("nested", 180.0, 0.06 * samples, rate_Hz, biases_V=tuple(biases_V.tolist()), **around),
        _paced("ramp", 25.0, 0.01 * samples, rate_Hz, to_V=_UPPER_V),
        _paced("nested", 180.0, 0.06 * samples, rate_Hz, biases_V=tuple(biases_V[::-1].tolist()), **around),
    ]
    return [
        loop,
        _paced("forc", down_V, 0.13 * samples, rate_Hz, side="above", reversals_V=tuple(above_V.tolist()), **limits),
        *staircase,
        _paced("forc", up_V, 0.13 * samples, rate_Hz, side="below", reversals_V=tuple(below_V.tolist()), **limits),
        *minor,
        loop,
    ]


def _chirps(
    rng: np.random.Generator, count: int, samples: float, rate_Hz: float, frequency_Hz: float, approach: float
) -> Programs:
    biases_V = rng.permutation(np.linspace(25, 95, count)) + rng.uniform(-6, 6, count)
    amplitudes_V = rng.permutation(np.geomspace(2, 9, count)) * rng.uniform(0.8, 1.2, count)
    return [
        _segment(
            "chirp",
            bias_V=float(bias_V),
            amplitude_V=float(amplitude_V),
            start_Hz=frequency_Hz * float(rng.uniform(0.1, 0.3)),
            stop_Hz=frequency_Hz * float(rng.uniform(2.2, 3.0)),
            duration_s=samples / rate_Hz,
            rate_V_per_s=approach,
        )
        for bias_V, amplitude_V in zip(biases_V, amplitudes_V, strict=True)
    ]


def _triangles(lengths: Sequence[float], rate_Hz: float, centre_V: float, height_V: float) -> Programs:
    """Triangles of the same corners, each cycle so many samples long, the short ones repeated."""
    longest = max(lengths)
    return [
        _segment(
            "triangle",
            lower_V=centre_V - height_V,
            upper_V=centre_V + height_V,
            cycles=max(1, min(3, round(0.4 * longest / length))),
            rate_V_per_s=4 * height_V * rate_Hz / length,
        )
        for length in lengths
    ]


def _fast(rng: np.random.Generator, samples: int, rate_Hz: float, frequency_Hz: float) -> Programs:
    span_V = _UPPER_V - _LOWER_V
    limits: dict[str, Any] = {"lower_V": _LOWER_V, "upper_V": _UPPER_V}
    loop = _paced("triangle", 2 * span_V, 0.08 * samples, rate_Hz, cycles=1, **limits)
    approach_V_per_s = 60.0 * rate_Hz / (0.02 * samples)
    heights_V = rng.permutation(np.array([10.0, 25.0, 60.0])) * rng.uniform(0.9, 1.1, 3)
    base_V = float(rng.uniform(8, 16))
    levels_V = [base_V]
    for height_V in heights_V.tolist():
        levels_V += [base_V + height_V, base_V]
    dwell_s = 0.028 * samples / rate_Hz
    stairs = [
        _segment("ramp", to_V=base_V, rate_V_per_s=approach_V_per_s),
        _segment("steps", levels_V=tuple(levels_V[1:]), dwell_s=dwell_s),
    ]
    lengths = np.geomspace(0.1, 0.001, 5) * samples
    # Some are at the resonance: they are low and few.
    height_V = float(rng.uniform(6, 14))
    centre_V = float(rng.uniform(height_V + 10, 110 - height_V))
    triangles = _triangles(lengths.tolist(), rate_Hz, centre_V, height_V)
    return [loop, *_chirps(rng, 4, 0.09 * samples, rate_Hz, frequency_Hz, approach_V_per_s), *stairs, *triangles]


def _heldout_slow(rng: np.random.Generator, samples: int, rate_Hz: float) -> Programs:
    limits: dict[str, Any] = {"lower_V": _LOWER_V, "upper_V": _UPPER_V}
    loop = _paced("triangle", 240.0, 0.14 * samples, rate_Hz, cycles=1, **limits)
    levels_V = rng.uniform(5, 115, 4).tolist()
    holds_s = (0.3 * samples / rate_Hz * rng.permutation(np.array([0.05, 0.15, 0.3, 0.5]))).tolist()
    turns_V: list[float] = []
    now_V, rising = 0.0, True
    for _ in range(14):
        way_V = (_UPPER_V if rising else _LOWER_V) - now_V
        now_V += way_V * float(rng.uniform(0.2, 0.95))
        turns_V.append(now_V)
        rising = not rising
    path_V = float(np.abs(np.diff([0.0, *turns_V])).sum())
    pace_V_per_s = path_V * rate_Hz / (0.4 * samples)
    return [
        loop,
        *(_segment("ramp", to_V=turn_V, rate_V_per_s=pace_V_per_s) for turn_V in turns_V),
        *(
            _segment("steps", levels_V=(level_V,), dwell_s=hold_s, rate_V_per_s=600.0)
            for level_V, hold_s in zip(levels_V, holds_s, strict=True)
        ),
    ]


def _heldout_fast(rng: np.random.Generator, samples: int, rate_Hz: float, frequency_Hz: float) -> Programs:
    limits: dict[str, Any] = {"lower_V": _LOWER_V, "upper_V": _UPPER_V}
    loop = _paced("triangle", 240.0, 0.12 * samples, rate_Hz, cycles=1, **limits)
    approach_V_per_s = 60.0 * rate_Hz / (0.03 * samples)
    period_s = 0.12 * samples / rate_Hz
    multisine = [
        _segment("ramp", to_V=float(rng.uniform(40, 80)), rate_V_per_s=approach_V_per_s),
        _segment(
            "multisine",
            amplitude_V=float(rng.uniform(5, 12)),
            low_Hz=max(0.1 * frequency_Hz, 1.5 / period_s),
            high_Hz=2.2 * frequency_Hz,
            period_s=period_s,
            periods=2,
        ),
    ]
    levels_V = tuple(rng.uniform(10, 110, 5).tolist())
    stairs = [_segment("steps", levels_V=levels_V, dwell_s=0.04 * samples / rate_Hz)]
    length = 0.1 * samples
    height_V = float(rng.uniform(5, 15))
    centre_V = float(rng.uniform(height_V + 8, 112 - height_V))
    triangles = _triangles((length, length / math.sqrt(50), length / 50), rate_Hz, centre_V, height_V)
    chirp = _chirps(rng, 1, 0.12 * samples, rate_Hz, frequency_Hz, approach_V_per_s)
    return [loop, *multisine, *stairs, *chirp, *triangles]
