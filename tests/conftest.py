"""Strict numerics for every test, and randomness that prints itself."""

import atexit
import gc
import inspect
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import matplotlib as mpl
import numpy as np
import pytest
from _seed import seed_of
from hypothesis import settings

import fits

# For notebooks and commands that tests start: threads of several processes wait for each other in a busy loop.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Tests compile much and compute little: what makes code fast is not worth its time here. Without the fusion emitters
# most programs compile in half the time, but wrongly if nothing is fused (`xla_disable_hlo_passes=fusion`).
QUICK = ["backend_optimization_level=0", "cpu_parallel_codegen_split_count=1", "llvm_disable_expensive_passes=true"]
if jax.__version_info__ < (0, 11):  # later ones have no other emitters, and XLA aborts at a flag it does not know
    QUICK.append("cpu_use_fusion_emitters=false")
os.environ.setdefault("XLA_FLAGS", " ".join(f"--xla_{flag}" for flag in QUICK))
# What one process has compiled the others, and the commands and notebooks they start, take from here.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="microid-tests-")
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
# JAX itself has read the environment by now.
jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
jax.config.update(
    "jax_persistent_cache_min_compile_time_secs", float(os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"])
)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
mpl.use("Agg")
settings.register_profile("fixed", derandomize=True)
if os.environ.get("MICROID_SEED") != "fresh":
    settings.load_profile("fixed")
# Tracing makes many objects and few cycles.
gc.set_threshold(100_000, 50, 100)

# Files that take longest: were one of them the last to begin, one worker would wait for the other.
LONGEST = (
    "test_hidden_effect",
    "test_plugins",
    "test_fit",
    "test_cli_stage",
    "test_tune",
    "test_synth_effects",
    "test_fit_slow",
    "test_cli",
    "test_effects",
    "test_control_loop",
    "test_fit_free_stage",
    "test_kinetostatics",
    "test_sweep_run",
    "test_sweep_kinds",
)


def pytest_configure(config: pytest.Config) -> None:
    """Keep the order below, where xdist would begin with the files of most tests."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let the longest files begin first, so that both workers end together."""
    place = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(LONGEST)))


def pytest_collection_finish() -> None:
    """Look no more for garbage among what was imported and collected."""
    gc.freeze()


# Every compiled function maps some memory, of which a process on Linux may have 65530 pieces. Beyond that it crashes.
# One diagnosis takes up to 35,000. Between the tests of a module less is forgotten, as they share what is compiled.
_BETWEEN_MODULES, _BETWEEN_TESTS = 20_000, 30_000


def _forget_beyond(most: int) -> None:
    mappings = Path("/proc/self/maps")
    if mappings.exists() and mappings.read_bytes().count(b"\n") > most:
        jax.clear_caches()


@pytest.fixture(autouse=True, scope="module")
def _few_mappings_before_a_module() -> None:
    _forget_beyond(_BETWEEN_MODULES)


@pytest.fixture(autouse=True)
def _few_mappings() -> Iterator[None]:
    began = time.monotonic()
    yield
    # To count them takes a while, too, and what is quick has compiled little.
    if time.monotonic() - began > 1:
        _forget_beyond(_BETWEEN_TESTS)


@pytest.fixture(autouse=True, scope="session")
def _unhurried() -> None:
    """However busy the machine is, no diagnosis is cut off that is given no budget."""
    if (defaults := inspect.unwrap(fits.diagnose).__kwdefaults__) is not None:
        defaults["budget_s"] = 3000.0


@pytest.fixture
def seed(request: pytest.FixtureRequest) -> int:
    """The test's own seed, printed when the test fails; MICROID_SEED=fresh draws another, a number replays it."""
    return seed_of(request.node.nodeid)


@pytest.fixture
def rng(seed: int) -> np.random.Generator:
    """A NumPy generator made from the printed seed."""
    return np.random.default_rng(seed)
