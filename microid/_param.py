"""Parameters that carry their unit, scale and bounds, and the coordinates a solver sees."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

_KEY = "microid.param"
_Model = TypeVar("_Model")


@dataclass(frozen=True)
class ParameterSpec:
    """What is known of a parameter before any data: its unit, scale and bounds.

    Attributes
    ----------
    unit
        Unit of the value, such as `"um"`; `"1"` where there is none.
    scale
        A typical magnitude in that unit. Solvers see `value / scale`.
    lower, upper
        Bounds in that unit, `-inf` and `inf` where there are none.
    """

    unit: str
    scale: float
    lower: float
    upper: float


@dataclass(frozen=True)
class ParameterInfo:
    """One row of `parameter_table`: where a parameter stands in a model, and its specification."""

    path: str
    shape: tuple[int, ...]
    spec: ParameterSpec


def _as_inexact(value: Any) -> Any:
    # A bare asarray keeps Python floats weakly typed, and each new value would retrace.
    if isinstance(value, eqx.Module):
        return value
    keep = getattr(value, "dtype", None)
    if keep is not None and jnp.issubdtype(keep, jnp.inexact):
        return jnp.asarray(value, dtype=keep)
    return jnp.asarray(value, dtype=float)


def _within(value: Any, name: str, spec: ParameterSpec) -> Any:
    """The value of a parameter as an array; a number that is out of bounds is refused, an array is a solver's."""
    if isinstance(value, int | float):
        _refuse_outside(spec, np.asarray(value), name)
    return _as_inexact(value)


def array(*, default: float | None = None) -> Any:
    """Declare an array field that is data, not a parameter: the voltage range, say.

    Its default is in the unit of the field; without one a value must be given.
    """
    given: dict[str, Any] = {} if default is None else {"default": default}
    return eqx.field(converter=_as_inexact, **given)


def static() -> Any:
    """Declare a field that is part of a model's structure: the number of levels, say."""
    return eqx.field(static=True)


def param(
    *,
    unit: str,
    scale: float = 1.0,
    lower: float = -math.inf,
    upper: float = math.inf,
    default: float | None = None,
) -> Any:
    """Declare a field that can be fitted, with its unit, scale and bounds beside it.

    Every floating-point array at or below the field is a parameter. Bounds become bijections in
    `Coordinates`; no solver option is involved. A plain number that is put into the field and is out of bounds, or no
    number, raises a `ValueError`.

    Parameters
    ----------
    unit, scale, lower, upper
        See `ParameterSpec`.
    default
        What the field is if nothing is said; by default it must be given.

    Raises
    ------
    ValueError
        If the scale is not positive or the bounds are not in order.
    """
    if not scale > 0:
        raise ValueError(f"scale must be positive, got {scale}")
    if not lower < upper:
        raise ValueError(f"lower must be less than upper, got {lower} and {upper}")
    spec = ParameterSpec(unit, float(scale), float(lower), float(upper))
    given: dict[str, Any] = {} if default is None else {"default": default}
    # A class gives its fields their names.
    made: Any = eqx.field(converter=lambda value: _within(value, made.name, spec), metadata={_KEY: spec}, **given)
    return made


def _spec_of(model: Any, path: tuple[Any, ...]) -> ParameterSpec | None:
    """Find the specification of the innermost declared field on the way to a leaf."""
    spec, node = None, model
    for entry in path:
        if isinstance(entry, jax.tree_util.GetAttrKey):
            if isinstance(node, eqx.Module):
                fields = {f.name: f for f in _fields(node)}
                spec = fields[entry.name].metadata.get(_KEY, spec) if entry.name in fields else spec
            node = getattr(node, entry.name)
        elif isinstance(entry, jax.tree_util.SequenceKey):
            node = node[entry.idx]
        elif isinstance(entry, jax.tree_util.DictKey):
            node = node[entry.key]
    return spec


def _fields(node: eqx.Module) -> tuple[Any, ...]:
    return tuple(getattr(type(node), "__dataclass_fields__", {}).values())


def _walk(model: Any) -> list[tuple[str, Any, ParameterSpec | None]]:
    """Visit every leaf in JAX's own order: the only walk over parameters there is."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(model)
    found = []
    for path, leaf in leaves:
        fits = eqx.is_inexact_array(leaf)
        name = jax.tree_util.keystr(path).lstrip(".")
        found.append((name, leaf, _spec_of(model, path) if fits else None))
    return found


def parameter_table(model: PyTree) -> tuple[ParameterInfo, ...]:
    """List the parameters of a model in the order of the solver's coordinates.

    Parameters
    ----------
    model
        Any pytree of modules.

    Returns
    -------
    tuple of ParameterInfo
        Path, shape, unit, scale and bounds of every parameter.
    """
    return tuple(ParameterInfo(name, leaf.shape, spec) for name, leaf, spec in _walk(model) if spec is not None)


# Scale, lower and upper bound: what differs between parameters of a kind, which share one program. One by one, their
# operations would each be compiled.
_Bounds: TypeAlias = tuple[Float[Array, ""], Float[Array, ""] | None, Float[Array, ""] | None]


def _bounds(spec: ParameterSpec) -> Any:
    low, high = math.isfinite(spec.lower), math.isfinite(spec.upper)
    return spec.scale, spec.lower if low else None, spec.upper if high else None


@partial(jax.jit, inline=True)
def _constrain(z: Float[Array, "..."], bounds: _Bounds) -> Float[Array, "..."]:
    scale, lower, upper = bounds
    if lower is not None and upper is not None:
        return lower + (upper - lower) * jax.nn.sigmoid(z)
    if lower is not None:
        return lower + scale * jax.nn.softplus(z)
    return scale * z if upper is None else upper - scale * jax.nn.softplus(-z)


def _softplus_inverse(x: Float[Array, "..."]) -> Float[Array, "..."]:
    return x + jnp.log(-jnp.expm1(-x))


@partial(jax.jit, inline=True)
def _unconstrain(value: Float[Array, "..."], bounds: _Bounds) -> Float[Array, "..."]:
    scale, lower, upper = bounds
    # A value on its bound lies at infinity; a millionth of the scale inside is where solvers can start.
    margin = 1e-6
    if lower is not None and upper is not None:
        width = upper - lower
        fraction = (value - lower) / width
        # Bounds may be many decades apart, as those of a time constant.
        fraction = jnp.clip(fraction, margin * jnp.minimum(1.0, scale / width), 1 - margin)
        return jnp.log(fraction) - jnp.log1p(-fraction)
    if lower is not None:
        return _softplus_inverse(jnp.maximum((value - lower) / scale, margin))
    return value / scale if upper is None else -_softplus_inverse(jnp.maximum((upper - value) / scale, margin))


class Coordinates(eqx.Module, Generic[_Model]):
    """The map between a model and one flat vector of scaled, unbounded coordinates.

    Calling it with a vector gives the model. Parameters with bounds go through a softplus (one bound) or a
    logistic (two), so no vector can leave them; the others are divided by their scale.

    Attributes
    ----------
    size
        Number of coordinates.
    """

    _rest: PyTree
    _slots: tuple[tuple[int, ParameterInfo], ...] = eqx.field(static=True)
    _treedef: Any = eqx.field(static=True)

    def __init__(self, model: _Model, free: Callable[[ParameterInfo], bool] = lambda _: True):
        """Choose the coordinates of a model.

        Parameters
        ----------
        model
            Any pytree of modules; its values are kept for everything that is not free.
        free
            Says of each parameter whether it may move.

        Raises
        ------
        ValueError
            If no parameter is free.
        """
        leaves, self._treedef = jax.tree_util.tree_flatten(model)
        slots = []
        rest: list[Any] = []
        for index, (name, leaf, spec) in enumerate(_walk(model)):
            if spec is not None and free(ParameterInfo(name, leaf.shape, spec)):
                slots.append((index, ParameterInfo(name, leaf.shape, spec)))
                rest.append(None)
            else:
                rest.append(leaves[index])
        if not slots:
            raise ValueError("no parameter is free: nothing to fit")
        self._slots, self._rest = tuple(slots), rest

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return sum(math.prod(info.shape) for info in self.table)

    @property
    def table(self) -> tuple[ParameterInfo, ...]:
        """The parameters that are free, in the order of the coordinates."""
        return tuple(info for _, info in self._slots)

    def of(self, model: _Model) -> Float[Array, " size"]:
        """Read the coordinates of a model of the same structure.

        Raises
        ------
        ValueError
            If the model has another structure, or a concrete value lies outside its bounds.
        """
        leaves, treedef = jax.tree_util.tree_flatten(model)
        if treedef != self._treedef:
            raise ValueError("the model has another structure than the one these coordinates were made for")
        parts = []
        for index, info in self._slots:
            value = leaves[index]
            if not isinstance(value, jax.core.Tracer):
                _refuse_outside(info.spec, np.asarray(value))
            parts.append(jnp.ravel(_unconstrain(value, _bounds(info.spec))))
        return jnp.concatenate(parts)

    def values(self, vector: Float[Array, " size"]) -> Float[Array, " size"]:
        """The parameters themselves, in their units, that coordinates stand for: each depends on its own alone."""
        return jnp.concatenate([jnp.ravel(value) for _, value in self._constrained(vector)])

    def _constrained(self, vector: Float[Array, " size"]) -> list[tuple[int, Array]]:
        found, start = [], 0
        for index, info in self._slots:
            stop = start + math.prod(info.shape)
            found.append((index, _constrain(vector[start:stop].reshape(info.shape), _bounds(info.spec))))
            start = stop
        return found

    def __call__(self, vector: Float[Array, " size"]) -> _Model:
        """Build the model that has these coordinates."""
        leaves = list(self._rest)
        for index, value in self._constrained(vector):
            leaves[index] = value
        return jax.tree_util.tree_unflatten(self._treedef, leaves)


def _refuse_outside(spec: ParameterSpec, value: np.ndarray, name: str = "value") -> None:
    inside = (value >= spec.lower) & (value <= spec.upper)
    if not np.all(inside):
        worst, unit = float(value[~inside].flat[0]), spec.unit
        raise ValueError(f"{name} {worst:g} {unit} lies outside its bounds [{spec.lower:g}, {spec.upper:g}] {unit}")
