"""Strict numerics for every test, and randomness that prints itself."""

import os
import secrets
from collections.abc import Iterator
from pathlib import Path

import jax
import matplotlib as mpl
import numpy as np
import pytest

# For notebooks and commands that tests start: threads of several processes wait for each other in a busy loop.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
mpl.use("Agg")


# Every compiled function maps some memory, of which a process on Linux may have 65530 pieces. Beyond that it crashes.
_MAPPINGS = 15_000


@pytest.fixture(autouse=True, scope="module")
def _few_mappings() -> Iterator[None]:
    """Forget what was compiled, once there is too much of it."""
    yield
    mappings = Path("/proc/self/maps")
    if mappings.exists() and mappings.read_bytes().count(b"\n") > _MAPPINGS:
        jax.clear_caches()


@pytest.fixture
def seed() -> int:
    """A fresh seed, printed when the test fails; MICROID_SEED replays it."""
    value = int(os.environ.get("MICROID_SEED") or secrets.randbelow(2**31))
    print(f"replay with MICROID_SEED={value}")
    return value


@pytest.fixture
def rng(seed: int) -> np.random.Generator:
    """A NumPy generator made from the printed seed."""
    return np.random.default_rng(seed)
