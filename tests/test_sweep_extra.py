"""What is said where a package of an extra is missing."""

import sys

import pytest
from _command import refused, run
from _sweeps import small

from fits import DataError
from fits.sweeps._store import need


@pytest.mark.parametrize(
    ("package", "extras"), [("zarr", "[sweep]"), ("pyarrow", "[sweep]"), ("distributed", "[sweep,cluster]")]
)
def test_a_missing_package_is_one_sentence(monkeypatch, package, extras):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(DataError) as missing:
        need(package)
    assert f'pip install "microid{extras}"' in str(missing.value)


def test_the_command_says_it_before_it_computes(monkeypatch, tmp_path, seed):
    monkeypatch.setitem(sys.modules, "zarr", None)
    (tmp_path / "sweep.toml").write_text(small(seed))
    refused(run("sweep", tmp_path / "sweep.toml", "--out", tmp_path / "out"), 'pip install "microid[sweep]"')
    assert not (tmp_path / "out").exists()


def test_an_interrupted_sweep_goes_on(monkeypatch, tmp_path, seed):
    from fits.sweeps import _run

    (tmp_path / "sweep.toml").write_text(small(seed))
    compute, out = _run.compute_chunk, tmp_path / "out"

    def interrupted(sweep, chunk, tell):
        if chunk == 1:
            raise KeyboardInterrupt
        return compute(sweep, chunk, tell)

    monkeypatch.setattr(_run, "compute_chunk", interrupted)
    stopped = run("sweep", tmp_path / "sweep.toml", "--out", out, "--quiet")
    assert (stopped.exit_code, stopped.stdout) == (130, "")
    assert stopped.stderr == "Interrupted: what was computed is kept; go on with --resume.\n"
    monkeypatch.setattr(_run, "compute_chunk", compute)
    assert "344 computed" in run("sweep", tmp_path / "sweep.toml", "--out", out, "--resume").stdout
