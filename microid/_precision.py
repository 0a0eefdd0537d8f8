"""How exactly matrices are multiplied."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

_P = ParamSpec("_P")
_T = TypeVar("_T")


def _full_precision(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Multiply matrices with all digits: by default a GPU keeps ten bits of factors in single precision."""

    @wraps(function)
    def called(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return called
