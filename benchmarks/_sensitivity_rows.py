"""Rows for tolerances: a Monte Carlo study of all six axes, against NumPy, whole arrays and one stage at a time."""

import math
import time
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
from _timing import Line, Table, side_by_side

import fits
from microid.kinetostatics import Axis

_TOLERANCE_mm, _GUIDES = 0.02, 4.0
_ROOT_AXIAL, _ROOT, _SHEAR = 2.18, 0.80, 2 * 1.29 * 6 / 5
_HEIGHT_mm, _MIDDLE_mm = 5.0, 9.0
# Nominal values in the order of the arguments of `_gains`; angles have the tolerance of a length over their leg.
_NOMINAL = {
    "l1": 7.0, "t1": 0.8, "la1": 9.0, "alpha1": 0.068, "l2": 10.0, "t2": 1.0, "l3": 28.0, "la2": 9.0, "alpha2": 0.061,
    "t4": 0.8, "l": 40.0, "l5": 9.0, "l6": 2.0, "t6": 0.8, "la3": 14.0, "alpha3": 0.185, "l7": 2.0, "t7": 0.8,
    "R": 4.0, "J": 4.0,
}  # fmt: skip
_LEGS_mm = {"alpha1": 9.0, "alpha2": 9.0, "alpha3": 14.0}
_PIECE = 65536
# The others are twins.
_AXES: tuple[Axis, ...] = ("x", "z", "alpha", "gamma")


def _leg(xp: ModuleType, length: Any, thickness: Any, distance: Any, angle: Any) -> tuple[Any, Any, Any]:
    """Compliance of half a bridge's leg, as xx, xy and yy."""
    turn = 6 * (length + _ROOT * thickness) / thickness**3
    along, across = distance * xp.cos(angle), distance * xp.sin(angle)
    slender = (along - length) / _HEIGHT_mm
    lateral = ((length + _ROOT * thickness) / thickness) ** 3 + _SHEAR * length / thickness
    xx = 2 * (length + _ROOT_AXIAL * thickness) / thickness + turn * across**2 + slender
    return xx, turn * along * across, 2 * lateral + turn * along**2 + slender**3 + _SHEAR * slender


def _gains(
    xp: ModuleType, l1: Any, t1: Any, la1: Any, a1: Any, l2: Any, t2: Any, l3: Any, la2: Any, a2: Any, t4: Any,
    l0: Any, l5: Any, l6: Any, t6: Any, la3: Any, a3: Any, l7: Any, t7: Any, R: Any, J: Any,
) -> tuple[Any, Any, Any, Any]:  # fmt: skip
    """Gains of x, z, alpha and gamma, which are those of all six axes; `xp` is `numpy` or `math`."""
    xx, xy, yy = _leg(xp, l1, t1, la1, a1)
    x = xy / (xx + _GUIDES / _leg(xp, l2, t2, l3, 0.0)[2] * (xx * yy - xy**2))
    xx, xy, _ = _leg(xp, _MIDDLE_mm, t4, la2, a2)
    z = xy / xx
    alpha = z / (4e3 / 3 * (3 * l0**2 + 3 * l0 * l5 + l5**2) / (2 * l0 + l5))
    xx, xy, yy = _leg(xp, l6, t6, la3, a3)
    lateral = ((l7 + _ROOT * t7) / t7) ** 3 + _SHEAR * l7 / t7
    spring = (t7**3 / (12 * (l7 + _ROOT * t7)) + l7**2 / (4 * lateral)) / (R + J) ** 2
    give = 1 + spring * (l7 + _ROOT_AXIAL * t7) / t7
    return x, z, alpha, xy / (xx * give + spring * (xx * yy - xy**2)) / (1e3 * (R + J))


def _summed_up(gains: np.ndarray) -> list[tuple[float, ...]]:
    found = []
    for values in gains:
        off = values - values.mean()
        quantiles = np.percentile(values, (0.135, 2.5, 50, 97.5, 99.865))
        found.append((float(values.mean()), float(off.std()), float(np.mean(off**3)), *quantiles.tolist()))
    return found


def _numpy(samples: int, seed: int) -> list[tuple[float, ...]]:
    """As a NumPy user would write it: whole arrays, in pieces that fit in a cache."""
    rng, gains = np.random.default_rng(seed), np.empty((4, samples))
    for begin in range(0, samples, _PIECE):
        count = min(_PIECE, samples - begin)
        drawn = [v + _sd(name) * rng.standard_normal(count) for name, v in _NOMINAL.items()]
        gains[:, begin : begin + count] = _gains(np, *drawn)
    return _summed_up(gains)


def _one_by_one(samples: int, seed: int, xp: ModuleType) -> list[tuple[float, ...]]:
    """One stage at a time."""
    rng, gains = np.random.default_rng(seed), np.empty((4, samples))
    nominal, sd = np.array(list(_NOMINAL.values())), np.array([_sd(name) for name in _NOMINAL])
    for k in range(samples):
        drawn = nominal + sd * rng.standard_normal(len(nominal))
        gains[:, k] = _gains(xp, *(drawn.tolist() if xp is math else drawn))
    return _summed_up(gains)


def _sd(name: str) -> float:
    return _TOLERANCE_mm / 3 / _LEGS_mm.get(name, 1.0)


def sensitivity(samples: int, repeats: int, seed: int, table: Table) -> None:
    """Draw stages and sum up all axes, first order and quantiles included."""
    design = fits.paper_design(_TOLERANCE_mm)

    def ours() -> fits.MonteCarlo:
        return fits.monte_carlo(design, samples, seed=seed)

    few = max(1000, samples // 100)
    study, peer = ours(), _numpy(samples, seed)
    off = max(abs(study.axes[axis].sd / found[1] - 1) for axis, found in zip(_AXES, peer, strict=True))
    calls: dict[str, Callable[[], object]] = {
        "ours": ours,
        "numpy": lambda: _numpy(samples, seed),
        "scalars": lambda: _one_by_one(few, seed, np),
        "floats": lambda: _one_by_one(few, seed, math),
    }
    taken = side_by_side(calls, repeats)
    walls = []
    for _ in range(repeats):
        start = time.perf_counter()
        ours()
        walls.append(time.perf_counter() - start)
    case = f"Monte Carlo of six axes, {samples:.0e} stages"
    cpu = f"{samples / min(taken['ours']) / 1e6:.2f}"
    note = f"wall time, best of {repeats}; {cpu} million per CPU second; spreads are {100 * off:.1g} % off the peer's"
    table.add(Line(f"{case}, million a second", "(> 1)", f"{samples / min(walls) / 1e6:.2f}", note=note))
    table.ratio(f"{case}, over NumPy on whole arrays", "", taken["numpy"], taken["ours"])
    for name, what in (("floats", "Python floats"), ("scalars", "NumPy scalars")):
        slow = [value * samples / few for value in taken[name]]
        note = f"peer measured with {few} stages"
        table.ratio(f"{case}, over a loop with {what}", "", slow, taken["ours"], note=note)
    for axis in _AXES:
        spread = study.axes[axis]
        gap = 100 * (spread.first_order_sd / spread.sd - 1)
        what = f"{axis}, +-{_TOLERANCE_mm} mm, first order over Monte Carlo"
        note = f"spread {spread.relative_sd_pct:.3f} %, standard error {100 * spread.sd_error / spread.sd:.2g} %"
        table.add(Line(what, "within 2 %", f"{gap:+.2f} %", note=note))
