"""Linear algebra in one thread."""

import functools
import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
_STATED = "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"


def one_thread(function: Callable[P, R], with_scipy: bool = True) -> Callable[P, R]:
    """Let linear algebra use one thread while a function runs, unless the environment says otherwise.

    Matrices of a few hundred rows are factored no faster by more, and far more slowly where other processes run: the
    threads wait for each other. What does without SciPy need not wait for it to be imported.
    """

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        if any(name in os.environ for name in _STATED):
            return function(*args, **kwargs)
        from threadpoolctl import threadpool_limits

        if with_scipy:
            import scipy.linalg  # noqa: F401  it brings a library of its own, which must be there to be limited

        with threadpool_limits(1, "blas"):
            return function(*args, **kwargs)

    return run
