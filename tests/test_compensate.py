"""Feedforward: what is followed, clipped and refused, from Python and from the command."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from _command import files, refused, run, says_the_same_with_jax, whole_picture
from _models import ends_um, limits_V, nested_voltages, play, random_model, starts, stroke_um

from fits import (
    DataError,
    Record,
    Reference,
    Uncertainty,
    compensate,
    plot_compensation,
    read_reference,
    save_model,
)
from fits.loop._design import Grid

STATES = ("negative", "positive", "demagnetised")
SAMPLES = 200


def reference(wanted_um):
    return Reference(np.arange(len(wanted_um)) / 100, wanted_um, "wanted.csv")


@pytest.mark.parametrize("state", STATES)
def test_the_model_follows_and_says_so(rng, state):
    model = random_model(rng)
    wanted_um = nested_voltages(rng, *ends_um(model), SAMPLES)
    found = compensate(model, reference(wanted_um), state)
    assert not found.clipped.any()
    tolerance_um = 1e-12 * stroke_um(model)
    np.testing.assert_allclose(found.displacement_um, wanted_um, rtol=0, atol=tolerance_um)
    again_um, _ = play(model, found.voltage_V, starts(model)[state])
    np.testing.assert_allclose(found.displacement_um, again_um, rtol=0, atol=tolerance_um)
    # A measured run is a reference, too.
    of_a_run = compensate(model, Record(np.arange(SAMPLES), np.zeros(SAMPLES), wanted_um), state)
    np.testing.assert_array_equal(of_a_run.voltage_V, found.voltage_V)


@pytest.mark.parametrize("state", STATES)
def test_limits_are_kept_and_bind_only_where_they_must(rng, state):
    for _ in range(3):
        model = random_model(rng)
        lower_V, upper_V = limits_V(model)
        low_V, high_V = lower_V + (upper_V - lower_V) * np.array([rng.uniform(0, 0.4), rng.uniform(0.6, 1)])
        lowest_um, highest_um = ends_um(model)
        wanted_um = nested_voltages(rng, lowest_um - 1, highest_um + 1, SAMPLES)
        found = compensate(model, reference(wanted_um), state, clip=True, limits_V=(low_V, high_V))
        assert found.voltage_V.min() >= low_V
        assert found.voltage_V.max() <= high_V
        output_um, _ = play(model, found.voltage_V, starts(model)[state])
        off_um = wanted_um - output_um
        np.testing.assert_allclose(off_um[~found.clipped], 0, atol=1e-8 * stroke_um(model))
        # Too much is asked for where the voltage is as high as it may be, and too little where it is as low.
        assert found.clipped.any()
        at_um = np.where(off_um > 0, high_V, low_V)
        np.testing.assert_allclose(found.voltage_V[found.clipped], at_um[found.clipped], rtol=0, atol=1e-8)


def test_refusals_name_sample_range_cause_and_remedy(rng):
    model = random_model(rng)
    lowest_um, highest_um = ends_um(model)
    wanted_um = np.linspace(lowest_um, highest_um, SAMPLES)
    wanted_um[[70, 90]] = highest_um + 0.5, lowest_um - 0.5
    with pytest.raises(DataError) as refusal:
        compensate(model, reference(wanted_um))
    for words in (
        "wanted.csv",
        "sample 71",
        "0.7 s",
        f"{lowest_um:.6g} to {highest_um:.6g} um",
        "fitted",
        "(clip=True)",
    ):
        assert words in str(refusal.value)
    assert f"2 of {SAMPLES} samples" in str(refusal.value)
    assert np.flatnonzero(compensate(model, reference(wanted_um), clip=True).clipped).tolist() == [70, 90]

    # On the way up from negative saturation a limit can be reached on the first branch only.
    high_V = float(np.mean(limits_V(model)))
    highest_um = float(play(model, np.array([high_V]))[0][0])
    with pytest.raises(DataError) as refusal:
        compensate(model, reference(np.array([lowest_um, highest_um, highest_um + 0.1])), limits_V=(limits_V(model)[0], high_V))  # fmt: skip  # noqa: E501
    for words in ("sample 3", f"{highest_um:.6g} um", "limited", f"{high_V:g} V"):
        assert words in str(refusal.value)
    # Files round: the last digit is not worth a refusal.
    compensate(model, reference(np.array([lowest_um, ends_um(model)[1] * (1 + 1e-13) + 1e-12])))


@pytest.mark.parametrize("limits", [(-1e3, 20), (50, 50), (60, 50), (20, 1e3), (float("nan"), 50)])
def test_limits_that_make_no_sense_are_refused(rng, limits):
    model = random_model(rng)
    with pytest.raises(DataError, match="voltage limits: expected two rising ones"):
        compensate(model, reference(np.full(3, ends_um(model)[0])), limits_V=limits)


def test_a_record_without_displacement_is_no_reference(rng):
    with pytest.raises(DataError, match="displacement"):
        compensate(random_model(rng), Record(np.arange(3.0), np.zeros(3), None, source="program.csv"))
    with pytest.raises(ValueError, match="shape"):
        Reference(np.arange(3.0), np.zeros(4))


def test_references_are_read_in_any_unit_and_need_no_voltage(tmp_path):
    path = tmp_path / "wanted.csv"
    path.write_text("note,t_ms,displacement_nm,voltage_V\nx,0,1000,?\ny,10,2500,?\n")
    read = read_reference(path, {"time_s": "t_ms"})
    np.testing.assert_allclose(read.time_s, [0, 0.01])
    np.testing.assert_allclose(read.displacement_um, [1, 2.5])
    assert (len(read), read.source) == (2, "wanted.csv")
    for text, words in (
        ("time_s,voltage_V\n0,1\n", "displacement_um"),
        ("time_s,displacement_um\n0,1\n0,2\n", "increasing"),
        ("time_s,displacement_um\n0,high\n", "high"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=words):
            read_reference(path)


@pytest.fixture
def model_file(tmp_path, rng):
    """A model in a file, with a made-up uncertainty."""
    model = random_model(rng)
    lower_V, upper_V = map(jnp.asarray, limits_V(model))
    grid = Grid(lower_V, upper_V, model.density.levels)
    columns_um = jnp.asarray(rng.normal(scale=1e-3, size=(2, grid.columns)))
    uncertainty = Uncertainty(columns_um, jnp.zeros(2), jnp.asarray(0.01), grid)
    save_model(tmp_path / "m.json", model, uncertainty, {})
    return model, tmp_path / "m.json"


def read(path):
    header, *rows = path.read_text().splitlines()
    return header, np.array([row.split(",") for row in rows], dtype=float).T


def test_the_command_writes_a_voltage_and_a_plot(rng, model_file, tmp_path):
    model, path = model_file
    lowest_um, highest_um = ends_um(model)
    share = rng.uniform(0.1, 0.9, 40)
    wanted_um = lowest_um + share * (highest_um - lowest_um)
    csv, out = tmp_path / "r.csv", tmp_path / "v.csv"
    csv.write_text("time_s,displacement_um\n" + "".join(f"{k},{w!r}\n" for k, w in enumerate(wanted_um.tolist())))
    result = run("compensate", path, csv, "--out", out, "--plots", tmp_path / "plots", "--initial", "demagnetised")
    assert result.exit_code == 0, result.stderr
    for words in ("40 samples", "offset", "v.csv", "compensation.png"):
        assert words in result.stdout
    header, (time_s, voltage_V, displacement_um) = read(out)
    assert header == "time_s,voltage_V,displacement_um"
    np.testing.assert_array_equal(time_s, np.arange(40))
    expected_um, _ = play(model, voltage_V, starts(model)["demagnetised"])
    np.testing.assert_allclose(expected_um, wanted_um, rtol=0, atol=1e-11 * stroke_um(model))
    np.testing.assert_allclose(displacement_um, wanted_um, rtol=0, atol=1e-11 * stroke_um(model))
    whole_picture(tmp_path / "plots" / "compensation.png")

    csv.write_text(f"time_s,displacement_um\n0,{lowest_um}\n1,{highest_um + 1}\n")
    refused(run("compensate", path, csv, "--out", tmp_path / "w.csv"), "r.csv", "sample 2", "clipped", "(--clip)")
    lower_V, upper_V = limits_V(model)
    high_V = 0.3 * lower_V + 0.7 * upper_V
    clipped = run("compensate", path, csv, "--out", out, "--clip", f"--limits={lower_V},{high_V}", "--json")
    summary = json.loads(clipped.stdout)
    assert (summary["clipped"], summary["samples"], summary["voltage_max_V"]) == (1, 2, high_V)
    assert summary["offset_um"] == lowest_um
    assert summary["error_max_um"] > 1
    assert summary["error_max_within_reach_um"] < 1e-9


def test_the_command_refuses_in_one_sentence(model_file, tmp_path):
    model, path = model_file
    csv, out = tmp_path / "r.csv", tmp_path / "v.csv"
    csv.write_text(f"time_s,displacement_um\n0,{float(model.offset_um)}\n")
    before = files(tmp_path)
    refused(run("compensate", path, csv, "--out", out, "--dynamic"), "m.json", "mechanics", "--dynamic")
    refused(run("compensate", path, csv, "--out", csv), "overwrite")
    refused(run("compensate", path, csv, "--out", tmp_path / "v.xlsx"), "v.xlsx: expected a name that ends in .csv")
    refused(run("control", path, csv, "--out", tmp_path / "v.mat"), "v.mat: expected a name that ends in .csv")
    refused(run("compensate", path, csv, "--out", out, "--limits", "ten,20"), "--limits", "ten,20")
    refused(run("compensate", path, csv, "--out", out, "--limits", "90,20"), "--limits", "90,20")
    refused(run("compensate", path, tmp_path / "none.csv", "--out", out), "none.csv")
    refused(run("compensate", csv, csv, "--out", out), "r.csv")
    assert files(tmp_path) == before
    assert run("compensate", path, csv, "--out", out, "--static").exit_code == 0
    assert run("compensate", path, csv, "--out", tmp_path / "v.npz").exit_code == 0
    assert np.load(tmp_path / "v.npz")["voltage_V"].tolist() == [read(out)[1][1][0]]


def test_a_program_beyond_the_range_by_the_noise_of_a_readback_is_taken_at_its_end(model_file, tmp_path, monkeypatch):
    model, path = model_file
    lower_V, upper_V = limits_V(model)
    csv, out, found = tmp_path / "program.csv", tmp_path / "p.csv", []
    for beyond in (0.0, 5e-4, 2e-3):
        highest_V = upper_V + beyond * (upper_V - lower_V)
        csv.write_text(f"time_s,voltage_V\n0,{lower_V}\n1,{highest_V!r}\n2,{(lower_V + upper_V) / 2}\n")
        says_the_same_with_jax(monkeypatch, ["simulate", path, csv], out)
        done = run("simulate", path, csv, "--out", out, "--json")
        if beyond < 1e-3:
            found.append((read(out)[1], json.loads(done.stdout)["remarks"]))
    refused(done, "sample 2", f"asks for {highest_V:g} V", "clip the program")
    (plain, nothing), (noisy, said) = found
    np.testing.assert_array_equal(noisy[2], plain[2])
    assert noisy[1][1] > plain[1][1] == upper_V
    assert nothing == []
    assert "at 1 of 3 samples the voltage is beyond" in said[0]
    assert "taken as the end of that" in said[0]


def test_a_reference_at_rest_can_be_drawn(rng, tmp_path):
    model = random_model(rng)
    wanted = reference(np.full(60, np.mean(ends_um(model))))
    found = compensate(model, wanted)
    assert np.ptp(found.voltage_V) == 0
    (path,) = plot_compensation(model, wanted, found, np.full(60, 0.01), tmp_path)
    assert path.exists()
