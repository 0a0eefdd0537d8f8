"""The rows of the benchmark, each a function of the settings that fills lines into a table."""

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _control_rows import control as control_rows
from _frequency_rows import frequency as frequency_rows
from _inputs import BENCH, Case, SLOPE_um_per_V, model_of, random_path, shared_case, smooth_density, synthetic_case
from _inverse_rows import inverse as inverse_rows
from _peers import fit_lsq_linear, fit_nnls, numpy_relays, relay_design, scan_relays, thresholds
from _plant_fit_rows import fit_own, plant_fit
from _plant_rows import plant as plant_rows
from _sensitivity_rows import sensitivity as sensitivity_rows
from _sweep_rows import sweep as sweep_rows
from _timing import Line, Table, cpu_seconds, seconds, side_by_side

import fits
from microid import Memory, Preisach, negative_saturation, remember

_LEVELS = 100


@dataclass(frozen=True)
class Settings:
    """What the command line said."""

    seed: int
    quick: bool

    @property
    def samples(self) -> int:
        return 10_000 if self.quick else 100_000

    @property
    def repeats(self) -> int:
        return 3 if self.quick else 5


@jax.jit
def _search(voltage_V: jax.Array) -> Memory:
    return remember(voltage_V, negative_saturation(0.0))


@eqx.filter_jit
def _respond(model: Preisach, memory: Memory) -> jax.Array:
    return model.respond(memory)


@eqx.filter_jit
def _simulate(model: Preisach, voltage_V: jax.Array) -> jax.Array:
    return model(voltage_V)


@eqx.filter_jit
def _gradient(both: tuple[Preisach, Memory], weight: jax.Array) -> tuple[Preisach, Memory]:
    return eqx.filter_grad(lambda both: weight @ both[0].respond(both[1]))(both)


@eqx.filter_jit
def _gradient_with_search(both: tuple[Preisach, jax.Array], weight: jax.Array) -> tuple[Preisach, jax.Array]:
    return eqx.filter_grad(lambda both: weight @ both[0](both[1]))(both)


def _voltage(settings: Settings) -> jax.Array:
    rng = np.random.default_rng(settings.seed)
    return jnp.asarray(random_path(rng, settings.samples, settings.samples // 100, 1.0))


def forward(settings: Settings, table: Table) -> None:
    """Simulate a known density, against relays."""
    rig = smooth_density(settings.seed, 1.0, 1.0)
    model, voltage = model_of(rig, _LEVELS), _voltage(settings)
    memory, voltage_V = _search(voltage), np.asarray(voltage)
    surface = eqx.filter_jit(lambda model: model.everett)(model)
    centre_V = (np.arange(_LEVELS) + 0.5) / _LEVELS
    alpha_V, beta_V = thresholds(_LEVELS, 0.0, 1.0)
    packed_um = rig.irreversible(alpha_V, beta_V) / _LEVELS**2 * np.where(alpha_V == beta_V, 0.5, 1)
    square_um = np.zeros((_LEVELS, _LEVELS))
    square_um[np.tril_indices(_LEVELS)] = packed_um
    scan = scan_relays(packed_um, alpha_V, beta_V)
    on_surface = eqx.filter_jit(lambda surface, memory: surface.respond(memory))
    taken = side_by_side(
        {
            "known": lambda: _respond(model, memory),
            "surface": lambda: on_surface(surface, memory),
            "search": lambda: _simulate(model, voltage),
            "numpy": lambda: numpy_relays(square_um, centre_V, voltage_V) + SLOPE_um_per_V * voltage_V,
            "scan": lambda: scan(voltage) + SLOPE_um_per_V * voltage,
        },
        settings.repeats,
    )
    ours_um = np.asarray(_simulate(model, voltage))
    off_um = scan(voltage) + SLOPE_um_per_V * voltage - ours_um
    off_pct = 100 * float(np.sqrt(np.mean(np.square(off_um))) / np.ptp(ours_um))
    case = f"forward, N = {_LEVELS}, T = {settings.samples:.0e}"
    note = f"relays are {off_pct:.2g} % rms off"
    table.ratio(f"{case}, memory known, over NumPy relays", "50x (300x)", taken["numpy"], taken["known"], note=note)
    table.ratio(f"{case}, memory known, over lax.scan relays", "30x (100x)", taken["scan"], taken["known"])
    table.ratio(f"{case}, memory and surface known, over NumPy relays", "", taken["numpy"], taken["surface"])
    table.ratio(f"{case}, memory and surface known, over lax.scan relays", "", taken["scan"], taken["surface"])
    table.ratio(f"{case}, with the memory, over NumPy relays", "10x (100x)", taken["numpy"], taken["search"])
    table.ratio(f"{case}, with the memory, over lax.scan relays", "", taken["scan"], taken["search"])


def gradient(settings: Settings, table: Table) -> None:
    """Differentiate with respect to every weight and every input voltage."""
    model, voltage = model_of(smooth_density(settings.seed, 1.0, 1.0), _LEVELS), _voltage(settings)
    memory = _search(voltage)
    weight = jnp.asarray(np.random.default_rng(settings.seed).standard_normal(settings.samples))
    taken = side_by_side(
        {
            "forward": lambda: _respond(model, memory),
            "gradient": lambda: _gradient((model, memory), weight),
            "search": lambda: _simulate(model, voltage),
            "search gradient": lambda: _gradient_with_search((model, voltage), weight),
        },
        settings.repeats,
    )
    case = f"gradient, N = {_LEVELS}, T = {settings.samples:.0e}"
    table.ratio(
        f"{case}, memory known, over forward", "<= 5x (3x)", taken["forward"], taken["gradient"], inverse=True
    )
    table.ratio(f"{case}, with the memory, over forward", "", taken["search"], taken["search gradient"], inverse=True)


def levels(settings: Settings, table: Table) -> None:
    """Refine the density eightfold: a sample must cost the same."""
    rig, voltage = smooth_density(settings.seed, 1.0, 1.0), _voltage(settings)
    memory = _search(voltage)
    coarse, fine = model_of(rig, 50), model_of(rig, 400)
    surface = eqx.filter_jit(lambda model: model.everett)
    on_surface = eqx.filter_jit(lambda surface, memory: surface.respond(memory))
    rough, smooth = surface(coarse), surface(fine)
    taken = side_by_side(
        {
            "rough": lambda: on_surface(rough, memory),
            "smooth": lambda: on_surface(smooth, memory),
            "coarse": lambda: _respond(coarse, memory),
            "fine": lambda: _respond(fine, memory),
        },
        settings.repeats,
    )
    case = f"cost per sample, N = 400 over 50, T = {settings.samples:.0e}"
    table.ratio(f"{case}, surface known", "< 1.3x (1x)", taken["rough"], taken["smooth"], inverse=True)
    table.ratio(f"{case}, surface built in each call", "", taken["coarse"], taken["fine"], inverse=True)


def _record(case: Case) -> fits.Record:
    return fits.Record(np.arange(float(len(case.voltage_V))), case.voltage_V, case.displacement_um)


def _error_pct(case: Case, result: fits.FitResult) -> float:
    program = fits.Record(np.arange(float(len(case.test_voltage_V))), case.test_voltage_V, None)
    return case.nrmse_pct(result.predict(program, initial="negative").displacement_um)


def _fit(measured: fits.Record, count: int | None) -> fits.FitResult:
    return fits.fit([measured], levels=count, holdout=0.0, initial="negative")


def _fit_seconds(measured: fits.Record, count: int | None) -> float:
    return cpu_seconds(lambda: _fit(measured, count).noise_um)


def fit(settings: Settings, table: Table) -> None:
    """Fit 10,000 samples at 50 levels, against bounded least squares on the matrix of relays."""
    case, count = synthetic_case(settings.seed, 10_000), 50
    measured = _record(case)
    ways = {f"N = {count}": count, "N chosen": None}
    # The first fit of each compiles; what is timed comes after it.
    errors_pct = {way: _error_pct(case, _fit(measured, n)) for way, n in ways.items()}
    solvers = {} if settings.quick else {"nnls": fit_nnls, "lsq_linear": fit_lsq_linear}
    ours: dict[str, list[float]] = {way: [] for way in ways}

    def take() -> None:
        for way, n in ways.items():
            ours[way].append(_fit_seconds(measured, n))

    take()
    for name, solve in solvers.items():
        # Once only: it takes tens of seconds, which evens out what else the machine does.
        start = time.process_time()
        weights, trouble = solve(relay_design(count, 0.0, 120.0, case.voltage_V), case.displacement_um)
        theirs = time.process_time() - start
        take()
        peer_pct = case.nrmse_pct(relay_design(count, 0.0, 120.0, case.test_voltage_V) @ weights)
        for way, wanted in zip(ways, ("5x (30x)", ""), strict=True):
            what = f"fit, T = 1e+04, {way}, warm, over {name} with N = {count}"
            note = f"held-out {errors_pct[way]:.3g} % against {peer_pct:.3g} %{trouble}"
            table.ratio(what, wanted, [theirs, theirs], ours[way][-2:], note=note)
    for way in ways if settings.quick else ():
        note = f"held-out {errors_pct[way]:.3g} %; peers: without --quick"
        table.add(Line(f"fit, T = 1e+04, {way}, warm", "", "", seconds(ours[way]), note=note))


def record(settings: Settings, table: Table) -> None:
    """Fit the record that other toolboxes were tried on, beside the best of them."""
    case = shared_case()
    if case is None:
        table.add(Line("fit_preisach.npz", "", "", note="skipped: shared/bench does not lie beside the repository"))
        return
    measured = _record(case)
    ways = {"levels chosen": None, "17 levels": 17}
    found = {name: _fit(measured, n) for name, n in ways.items()}
    ours: dict[str, list[float]] = {name: [] for name in ways}
    theirs, peer = [], {}
    for _ in range(1 if settings.quick else 3):
        for name, n in ways.items():
            ours[name].append(_fit_seconds(measured, n))
        command = [sys.executable, str(BENCH / "bench_fit_cell.py"), "30"]
        peer = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        theirs.append(peer["cpu_s"])
    for name, result in found.items():
        what = f"fit_preisach.npz, {name} ({result.model.density.levels})"
        note = f"held-out {_error_pct(case, result):.4f} % (wanted 0.042, aim 0.03), peer {peer['test_nrmse_pct']} %"
        table.ratio(f"{what}, warm, over NNLS on cells", "5x (50x)", theirs, ours[name], note=note)
    figures = _first_fit(case)
    table.add(Line("fit_preisach.npz, peak memory of a process that fits it", "< 1.5 (0.7) GB", _peak(figures)))


def _peak(figures: dict[str, float]) -> str:
    return f"{figures['peak_GB']:.2f} GB"


def _first_fit(case: Case) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "case.npz"
        np.savez(file, voltage_V=case.voltage_V, displacement_um=case.displacement_um)
        command = [sys.executable, str(Path(__file__).with_name("_first_fit.py")), str(file)]
        return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def cold(settings: Settings, table: Table) -> None:
    """Start from nothing: what a user of the command waits for."""
    start = time.perf_counter()
    subprocess.run([sys.executable, "-m", "fits", "--help"], check=True, capture_output=True)
    wall = f"{time.perf_counter() - start:.2g} s"
    table.add(Line("microid --help", "(< 1 s)", wall, note="wall time"))
    figures = _first_fit(synthetic_case(settings.seed, 10_000))
    note = f"wall time, {figures['import_s']:.2g} s of it imports; CPU {figures['first_cpu_s']:.3g} s"
    what = "first fit of a new process, T = 1e+04, levels chosen"
    table.add(Line(what, "", f"{figures['first_s']:.3g} s", note=note))


def plant(settings: Settings, table: Table) -> None:
    """The linear plant, against SciPy's simulation, and its fit, against SciPy's least squares."""
    plant_rows(settings.samples, settings.repeats, settings.seed, table)
    plant_fit(1 if settings.quick else 3, table, fit_own)


def inverse(settings: Settings, table: Table) -> None:
    """The exact inverse, in JAX and in C, beside a network trained for it."""
    inverse_rows(10_000, settings.repeats, settings.seed, table)


def frequency(_: Settings, table: Table) -> None:
    """Modes of a measured mirror, with and without hysteresis."""
    frequency_rows(table)


def sensitivity(settings: Settings, table: Table) -> None:
    """Spread of all axes within the tolerances, against NumPy."""
    sensitivity_rows(10 * settings.samples, settings.repeats, settings.seed, table)


def control(settings: Settings, table: Table) -> None:
    """Many closed loops at once, against NumPy."""
    control_rows(settings.samples, 256, settings.repeats, settings.seed, table)


def sweep(settings: Settings, table: Table) -> None:
    """Many simulations and many fits at once, over one by one."""
    sweep_rows(1000, settings.repeats, settings.seed, table)


ROWS = {
    "forward": forward,
    "gradient": gradient,
    "levels": levels,
    "fit": fit,
    "record": record,
    "plant": plant,
    "inverse": inverse,
    "frequency": frequency,
    "sensitivity": sensitivity,
    "control": control,
    "sweep": sweep,
    "cold": cold,
}
