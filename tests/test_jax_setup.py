"""How the command has JAX compile: fast, unless the user's own flags say otherwise."""

import os

import pytest

from fits.io import _jax_setup


@pytest.mark.parametrize("stated", ["", "--xla_backend_optimization_level=3 --xla_cpu_multi_thread_eigen=false"])
def test_flags_of_the_user_come_before_the_commands(stated, monkeypatch):
    monkeypatch.setattr(_jax_setup, "_cache_folder", lambda: None)
    monkeypatch.setenv("XLA_FLAGS", stated)
    for _ in range(2):  # a second start adds nothing
        _jax_setup.start_jax()
        flags = os.environ["XLA_FLAGS"].split()
        names = [flag.partition("=")[0] for flag in flags]
        assert len(set(names)) == len(names)
        assert set(stated.split()) <= set(flags)
        assert "--xla_cpu_parallel_codegen_split_count=1" in flags
