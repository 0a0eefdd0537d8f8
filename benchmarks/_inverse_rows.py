"""Rows for the inverse: the exact one, one exported as C, and a network trained for the purpose."""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _inputs import learning_path, model_of, random_path, smooth_density
from _timing import Line, Table, cpu_seconds, seconds, side_by_side

import fits
from fits.control._network_inverse import NetworkInverse, fit_network_inverse
from microid import Preisach, invert

_UPPER_V, _STROKE_um, _LEVELS = 120.0, 40.0, 100
_NOISE, _LEARNING = 1e-3, 10_000


@eqx.filter_jit
def _invert(model: Preisach, reference_um: jax.Array) -> jax.Array:
    return invert(model, reference_um).voltage_V


@eqx.filter_jit
def _respond(model: Preisach, voltage_V: jax.Array) -> jax.Array:
    return model(voltage_V)


@eqx.filter_jit
def _evaluate(network: NetworkInverse, reference_um: jax.Array) -> jax.Array:
    return network(reference_um)


def _controller(model: Preisach, folder: Path) -> Callable[[np.ndarray], np.ndarray] | None:
    """The exported C, called once for all samples so that only its own time counts; None without a compiler."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return None
    fits.export_c(model, folder, "axis")
    all_samples = folder / "all.c"
    all_samples.write_text(
        '#include "axis.c"\n'
        "void all(const double *um, double *V, int n) {\n"
        "    axis_state state;\n    axis_init(&state, 0);\n"
        "    for (int k = 0; k < n; k++) V[k] = axis_inverse(&state, um[k]);\n}\n"
    )
    library = folder / "all.so"
    subprocess.run([compiler, "-std=c99", "-O2", "-fPIC", "-shared", all_samples, "-o", library], check=True)
    code = ctypes.CDLL(str(library))

    def run(reference_um: np.ndarray) -> np.ndarray:
        voltage_V = np.empty_like(reference_um)
        pointers = (array.ctypes.data_as(ctypes.c_void_p) for array in (reference_um, voltage_V))
        code.all(*pointers, ctypes.c_int(len(reference_um)))
        return voltage_V

    return run


def inverse(samples: int, repeats: int, seed: int, table: Table) -> None:
    """Follow random references exactly, in C, and by a network that was trained on noisy loops of the same stage."""
    rng = np.random.default_rng(seed)
    model = model_of(smooth_density(seed, _UPPER_V, _STROKE_um), _LEVELS)
    stroke_um = float(_respond(model, jnp.full(1, _UPPER_V))[0])
    random_um = stroke_um / _UPPER_V * random_path(rng, samples, samples // 100, _UPPER_V)
    reference = jnp.asarray(random_um)
    exact_V = _invert(model, reference)

    def off_stroke(voltage_V: jax.Array) -> np.ndarray:
        return np.abs(np.asarray(_respond(model, voltage_V)) - random_um) / stroke_um

    learning_V = learning_path(_LEARNING, _UPPER_V)
    measured_um = np.asarray(_respond(model, jnp.asarray(learning_V)))
    noise_um = _NOISE * stroke_um
    measured_um = measured_um + noise_um * rng.standard_normal(_LEARNING)
    record = fits.Record(np.arange(_LEARNING) * 1e-3, learning_V, measured_um)
    trained: list[NetworkInverse] = []
    training_s = cpu_seconds(lambda: trained.append(fit_network_inverse(record, noise_um=noise_um)))
    network = trained[0]
    network_V = jnp.clip(_evaluate(network, reference), 0, _UPPER_V)

    calls = {
        "exact": lambda: _invert(model, reference),
        "network": lambda: _evaluate(network, reference),
        "forward": lambda: _respond(model, reference),
    }
    with tempfile.TemporaryDirectory() as folder:
        controller = _controller(model, Path(folder))
        if controller is not None:
            calls["C"] = lambda: controller(random_um)
            in_c_V = controller(random_um)
        taken = side_by_side(calls, repeats)
    each_ns = {name: f"{1e9 * float(seconds(times)) / samples:.3g} ns a sample" for name, times in taken.items()}
    case = f"inverse, T = {samples:.0e}, N = {_LEVELS}"
    worst = float(off_stroke(exact_V).max())
    table.add(Line(f"{case}, H[H^-1(w)] - w of stroke", "<= 1e-3 (1e-6)", f"{worst:.1g}", seconds(taken["exact"])))
    table.ratio(
        f"{case}, time over forward", "", taken["forward"], taken["exact"], note=each_ns["exact"], inverse=True
    )
    rms, most = float(np.sqrt(np.mean(off_stroke(network_V) ** 2))), float(off_stroke(network_V).max())
    note = f"rms {100 * rms:.2g} %, at most {100 * most:.2g} % of stroke; trained in {training_s:.0f} CPU s"
    table.add(Line(f"{case}, network trained on noisy loops, rms of stroke", "", f"{rms:.1g}", note=note))
    network_note = f"network {each_ns['network']}"
    table.ratio(f"{case}, time over network", "", taken["network"], taken["exact"], note=network_note, inverse=True)
    if controller is None:
        table.add(Line(f"{case}, exported C", "", "skipped", note="there is no C compiler on this machine"))
        return
    apart_V = float(np.max(np.abs(in_c_V - np.asarray(exact_V))))
    table.add(Line(f"{case}, exported C less JAX, V", "<= 1e-6", f"{apart_V:.1g}", note=each_ns["C"]))
    table.ratio(f"{case}, exported C, times faster than JAX", "", taken["exact"], taken["C"])
