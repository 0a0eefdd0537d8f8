"""What the paper reads in its Fig. 7, beside what the derivatives of a design say."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import microid as m
from fits.machining._design import TOLERANCE_MM, Design
from fits.machining._sensitivity import (
    AxisSensitivity,
    DimensionEffect,
    SensitivityReport,
    gains_at,
    quick_jit,
    sensitivities,
)

Verdict = Literal["agree", "partly", "disagree"]
_AXES: tuple[m.Axis, ...] = ("x", "z", "alpha", "gamma")
# Below this part of the largest effect of an axis, one can be neglected.
_NEGLIGIBLE = 0.05
# From this part on, it is severe.
_SEVERE = 0.5
_STEPS = 41
_WIDTH, _INDENT = 110, " " * 12


@dataclass(frozen=True)
class Claim:
    """A statement of the paper, judged by the numbers of a design.

    Attributes
    ----------
    axes
        Which it is about.
    statement
        What the paper says, in other words.
    verdict
        `agree`, `partly` or `disagree`.
    number, unit
        What decides.
    reason
        What the number is, and why the verdict.
    """

    axes: tuple[m.Axis, ...]
    statement: str
    verdict: Verdict
    number: float
    unit: str
    reason: str


def paper_claims(design: Design) -> tuple[Claim, ...]:
    """Judge all that the paper says of its Fig. 7 by the derivatives of a design.

    The paper gives no tolerance for angles (erratum 9), so its lengths are compared with lengths.

    Parameters
    ----------
    design
        The paper's, or another.

    Raises
    ------
    DataError, RuntimeError
        See `sensitivities`.
    """
    report = sensitivities(design, _AXES)
    return (
        _leaders_of_x(report["x"]),
        _t1(design, report["x"]),
        _t4_of_z(report["z"]),
        _gradual(design, report["z"]),
        _rise_and_fall(design, report["z"]),
        _l(report["alpha"]),
        _negligible(report["alpha"], "l5"),
        _negligible(report["alpha"], "t4"),
        _same_amplifiers(report),
        _leaders_of_gamma(report["gamma"]),
    )


def describe_claims(claims: Sequence[Claim]) -> str:
    """Put claims into lines, without a newline at the end."""
    lines = ["The paper on its Fig. 7, and this stage:"]
    for claim in claims:
        lines.append(f"  {claim.verdict:8}  {', '.join(claim.axes)}: {claim.statement}")
        lines += textwrap.wrap(claim.reason, _WIDTH, initial_indent=_INDENT, subsequent_indent=_INDENT)
    return "\n".join(lines)


def sign_change_guides(design: Design) -> float | None:
    """Number of guiding legs at which the output in x no longer depends on `t1`, to first order.

    A thicker hinge lowers the unloaded ratio of the bridge and raises the stiffness of its output, on which the
    guides are a load. With few guides the first wins, with many the second.

    Parameters
    ----------
    design
        Its own number of guides plays no role.

    Returns
    -------
    float or None
        None where no number does that.
    """
    guides = float(_sign_change(design.geometry, design.constants))
    return guides if np.isfinite(guides) and guides > 0 else None


@quick_jit
def _sign_change(geometry: m.Geometry, constants: m.Constants) -> Float[Array, ""]:
    g = geometry
    one_leg = m.guide_stiffness_N_per_um(g.l2_mm, g.t2_mm, g.l3_mm, constants) / constants.guides

    def stiffnesses(t1_mm: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        port = m.bridge(g.l1_mm, t1_mm, g.la1_mm, g.alpha1_rad, constants)
        return port.K12_N_per_um, port.K22_N_per_um

    (across, back), (across_slope, back_slope) = jax.jvp(stiffnesses, (g.t1_mm,), (jnp.ones_like(g.t1_mm),))
    # Where the slope of K12 / (K22 + n k) vanishes.
    return (across * back_slope / across_slope - back) / one_leg


def _leaders_of_x(x: AxisSensitivity) -> Claim:
    said = ("t1", "t2", "l1", "la1")
    lengths = _lengths(x)
    leaders = [effect.name for effect in lengths[: len(said)]]
    common = len(set(leaders) & set(said))
    verdict: Verdict = "agree" if common == len(said) else "partly" if lengths[0].name in said else "disagree"
    share = 100 * sum(x[name].share_of_variance for name in said)
    angle = [effect.name for effect in x.dimensions].index("alpha1") + 1
    return Claim(
        ("x", "y"),
        "t1, t2, l1 and la1 have a great influence",
        verdict,
        share,
        "%",
        f"The largest among the lengths are {_changes(lengths[: len(said)])}; the four named make up {share:.1f} % "
        f"of the variance. alpha1, for which the paper gives no tolerance, has place {angle} of {len(x.dimensions)}.",
    )


def _t1(design: Design, x: AxisSensitivity) -> Claim:
    guides, change = sign_change_guides(design), x["t1"].relative_change_pct
    severe = abs(change) >= _NEGLIGIBLE * abs(x.dimensions[0].relative_change_pct)
    if guides is None:
        return Claim(
            ("x", "y"),
            "t1 has a great influence",
            "agree" if severe else "disagree",
            change,
            "%",
            f"{change:+.3f} % at plus one tolerance, and no number of guiding legs makes it vanish.",
        )
    return Claim(
        ("x", "y"),
        "t1 has a great influence",
        "agree" if severe else "partly",
        guides,
        "guiding legs",
        f"{change:+.3f} % with {design.guides:g} guiding legs, but it changes its sign at {guides:.2f}, as a thicker "
        "hinge lowers the ratio and stiffens the output; near there terms of second order decide.",
    )


def _t4_of_z(z: AxisSensitivity) -> Claim:
    first, second = z.dimensions[:2]
    ratio = _ratio(z["t4"].relative_change_pct, (second if first.name == "t4" else first).relative_change_pct)
    return Claim(
        ("z",),
        "t4 affects the error most",
        "agree" if first.name == "t4" else "partly" if ratio >= _SEVERE else "disagree",
        ratio,
        "",
        f"{_changes(z.dimensions)}: t4 has {ratio:.3g} times the effect of the largest other dimension.",
    )


def _gradual(design: Design, z: AxisSensitivity) -> Claim:
    bend, one_way = _curve(design, "t4")
    return Claim(
        ("z",),
        "the effect of t4 grows gradually with the machining error",
        "agree" if one_way else "disagree",
        z["t4"].relative_change_exact_pct,
        "%",
        f"{z['t4'].relative_change_exact_pct:+.3f} % at plus one tolerance; over all of it the curve "
        f"{'goes one way' if one_way else 'turns'} and is off a straight line by {bend:.2g} % of the output.",
    )


def _rise_and_fall(design: Design, z: AxisSensitivity) -> Claim:
    bend, one_way = _curve(design, "la2")
    return Claim(
        ("z",),
        "the effect of la2 rises sharply, then falls and flattens",
        "disagree" if one_way else "agree",
        bend,
        "%",
        f"{z['la2'].relative_change_exact_pct:+.3f} % at plus one tolerance; over all of it the curve "
        f"{'goes one way' if one_way else 'turns'} and is off a straight line by {bend:.2g} % of the output. The "
        "first-order differential that the paper draws is straight and can do neither.",
    )


def _l(alpha: AxisSensitivity) -> Claim:
    first = alpha.dimensions[0]
    ratio = _ratio(first.relative_change_pct, alpha["l"].relative_change_pct)
    # By Eq. 14 of the tilt's lever, the relative change per mm of l is below 2 / (2 l + l5).
    slope_per_mm = abs(first.relative_change_pct) / 100 / alpha["l"].tolerance if alpha["l"].tolerance else 0.0
    below = f"; to have as much, 2 l + l5 would have to be below {2 / slope_per_mm:.2g} mm" if slope_per_mm else ""
    return Claim(
        ("alpha", "beta"),
        "l is among the most severe",
        "agree" if first.name == "l" else "partly" if ratio * _SEVERE <= 1 else "disagree",
        ratio,
        "",
        f"{first.name} has {ratio:.3g} times the effect of l{below if first.name != 'l' else ''}.",
    )


def _negligible(alpha: AxisSensitivity, name: str) -> Claim:
    place = [effect.name for effect in alpha.dimensions].index(name) + 1
    part = _ratio(alpha[name].relative_change_pct, alpha.dimensions[0].relative_change_pct)
    return Claim(
        ("alpha", "beta"),
        f"{name} can be neglected",
        "agree" if part < _NEGLIGIBLE else "partly" if part < _SEVERE else "disagree",
        100 * part,
        "%",
        f"{name} has place {place} of {len(alpha.dimensions)}, with {alpha[name].relative_change_pct:+.3f} % or "
        f"{100 * part:.3g} % of the largest effect.",
    )


def _same_amplifiers(report: SensitivityReport) -> Claim:
    z, alpha = (report[axis]["t4"].derivative / report[axis].gain for axis in ("z", "alpha"))
    part = _ratio(report["alpha"]["t4"].relative_change_pct, report["alpha"].dimensions[0].relative_change_pct)
    both = report["z"].dimensions[0].name == "t4" and part < _NEGLIGIBLE
    return Claim(
        ("z", "alpha", "beta"),
        "t4 affects z most, and can be neglected in the rotations about x and y",
        "agree" if both else "disagree",
        _ratio(alpha, z),
        "",
        f"d ln z / d t4 = {z:+.6g} per mm and d ln alpha / d t4 = {alpha:+.6g} per mm: the same amplifiers drive "
        "both, so that the paper contradicts itself.",
    )


def _leaders_of_gamma(gamma: AxisSensitivity) -> Claim:
    said = ("t6", "t7", "l6")
    lengths = _lengths(gamma)
    leaders = {effect.name for effect in lengths[: len(said)]}
    verdict: Verdict = "agree" if leaders == set(said) else "partly" if lengths[0].name in said else "disagree"
    share = 100 * sum(gamma[name].share_of_variance for name in said)
    return Claim(
        ("gamma",),
        "t6, t7 and l6 are the most severe",
        verdict,
        share,
        "%",
        f"Among the lengths {_changes(lengths)}; the three named make up {share:.1f} % of the variance.",
    )


def _lengths(axis: AxisSensitivity) -> list[DimensionEffect]:
    return [effect for effect in axis.dimensions if effect.unit == "mm"]


def _changes(effects: Sequence[DimensionEffect]) -> str:
    return ", ".join(f"{effect.name} {effect.relative_change_pct:+.3f} %" for effect in effects)


def _ratio(one: float, other: float) -> float:
    """Ratio of two sizes; infinite where the second vanishes."""
    return abs(one / other) if other else float("inf")


def _curve(design: Design, name: str) -> tuple[float, bool]:
    """How far the output in z over errors of a dimension is off a line, in %, and whether it goes one way."""
    names = m.MOTIONS["z"].dimensions
    width = design.tolerance[name] or TOLERANCE_MM
    errors = np.zeros((_STEPS, len(names)))
    errors[:, names.index(name)] = np.linspace(-width, width, _STEPS)
    gains = gains_at(design, "z", errors)
    steps = np.diff(gains)
    straight = np.linspace(gains[0], gains[-1], _STEPS)
    bend = 100 * float(np.max(np.abs(gains - straight)) / gains[_STEPS // 2])
    return bend, bool(np.all(steps > 0) or np.all(steps < 0))
