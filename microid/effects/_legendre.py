"""Curves over a range as sums of Legendre's polynomials."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float


def _legendre(place: Float[Array, "..."], parts: Sequence[Float[Array, ""]], first: int = 1) -> Float[Array, "..."]:
    """A sum of polynomials from degree `first`, at least 1, on, at places from -1 to 1 (Bonnet's recursion)."""
    before, here, found = jnp.ones_like(place), place, jnp.zeros_like(place)
    for degree in range(1, first + len(parts)):
        if degree >= first:
            found = found + parts[degree - first] * here
        before, here = here, ((2 * degree + 1) * place * here - degree * before) / (degree + 1)
    return found
