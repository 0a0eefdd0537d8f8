"""What is computed in threads is what one thread computes; and those of linear algebra, as the libraries say."""

import os
import threading

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from fits.io import _threads
from fits.io._threads import map_in_threads, one_thread


def threads():
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@pytest.mark.parametrize("stated", [None, "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"])
def test_linear_algebra_has_one_thread_unless_the_environment_says_otherwise(monkeypatch, stated):
    for name in _threads._STATED:
        monkeypatch.delenv(name, raising=False)
    if stated:
        monkeypatch.setenv(stated, "2")
    with threadpool_limits(2, "blas"):
        before = threads()
        within = one_thread(threads)()
        assert within == ({1} if stated is None else before)
        assert threads() == before


@pytest.fixture
def pool(monkeypatch):
    """Two threads, however many processors there are."""
    pool = _threads.ThreadPoolExecutor(2, "test", _threads._enter)
    monkeypatch.setattr(_threads, "_pool", lambda: pool)
    yield pool
    pool.shutdown()


def test_results_come_in_the_order_of_what_was_given(pool, rng):
    first, second = rng.normal(size=50), rng.normal(size=50)
    assert map_in_threads(lambda a, b: a - b, first, second) == [*(first - second)]


def test_two_compute_at_once(pool):
    met = threading.Barrier(2, timeout=30)
    # Each waits for the other: one after the other they would never go on.
    assert sorted(map_in_threads(lambda _: met.wait(), range(2))) == [0, 1]


def test_inside_another_call_one_thread_is_used(pool):
    def inner(_):
        return threading.current_thread().name

    def outer(_):
        return threading.current_thread().name, set(map_in_threads(inner, range(8)))

    assert all(names == {own} for own, names in map_in_threads(outer, range(4)))


def test_an_error_is_raised_and_settings_of_numpy_are_the_callers(pool):
    def divide(x):
        return float(np.float64(1.0) / np.float64(x))

    with np.errstate(divide="raise"), pytest.raises(FloatingPointError):
        map_in_threads(divide, [1.0, 0.0])
    with np.errstate(divide="ignore"):
        assert map_in_threads(divide, [2.0, 0.0]) == [0.5, np.inf]


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="processors of a process are not told here")
@pytest.mark.parametrize("stated", [None, "1", "3"])
def test_as_many_threads_as_processors_or_as_are_stated(monkeypatch, stated):
    for name in _threads._STATED:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(4)))
    if stated:
        monkeypatch.setenv("OMP_NUM_THREADS", stated)
    pool = _threads._pool.__wrapped__()
    assert (1 if pool is None else pool._max_workers) == int(stated or 4)
