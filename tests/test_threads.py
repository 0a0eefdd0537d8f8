"""Threads of linear algebra, as the libraries themselves say."""

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from fits.io._threads import one_thread


def threads():
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@pytest.mark.parametrize("stated", [None, "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"])
def test_linear_algebra_has_one_thread_unless_the_environment_says_otherwise(monkeypatch, stated):
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    if stated:
        monkeypatch.setenv(stated, "2")
    with threadpool_limits(2, "blas"):
        before = threads()
        within = one_thread(threads)()
        assert within == ({1} if stated is None else before)
        assert threads() == before
