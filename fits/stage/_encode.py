"""Models to JSON objects and back, guided by nothing but their fields."""

import base64
import binascii
import dataclasses
import inspect
import math
import re
import types
from typing import Any, Literal, Union, get_args, get_origin

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np

import microid
from fits.io._errors import DataError, shown
from fits.loop._design import Grid
from fits.loop._uncertainty import Uncertainty
from fits.stage._uncertainty import StageUncertainty
from microid import ParameterSpec

_ACTIVATIONS = {"tanh": jnp.tanh}
# In base64: one number per weight is worth reading; one per weight and perturbation of an uncertainty is not.
_PACKED = ("columns_um", "coordinates", "mean_um")
# Squares and products of what is larger overflow.
_LARGEST, _LARGEST_PLAIN = 1e30, 1000
_DTYPES = ("float32", "float64", "int32", "int64", "bool")


def encode(value: Any, unit: str = "1") -> Any:
    """JSON values of a module or a field's value; a `DataError` if it has none."""
    if isinstance(value, eqx.nn.MLP):
        return _encode_network(value, unit)
    if isinstance(value, eqx.Module):
        return _encode_module(value)
    if isinstance(value, jax.Array | np.ndarray):
        return _encode_array(np.asarray(value), unit)
    if isinstance(value, tuple):
        return [encode(item, unit) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        raise DataError("it holds a number that is not finite")
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise DataError(f"it holds a {type(value).__name__}, for which the format has no form")


def decode(item: Any, where: str, spec: ParameterSpec | None = None) -> Any:
    """Invert `encode`; a `DataError` that begins with `where` if anything is not as `encode` writes it."""
    if isinstance(item, list):
        return tuple(decode(entry, f"{where}[{index}]", spec) for index, entry in enumerate(item))
    if isinstance(item, int | float) and abs(item) > _LARGEST_PLAIN:
        # Levels and steps, whose squares are sizes of arrays.
        raise DataError(f"{where}: expected a number up to {_LARGEST_PLAIN} in size, found {shown(item)}")
    if not isinstance(item, dict):
        return item
    if "type" not in item:
        return _decode_array(item, where, spec)
    return _decode_network(item, where, spec) if item["type"] == "MLP" else _decode_module(item, where)


def _classes() -> dict[str, type[eqx.Module]]:
    """Find the classes that a file may name: nothing else is ever called."""
    homes = microid, microid.control, microid.densities, microid.effects, microid.hysteresis, microid.kinetostatics
    public = (getattr(home, name) for home in homes for name in dir(home) if name[0] != "_")
    models = (one for one in public if inspect.isclass(one) and issubclass(one, eqx.Module))
    plugins = (*microid.effects.EFFECTS, *microid.densities.FAMILIES.values(), *microid.hysteresis.LAWS.values())
    known: list[Any] = [one for one in models if not inspect.isabstract(one)]
    return {one.__name__: one for one in (*known, *plugins, Grid, StageUncertainty, Uncertainty)}


def _fields(cls: type[eqx.Module]) -> dict[str, dataclasses.Field[Any]]:
    return {field.name: field for field in dataclasses.fields(cls) if field.init}


def spec_of(field: dataclasses.Field[Any]) -> ParameterSpec | None:
    return next((entry for entry in field.metadata.values() if isinstance(entry, ParameterSpec)), None)


def _unit(field: dataclasses.Field[Any]) -> str:
    """Take the unit from the specification, or else from the end of the name, such as `um/V^2` from `x_um_per_V2`."""
    spec = spec_of(field)
    if spec is not None:
        return spec.unit
    name = field.name.split("_")
    parts = name[-3:] if len(name) > 3 and name[-2] == "per" else name[-1:]
    return re.sub(r"(\d+)", r"^\1", "/".join(part for part in parts if part != "per")) if len(name) > 1 else "1"


def _encode_module(module: eqx.Module) -> dict[str, Any]:
    name = type(module).__name__
    if _classes().get(name) is not type(module):
        raise DataError(f"microid has no public class {name}")
    out: dict[str, Any] = {"type": name}
    for key, field in _fields(type(module)).items():
        value, unit = getattr(module, key), _unit(field)
        packed = key in _PACKED and isinstance(value, jax.Array) and value.dtype == np.float64
        out[key] = _encode_array(np.asarray(value), unit, packed) if packed else encode(value, unit)
    return out


def _decode_module(item: dict[str, Any], where: str) -> eqx.Module:
    cls = _classes().get(item["type"]) if isinstance(item["type"], str) else None
    if cls is None:
        raise DataError(f"{where}: {shown(item['type'])} is not the name of a model that this version knows")
    fields = _fields(cls)
    given = set(item) - {"type"}
    # What came to a model later has a default, which older files mean.
    needed = {key for key, field in fields.items() if field.default is dataclasses.MISSING}
    if not needed <= given <= set(fields):
        raise DataError(f"{where}: a {item['type']} has the fields {', '.join(fields)}, and no others")
    values = {key: decode(item[key], f"{where}.{key}", spec_of(fields[key])) for key in fields if key in given}
    # One context, so that an `N` means the same in all fields.
    with jaxtyping.jaxtyped("context"):
        for key, value in values.items():
            _check(value, item[key], fields[key].type, f"{where}.{key}")
    limits = [np.asarray(values[key]) for key in ("lower_V", "upper_V") if key in values]  # compared without JAX
    if len(limits) == 2 and not np.all(limits[0] < limits[1]):
        raise DataError(f"{where}: expected lower_V below upper_V")
    try:
        return cls(**values)
    except (TypeError, ValueError, AttributeError, LookupError, ArithmeticError) as error:
        # A constructor is written for what code gives it; a file may give it anything.
        raise DataError(f"{where}: {' '.join(str(error).split())}") from error


def _check(value: Any, item: Any, kind: Any, where: str) -> None:
    """Refuse what an item was decoded to where it is not of the kind that a field is declared as."""
    within = get_args(kind)
    if get_origin(kind) is tuple and within[-1] is ... and isinstance(value, tuple):
        for k, one in enumerate(value):
            _check(one, item[k], within[0], f"{where}[{k}]")
    elif not _is_a(value, kind):
        raise DataError(f"{where}: expected {_words(kind)}, found {shown(item)}")


def _is_a(value: Any, kind: Any) -> bool:
    """Whether a value is of a kind, as far as files hold such."""
    within = get_args(kind)
    if get_origin(kind) is Literal:
        return isinstance(value, str) and value in within
    if get_origin(kind) in (Union, types.UnionType):
        return any(_is_a(value, one) for one in within)
    if get_origin(kind) is tuple:
        return isinstance(value, tuple)
    if not isinstance(kind, type):
        return True
    return isinstance(value, kind) and not (kind is int and isinstance(value, bool))


def _words(kind: Any) -> str:
    """What a field holds, for somebody who has never seen its annotation."""
    within = get_args(kind)
    if get_origin(kind) is Literal:
        return f"one of {', '.join(within)}"
    if get_origin(kind) is tuple:
        return f"a list, each of it {_words(within[0])}"
    if get_origin(kind) in (Union, types.UnionType):
        return " or ".join(map(_words, within))
    if not issubclass(kind, jaxtyping.AbstractArray):
        plain = {int: "a whole number", str: "a text", types.NoneType: "null"}
        return plain.get(kind, "an object with a type" if issubclass(kind, eqx.Module) else "another value")
    axes = str(kind.dim_str).split()
    return f"an array of the shape ({', '.join(axes)})" if axes else "a single number with its unit"


def _encode_array(array: np.ndarray, unit: str, packed: bool = False) -> dict[str, Any]:
    if not np.all(np.isfinite(array)):
        raise DataError("it holds a number that is not finite")
    if packed:
        data = base64.b64encode(array.astype("<f8").tobytes()).decode("ascii")
        return {"unit": unit, "shape": list(array.shape), "float64_base64": data}
    out = {"unit": unit, "value": array.tolist()}
    if array.dtype.name not in _DTYPES:
        raise DataError(f"it holds an array of {array.dtype.name}, for which the format has no form")
    return out if array.dtype == np.float64 else out | {"dtype": array.dtype.name}


def _decode_array(item: dict[str, Any], where: str, spec: ParameterSpec | None) -> jax.Array:
    if spec is not None and item.get("unit") != spec.unit:
        raise DataError(f"{where}: expected the unit {spec.unit!r}, found {shown(item.get('unit'))}")
    array = _unpack(item, where) if "float64_base64" in item else _plain(item, where)
    if not np.all(np.abs(array) <= _LARGEST):
        raise DataError(f"{where}: expected numbers up to {_LARGEST:g} in size")
    if spec is not None and not np.all((array >= spec.lower) & (array <= spec.upper)):
        raise DataError(f"{where}: expected numbers between {spec.lower:g} and {spec.upper:g} {spec.unit}")
    return jnp.asarray(array)


def _plain(item: dict[str, Any], where: str) -> np.ndarray:
    dtype = item.get("dtype", "float64")
    if not {"unit", "value"} <= set(item) <= {"unit", "value", "dtype"} or dtype not in _DTYPES:
        raise DataError(
            f"{where}: expected a number or numbers with the keys unit and value, or an object with a type"
        )
    try:
        array = np.asarray(item["value"])
    except ValueError:
        array = np.asarray("ragged")
    if array.dtype.kind not in ("b" if dtype == "bool" else "iuf"):
        raise DataError(f"{where}: expected numbers in rows of one length")
    return array.astype(dtype)


def _unpack(item: dict[str, Any], where: str) -> np.ndarray:
    try:
        data = base64.b64decode(item["float64_base64"], validate=True)
        return np.frombuffer(data, dtype="<f8").astype(np.float64).reshape(tuple(item["shape"]))
    except (KeyError, TypeError, ValueError, binascii.Error) as error:
        raise DataError(f"{where}: the base64 text does not hold the float64 numbers of its shape") from error


def _encode_network(network: eqx.nn.MLP, unit: str) -> dict[str, Any]:
    names = [name for name, function in _ACTIVATIONS.items() if function is network.activation]
    if not names:
        raise DataError(f"it holds a network whose activation is not one of {', '.join(_ACTIVATIONS)}")
    layers = [{key: encode(getattr(layer, key), unit) for key in ("weight", "bias")} for layer in network.layers]
    sizes = {"in_size": network.in_size, "out_size": network.out_size}
    return {"type": "MLP", "activation": names[0], **sizes, "layers": layers}


def _decode_network(item: dict[str, Any], where: str, spec: ParameterSpec | None) -> eqx.nn.MLP:
    layers = item.get("layers")
    if (
        set(item) != {"type", "activation", "in_size", "out_size", "layers"}
        or not (isinstance(item["activation"], str) and item["activation"] in _ACTIVATIONS)
        or not (isinstance(layers, list) and len(layers) > 1)
        or not all(isinstance(layer, dict) and set(layer) == {"weight", "bias"} for layer in layers)
    ):
        raise DataError(
            f"{where}: an MLP has in_size, out_size, two layers or more with weight and bias, and an activation "
            f"out of {', '.join(_ACTIVATIONS)}"
        )
    slots_of = [(number, key) for number in range(len(layers)) for key in ("weight", "bias")]
    arrays = [decode(layers[n][key], f"{where}.layers[{n}].{key}", spec) for n, key in slots_of]
    if not all(isinstance(array, jax.Array) and array.ndim for array in arrays):
        raise DataError(f"{where}: expected arrays in the layers of the network")

    def slots(network: eqx.nn.MLP) -> list[Any]:
        return [getattr(network.layers[n], key) for n, key in slots_of]

    try:
        sizes = item["in_size"], item["out_size"], arrays[0].shape[0], len(layers) - 1
        activation, key = _ACTIVATIONS[item["activation"]], jax.random.key(0)
        skeleton = eqx.filter_eval_shape(eqx.nn.MLP, *sizes, activation=activation, key=key)
    except (TypeError, ValueError, IndexError) as error:
        raise DataError(f"{where}: the sizes of the network make no sense") from error
    if [slot.shape for slot in slots(skeleton)] != [array.shape for array in arrays]:
        raise DataError(f"{where}: the layers do not fit together")
    network: eqx.nn.MLP = eqx.tree_at(slots, skeleton, arrays)
    return network
