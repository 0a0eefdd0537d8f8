"""The Bouc-Wen benchmark: identify the oscillator from noisy multisines, predict the official test records.

Usage: `python benchmarks/boucwen.py [--realizations 2] [--seed S]`. The estimation data are made by the bench: 50 N
rms, 5 to 150 Hz, one period in steady state for each realization, 8 um rms of white noise. The multisine test pair is
read from `../shared/data/boucwen` where it is, and made by the bench otherwise; the sweep is made by the bench.
Published errors on the multisine test, in m: 1.6e-4 (linear), 4.5e-5 (dynoNet), 1.2e-5 (PNLSS of degrees 3, 5 and 7),
7.5e-6 (grey-box neural state space).
"""

import argparse
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.io import loadmat

import data_synth
import fits
import microid as m
from microid.hysteresis import BoucWen

jax.config.update("jax_enable_x64", True)

OFFICIAL = Path(__file__).parents[1].parent / "shared" / "data" / "boucwen"
INTERVAL_s, NOISE_um, FINEST = 1 / data_synth.BOUCWEN_RATE_HZ, 8.0, 20


def oscillator(gain_um_per_N: float, natural_frequency_Hz: float, damping_ratio: float, law: BoucWen) -> m.Stage:
    """A force in N in the place of the voltage, a displacement in um; what cannot be seen is frozen."""
    stage = m.Stage.of(
        hold="smooth",
        force=m.Piezo(gain_um_per_N),
        mechanics=m.HystereticMechanics(m.Mechanics(natural_frequency_Hz, damping_ratio), law),
    )
    own = "mechanics.law"
    return stage.freeze(
        "force.offset_um", "mechanics.inner.gain", f"{own}.slope_um_per_V", f"{own}.offset_um", f"{own}.exponent"
    )


@eqx.filter_jit
def respond(stage: m.Stage, force_N: jax.Array) -> jax.Array:
    """Responses from rest, shape `(k, n)`, in um."""
    rest = m.Start(jnp.asarray(0.0))
    return jax.vmap(lambda force: stage(jnp.asarray(INTERVAL_s), force, rest))(force_N)


def test_records(rng: np.random.Generator) -> tuple[str, np.ndarray, np.ndarray]:
    """Force in N and displacement in m of the multisine test, official where it is at hand."""
    if OFFICIAL.is_dir():
        force, moved = (
            next(v for k, v in loadmat(OFFICIAL / f"{name}val_multisine.mat").items() if k[0] != "_").ravel()
            for name in "uy"
        )
        return "official", force, moved
    force = data_synth.boucwen_multisine(50.0, rng)
    return "own", force, data_synth.boucwen_response(force)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description="The Bouc-Wen benchmark.")
    parser.add_argument("--realizations", type=int, default=2, help="of the estimation data (default 2)")
    parser.add_argument("--seed", type=int, default=0, help="of phases and noise (default 0)")
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    truth = data_synth.BoucWenOscillator()

    force_N = np.stack([data_synth.boucwen_multisine(50.0, rng) for _ in range(options.realizations)])
    clean_um = np.stack([1e6 * data_synth.boucwen_response(one) for one in force_N])
    begin = time.perf_counter()
    start = oscillator(25.0, 26.0, 0.03, BoucWen(0.0, 1.3, 5e-4, 0.0))
    time_s = INTERVAL_s * np.arange(force_N.shape[1])
    records = [
        fits.Record(time_s, force, clean + rng.normal(0, NOISE_um, clean.shape), source=f"realization {k + 1}")
        for k, (force, clean) in enumerate(zip(force_N, clean_um, strict=True))
    ]
    # Of a steady state what came before is unknown, and what depends on it is left out.
    result = fits.fit_stage(records, stage=start, holdout=0.0)
    fitted = result.model
    print(
        f"{options.realizations} x 8,192 samples fitted in {time.perf_counter() - begin:.0f} s, seed {options.seed}"
    )

    stiffness = truth.stiffness_N_per_m
    linear = m.Mechanics.from_mass(truth.mass_kg, stiffness, truth.damping_N_s_per_m)
    law = BoucWen(
        0.0, truth.alpha_N_per_m / stiffness, 1e-6 * truth.beta * truth.gamma, 1e-6 * truth.beta * truth.delta
    )
    exact = oscillator(1e6 / stiffness, float(linear.natural_frequency_Hz), float(linear.damping_ratio), law)
    coordinates = m.Coordinates(exact, exact.free)
    for one, true in zip(result.parameters, np.asarray(coordinates.values(coordinates.of(exact))), strict=True):
        print(f"{one.name:40} {one.value:12.6g} +- {one.sd:.2g}, true {true:.6g} {one.unit}")
    for line in (*result.remarks, *(f"{run.source}: {run.unknown} samples left out" for run in result.runs)):
        print(line)

    which, force, moved = test_records(rng)
    for name, stage in (("true parameters", exact), ("fitted", fitted)):
        out = np.asarray(respond(stage.with_substeps(FINEST), jnp.asarray(np.tile(force, 2))[None]))[0, len(force) :]
        print(f"multisine test ({which}), {name}: e_rms {np.sqrt(np.mean((1e-6 * out - moved) ** 2)):.2e} m")
    sweep, moved = data_synth.boucwen_sweep()
    out = np.asarray(respond(fitted.with_substeps(FINEST // 2), jnp.asarray(sweep)[None]))[0]
    print(f"sweep test (own), fitted: e_rms {np.sqrt(np.mean((1e-6 * out - moved) ** 2)):.2e} m")


if __name__ == "__main__":
    main()
