"""One algorithm for a CPU, and another for what computes many numbers at once."""

from collections.abc import Callable
from typing import Any

import jax
from jax import lax


def _by_platform(*operands: Any, cpu: Callable[..., Any], default: Callable[..., Any]) -> Any:
    """Give `cpu(*operands)` on a CPU, and `default(*operands)` on any other device; both give arrays alike.

    Where there is only a CPU the other is not even traced, which would take long: it is the larger one.
    """
    if jax.default_backend() == "cpu":
        return jax.jit(cpu)(*operands)
    return lax.platform_dependent(*operands, cpu=cpu, default=default)
