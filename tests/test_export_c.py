"""The exported C, compiled as a controller would have it, against the operator and its inverse in JAX."""

import ctypes
import shutil
import subprocess

import jax.numpy as jnp
import numpy as np
import pytest
from _command import files, refused, run
from _models import (
    PLACES,
    SAMPLES,
    compiled,
    ends_um,
    limits_V,
    nested_voltages,
    play,
    random_model,
    starts,
    stroke_um,
)

import microid as m
from fits import DataError, Reference, compensate, export_c

COMPILER = shutil.which("gcc") or shutil.which("cc")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion", "-Wshadow", "-O2")
STATES = ("negative", "positive", "demagnetised")
CLIPPED, FORGOTTEN, NOT_A_NUMBER = 1, 2, 4
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler on this machine")


class Controller:
    """The C, with a state of its own."""

    def __init__(self, model, folder, size=128, limits=None):
        _, source = export_c(model, folder, "axis_z", size=size, limits_V=limits)
        library = source.with_suffix(".so")
        subprocess.run([COMPILER, *STRICT, "-fPIC", "-shared", str(source), "-o", str(library)], check=True)
        self.library = ctypes.CDLL(str(library))

        class State(ctypes.Structure):
            _fields_ = [
                ("voltage_V", ctypes.c_double),
                ("displacement_um", ctypes.c_double),
                ("status", ctypes.c_uint),
                ("top", ctypes.c_int),
                ("rising", ctypes.c_int),
                ("extreme_V", ctypes.c_double * size),
                ("extreme_um", ctypes.c_double * size),
            ]

        self.state = State()

    def start(self, state):
        self.library.axis_z_init(ctypes.byref(self.state), STATES.index(state))

    def _play(self, function, values):
        function.argtypes, function.restype = [ctypes.c_void_p, ctypes.c_double], ctypes.c_double
        found = [(function(ctypes.byref(self.state), value), self.state.status) for value in values.tolist()]
        return (np.array(each) for each in zip(*found, strict=True))

    def forward(self, voltage_V):
        return self._play(self.library.axis_z_forward, voltage_V)

    def inverse(self, reference_um):
        return self._play(self.library.axis_z_inverse, reference_um)


@compiled
def inverted(model, reference_um, start):
    return m.invert(model, reference_um, start).voltage_V


@needs_compiler
@pytest.mark.parametrize("levels", [3, 11])
def test_it_does_what_jax_does(rng, tmp_path, levels):
    model = random_model(rng, levels)
    controller = Controller(model, tmp_path)
    for state in STATES:
        voltage_V = nested_voltages(rng, *limits_V(model), SAMPLES)
        voltage_V[rng.integers(SAMPLES, size=12)] = np.repeat(limits_V(model), 6)
        controller.start(state)
        displacement_um, status = controller.forward(voltage_V)
        assert not status.any()
        expected_um, _ = play(model, voltage_V, starts(model, size=64)[state])
        np.testing.assert_allclose(displacement_um, expected_um, rtol=0, atol=1e-12 * stroke_um(model))

        reference_um = nested_voltages(rng, *ends_um(model), SAMPLES)
        controller.start(state)
        found_V, status = controller.inverse(reference_um)
        assert not status.any()
        expected_V = inverted(model, jnp.asarray(reference_um), starts(model, size=64)[state])
        np.testing.assert_allclose(found_V, expected_V, rtol=0, atol=1e-9)
        output_um, _ = play(model, found_V, starts(model, size=64)[state])
        np.testing.assert_allclose(output_um, reference_um, rtol=0, atol=1e-12 * stroke_um(model))


@needs_compiler
def test_both_functions_share_the_memory(rng, tmp_path):
    model = random_model(rng)
    controller = Controller(model, tmp_path)
    controller.start("negative")
    before_V = nested_voltages(rng, *limits_V(model), 100)
    reference_um = nested_voltages(rng, *ends_um(model), 100)
    controller.forward(before_V)
    found_V, _ = controller.inverse(reference_um)
    output_um, _ = play(model, np.append(before_V, found_V))
    np.testing.assert_allclose(output_um[100:], reference_um, rtol=0, atol=1e-12 * stroke_um(model))


@needs_compiler
@pytest.mark.parametrize("state", STATES)
def test_limits_bind_as_they_do_in_compensate(rng, tmp_path, state):
    """One sample after the other here, the whole reference at once there."""
    model = random_model(rng)
    lower_V, upper_V = limits_V(model)
    limits = tuple(lower_V + (upper_V - lower_V) * np.array([rng.uniform(0.05, 0.4), rng.uniform(0.6, 0.95)]))
    controller = Controller(model, tmp_path, limits=limits)
    wanted_um = nested_voltages(rng, ends_um(model)[0] - 1, ends_um(model)[1] + 1, SAMPLES)
    controller.start(state)
    found_V, status = controller.inverse(wanted_um)
    expected = compensate(model, Reference(np.arange(SAMPLES), wanted_um), state, clip=True, limits_V=limits)
    np.testing.assert_allclose(found_V, expected.voltage_V, rtol=0, atol=1e-8)
    assert expected.clipped.any()
    np.testing.assert_array_equal(status, np.where(expected.clipped, CLIPPED, 0))


@needs_compiler
def test_what_cannot_be_done_is_said(rng, tmp_path):
    model = random_model(rng)
    (lower_V, upper_V), (lowest_um, highest_um) = limits_V(model), ends_um(model)
    controller = Controller(model, tmp_path)
    controller.start("negative")
    found_V, status = controller.inverse(np.array([highest_um + 1, lowest_um - 1, np.inf, np.nan, highest_um]))
    # What is out of reach ends on the limit itself; what is just within reach is found, to rounding.
    np.testing.assert_array_equal(found_V[:4], [upper_V, lower_V, upper_V, upper_V])
    np.testing.assert_allclose(found_V[4], upper_V, rtol=1e-13)
    np.testing.assert_array_equal(status, [CLIPPED, CLIPPED, CLIPPED, NOT_A_NUMBER, 0])
    found_um, status = controller.forward(np.array([lower_V - 1, np.nan, upper_V + 1, lower_V]))
    np.testing.assert_allclose(found_um, [lowest_um, lowest_um, highest_um, lowest_um], rtol=0, atol=1e-11)
    np.testing.assert_array_equal(status, [CLIPPED, NOT_A_NUMBER, CLIPPED, 0])


@needs_compiler
def test_a_full_memory_drops_the_smallest_swing(rng, tmp_path):
    model = random_model(rng)
    controller = Controller(model, tmp_path, size=PLACES)
    lowest_um, highest_um = ends_um(model)
    width_um = np.linspace(0.45, 0.02, 2 * PLACES) * (highest_um - lowest_um)
    nested_um = (lowest_um + highest_um) / 2 + np.where(np.arange(2 * PLACES) % 2, 1, -1) * width_um
    controller.start("negative")
    found_V, status = controller.inverse(nested_um)
    assert set(status) == {0, FORGOTTEN}
    first = int(np.argmax(status == FORGOTTEN))
    output_um, _ = play(model, found_V)
    off_um = np.abs(output_um - nested_um)
    assert off_um[:first].max() < 1e-12 * stroke_um(model)
    assert off_um.max() <= 2 * width_um[first - 2]
    # A loop around all that was dropped leaves no trace of it.
    controller.inverse(np.array([highest_um, lowest_um]))
    reference_um = nested_voltages(rng, lowest_um, highest_um, 20)
    found_V, status = controller.inverse(reference_um)
    assert not status.any()
    output_um, _ = play(model, found_V, starts(model, size=64)["negative"])
    np.testing.assert_allclose(output_um, reference_um, rtol=0, atol=1e-12 * stroke_um(model))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"name": "axis-z"}, "axis-z"),
        ({"name": "1axis"}, "1axis"),
        ({"name": ""}, "name: expected"),
        ({"size": 4}, "memory: expected"),
        ({"limits_V": (-1e3, 20)}, "voltage limits"),
    ],
)
def test_bad_requests_write_nothing(rng, tmp_path, options, words):
    with pytest.raises(DataError, match=words):
        export_c(random_model(rng), tmp_path / "c", **options)
    assert files(tmp_path) == []


def test_the_same_model_gives_the_same_files_and_no_placeholders(rng, tmp_path):
    model = random_model(rng)
    first, second = (export_c(model, tmp_path / folder, "stage") for folder in ("a", "b"))
    assert [path.name for path in first] == ["stage.h", "stage.c"]
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()
        assert "$" not in one.read_text()
        assert max(map(len, one.read_text().splitlines())) <= 130


def test_the_command_refuses_what_is_no_model(tmp_path):
    (tmp_path / "m.json").write_text("{}")
    refused(run("export", tmp_path / "m.json", "--out", tmp_path / "c"), "m.json")
    assert files(tmp_path) == ["m.json"]
