"""Blocks of rows on all local devices: as many blocks as there are devices are one array, sharded over them."""

import inspect
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import wraps
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

_ROWS = "rows"


def block_rows(samples: int) -> int:
    """Rows to compute together: a power of two that depends on the number of samples alone."""
    # A row needs 30 arrays of one value per sample at a time, and all rows of a block may need 128 MB.
    fit = 128e6 / (8 * 30 * samples)
    return int(min(256, 2 ** max(0, int(np.log2(max(fit, 1.0))))))


def place(rows: Any) -> Any:
    """Put arrays on the devices, a block of their first axis on each, or on one if they cannot share it evenly."""
    if _shares(rows) == 1:
        return jax.tree.map(jnp.asarray, rows)
    mesh = Mesh(np.array(jax.local_devices()), (_ROWS,))
    return jax.device_put(rows, NamedSharding(mesh, PartitionSpec(_ROWS)))


def by_rows(*own: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function of rows; where these are on several devices, each runs it for its own, with no exchange.

    `own` names the arguments whose arrays have the rows along their first axis, as all results have. Other arrays
    belong to all rows. Arguments are taken by place.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        names = tuple(inspect.signature(function).parameters)
        specs = tuple(PartitionSpec(_ROWS) if name in own else PartitionSpec() for name in names)
        first, whole = names.index(own[0]), eqx.filter_jit(function)

        @eqx.filter_jit
        def shared(mesh: Any, arguments: tuple[Any, ...]) -> Any:
            arrays, others = eqx.partition(arguments, eqx.is_array)
            run = jax.shard_map(
                lambda arrays: function(*eqx.combine(arrays, others)),
                mesh=mesh,
                in_specs=(specs,),
                out_specs=PartitionSpec(_ROWS),
                # It would refuse loops that start from constants, and nothing is exchanged that needs the check.
                check_vma=False,
            )
            return run(arrays)

        @wraps(function)
        def called(*arguments: Any) -> Any:
            sharding = getattr(jax.tree.leaves(arguments[first])[0], "sharding", None)
            if not isinstance(sharding, NamedSharding) or sharding.num_devices == 1:
                return whole(*arguments)
            return shared(sharding.mesh, arguments)

        return called

    return decorate


def on_cpu() -> AbstractContextManager[Any]:
    """Compute on one CPU what follows."""
    return jax.default_device(jax.local_devices(backend="cpu")[0])


def in_turn(function: Callable[..., Any], *rows: Any) -> Any:
    """Call a function for block after block on one CPU; arguments and results have the rows along their first axis.

    For what LAPACK does: eigenvalues of general matrices are found nowhere else, and in jaxlib 0.10 the threads of
    several CPU devices that factor many matrices at once wait for each other for ever.
    """
    count, found = _shares(rows), []
    with on_cpu():
        for k in range(count):
            block = jax.tree.map(lambda each, k=k: jnp.asarray(np.split(each, count)[k]), rows)
            found.append(jax.device_get(function(*block)))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *found)


def _shares(rows: Any) -> int:
    count = jax.local_device_count()
    return 1 if any(len(leaf) % count for leaf in jax.tree.leaves(rows)) else count
