"""What computes in one thread, and what in as many as there are processors."""

import contextvars
import functools
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar

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


def map_in_threads(function: Callable[..., R], *items: Iterable[Any]) -> list[R]:
    """What `map` gives, computed in as many threads as this process has processors.

    It pays where compiled programs or linear algebra take the time, which do not hold the interpreter. Where the
    environment gives linear algebra one thread, as in each worker of a sweep, and inside another call, one is used.
    """
    given = list(zip(*items, strict=True))
    pool = _pool()
    if pool is None or len(given) < 2 or getattr(_here, "inside", False):
        return [function(*each) for each in given]
    # Settings of NumPy, as of what becomes of an overflow, are those of the caller.
    tasks = [pool.submit(contextvars.copy_context().run, function, *each) for each in given]
    try:
        return [task.result() for task in tasks]
    finally:
        for task in tasks:
            task.cancel()


_here = threading.local()


def _enter() -> None:
    _here.inside = True


@functools.cache
def _pool() -> ThreadPoolExecutor | None:
    stated = [int(os.environ[name]) for name in _STATED if os.environ.get(name, "").isdigit()]
    count = min([*stated, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1])
    return ThreadPoolExecutor(count, "microid", _enter) if count > 1 else None
