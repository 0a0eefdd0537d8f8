"""What the paper reads in its Fig. 7, beside what the derivatives of a design say."""

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.machining._design import TOLERANCE_MM, Design
from fits.machining._gains import quick_jit
from fits.machining._sensitivity import AxisSensitivity, DimensionEffect, SensitivityReport, gains_at, sensitivities
from microid import kinetostatics as ks

Verdict = Literal["agree", "partly", "disagree"]
# Below this part of the largest effect of an axis, one can be neglected; from the other on, it is severe.
_NEGLIGIBLE, _SEVERE = 0.05, 0.5


@dataclass(frozen=True)
class Claim:
    """A statement of the paper, in other words, judged by the numbers of a design.

    The verdict is `agree`, `partly` or `disagree`. A number with its unit decides, and the reason says what it is.
    """

    axes: tuple[ks.Axis, ...]
    statement: str
    verdict: Verdict
    number: float
    unit: str
    reason: str


def paper_claims(design: Design) -> tuple[Claim, ...]:
    """Judge all that the paper says of its Fig. 7 by the derivatives of a design.

    The paper gives no tolerance for angles (erratum 9), so its lengths are compared with lengths. Errors are those of
    `sensitivities`.
    """
    report = sensitivities(design, ("x", "z", "alpha", "gamma"))
    return (*_of_x(design, report["x"]), *_of_z(design, report["z"]), *_of_turns(report))


def _of_x(design: Design, x: AxisSensitivity) -> Iterator[Claim]:
    verdict, share = _leaders(x, ("t1", "t2", "l1", "la1"))
    reason = (
        f"The largest among the lengths are {_changes(_lengths(x)[:4])}; the four named make up {share:.1f} % of the "
        f"variance. alpha1, for which the paper gives no tolerance, has place {_rank(x, 'alpha1')}."
    )
    yield Claim(("x", "y"), "t1, t2, l1 and la1 have a great influence", verdict, share, "%", reason)
    guides, change = sign_change_guides(design), x["t1"].relative_change_pct
    if guides is None:
        number, unit = change, "%"
        reason = f"{change:+.3f} % at plus one tolerance, and no number of guiding legs makes it vanish."
    else:
        number, unit = guides, "guiding legs"
        reason = (
            f"{change:+.3f} % with {design.guides:g} guiding legs, but it changes its sign at {guides:.2f}, as a "
            "thicker hinge lowers the ratio and stiffens the output; near there terms of second order decide."
        )
    verdict = _verdict(_share_of_largest(x, "t1") >= _NEGLIGIBLE, partly=guides is not None)
    yield Claim(("x", "y"), "t1 has a great influence", verdict, number, unit, reason)


def _of_z(design: Design, z: AxisSensitivity) -> Iterator[Claim]:
    first, second = z.dimensions[:2]
    ratio = _ratio(z["t4"].relative_change_pct, (second if first.name == "t4" else first).relative_change_pct)
    reason = f"{_changes(z.dimensions)}: t4 has {ratio:.3g} times the effect of the largest other dimension."
    yield Claim(
        ("z",), "t4 affects the error most", _verdict(first.name == "t4", ratio >= _SEVERE), ratio, "", reason
    )
    _, grows, reason = _shape_of_curve(design, z["t4"])
    statement = "the effect of t4 grows gradually with the machining error"
    yield Claim(("z",), statement, _verdict(grows), z["t4"].relative_change_exact_pct, "%", reason)
    bend, one_way, reason = _shape_of_curve(design, z["la2"])
    reason += " The first-order differential that the paper draws is straight and can do neither."
    statement = "the effect of la2 rises sharply, then falls and flattens"
    yield Claim(("z",), statement, _verdict(not one_way), bend, "%", reason)


def _of_turns(report: SensitivityReport) -> Iterator[Claim]:
    """What is said of the rotations, and of one of them and z."""
    z, alpha, gamma = report["z"], report["alpha"], report["gamma"]
    first = alpha.dimensions[0]
    ratio = _ratio(first.relative_change_pct, alpha["l"].relative_change_pct)
    # By Eq. 14 of the tilt's lever, the relative change per mm of l is below 2 / (2 l + l5).
    slope_per_mm = abs(first.relative_change_pct) / 100 / alpha["l"].tolerance if alpha["l"].tolerance else 0.0
    below = f"; to have as much, 2 l + l5 would have to be below {2 / slope_per_mm:.2g} mm" if slope_per_mm else ""
    reason = f"{first.name} has {ratio:.3g} times the effect of l{below if first.name != 'l' else ''}."
    verdict = _verdict(first.name == "l", ratio * _SEVERE <= 1)
    yield Claim(("alpha", "beta"), "l is among the most severe", verdict, ratio, "", reason)
    for name in ("l5", "t4"):
        part = _share_of_largest(alpha, name)
        reason = (
            f"{name} has place {_rank(alpha, name)}, with {alpha[name].relative_change_pct:+.3f} % or "
            f"{100 * part:.3g} % of the largest effect."
        )
        verdict = _verdict(part < _NEGLIGIBLE, part < _SEVERE)
        yield Claim(("alpha", "beta"), f"{name} can be neglected", verdict, 100 * part, "%", reason)
    of_z, of_alpha = (axis["t4"].derivative / axis.gain for axis in (z, alpha))
    reason = (
        f"d ln z / d t4 = {of_z:+.6g} per mm and d ln alpha / d t4 = {of_alpha:+.6g} per mm: the same amplifiers "
        "drive both, so that the paper contradicts itself."
    )
    verdict = _verdict(z.dimensions[0].name == "t4" and _share_of_largest(alpha, "t4") < _NEGLIGIBLE)
    statement = "t4 affects z most, and can be neglected in the rotations about x and y"
    yield Claim(("z", "alpha", "beta"), statement, verdict, _ratio(of_alpha, of_z), "", reason)
    verdict, share = _leaders(gamma, ("t6", "t7", "l6"))
    reason = f"Among the lengths {_changes(_lengths(gamma))}; the three named make up {share:.1f} % of the variance."
    yield Claim(("gamma",), "t6, t7 and l6 are the most severe", verdict, share, "%", reason)


def describe_claims(claims: Sequence[Claim]) -> str:
    """Put claims into lines, without a newline at the end."""
    lines = ["The paper on its Fig. 7, and this stage:"]
    for claim in claims:
        lines.append(f"  {claim.verdict:8}  {', '.join(claim.axes)}: {claim.statement}")
        lines.append(textwrap.indent(textwrap.fill(claim.reason, 98), " " * 12))
    return "\n".join(lines)


def sign_change_guides(design: Design) -> float | None:
    """Number of guiding legs at which the output in x no longer depends on `t1`, to first order.

    A thicker hinge lowers the unloaded ratio of the bridge and raises the stiffness of its output, on which the
    guides are a load. With few guides the first wins, with many the second. None where no number does that; the
    design's own number of guides plays no role.
    """
    guides = float(_sign_change(design.geometry, design.constants))
    return guides if 0 < guides < np.inf else None


@quick_jit
def _sign_change(geometry: ks.Geometry, constants: ks.Constants) -> Float[Array, ""]:
    g = geometry
    one_leg = ks.guide_stiffness_N_per_um(g.l2_mm, g.t2_mm, g.l3_mm, constants) / constants.guides

    def stiffnesses(t1_mm: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        port = ks.bridge(g.l1_mm, t1_mm, g.la1_mm, g.alpha1_rad, constants)
        return port.K12_N_per_um, port.K22_N_per_um

    (across, back), (across_slope, back_slope) = jax.jvp(stiffnesses, (g.t1_mm,), (jnp.ones_like(g.t1_mm),))
    # Where the slope of K12 / (K22 + n k) vanishes.
    return (across * back_slope / across_slope - back) / one_leg


def _verdict(agree: bool, partly: bool = False) -> Verdict:
    return "agree" if agree else "partly" if partly else "disagree"


def _leaders(axis: AxisSensitivity, said: Sequence[str]) -> tuple[Verdict, float]:
    """Verdict on the lengths said to have the largest effects, and their share of the variance in percent."""
    lengths = [effect.name for effect in _lengths(axis)]
    verdict = _verdict(set(lengths[: len(said)]) == set(said), lengths[0] in said)
    return verdict, 100 * sum(axis[name].share_of_variance for name in said)


def _rank(axis: AxisSensitivity, name: str) -> str:
    """Rank of a dimension by its effect, such as `2 of 5`."""
    return f"{[effect.name for effect in axis.dimensions].index(name) + 1} of {len(axis.dimensions)}"


def _share_of_largest(axis: AxisSensitivity, name: str) -> float:
    return _ratio(axis[name].relative_change_pct, axis.dimensions[0].relative_change_pct)


def _lengths(axis: AxisSensitivity) -> list[DimensionEffect]:
    return [effect for effect in axis.dimensions if effect.unit == "mm"]


def _changes(effects: Sequence[DimensionEffect]) -> str:
    return ", ".join(f"{effect.name} {effect.relative_change_pct:+.3f} %" for effect in effects)


def _ratio(one: float, other: float) -> float:
    """Ratio of two sizes; infinite where the second vanishes."""
    return abs(one / other) if other else float("inf")


def _shape_of_curve(design: Design, effect: DimensionEffect) -> tuple[float, bool, str]:
    """How far the output in z over errors of a dimension is off a line, in %; whether it goes one way; in words."""
    names = ks.MOTIONS["z"].dimensions
    width = effect.tolerance or TOLERANCE_MM
    errors = np.zeros((41, len(names)))
    errors[:, names.index(effect.name)] = np.linspace(-width, width, len(errors))
    gains = gains_at(design, "z", errors)
    bend = 100 * float(np.max(np.abs(gains - np.linspace(gains[0], gains[-1], len(gains)))) / gains[20])
    one_way = bool(np.all(np.diff(gains) > 0) or np.all(np.diff(gains) < 0))
    words = (
        f"{effect.relative_change_exact_pct:+.3f} % at plus one tolerance; over all of it the curve "
        f"{'goes one way' if one_way else 'turns'} and is off a straight line by {bend:.2g} % of the output."
    )
    return bend, one_way, words
