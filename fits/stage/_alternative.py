"""Intervals that own up to what pulls a fit: they reach to where it comes out without that."""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from fits.loop._fit_checks import outlying
from fits.loop._result import FitError, FitResult
from fits.stage._solve import Solved, solve_chain
from fits.stage._steps import Plan
from fits.stage._uncertainty import Precision
from fits.stats._metrics import TWO_SIDED_95
from microid import Stage

# What pulls a fit ruins it where it moves a parameter by more than this part of it.
_RUINED = 0.5


@dataclass(frozen=True)
class Alternative:
    """Where the parameters of a stage come out without something, and the ends of their 95 % intervals, `(p,)`."""

    values: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, precision: Precision) -> "Alternative":
        """Read it off a solution."""
        z, values = precision.solved.z, precision.chain.coordinates.values
        sd = precision.sd()
        ends = (np.asarray(values(jnp.asarray(z + k * TWO_SIDED_95 * sd))) for k in (0, -1, 1))
        return cls(*ends)

    @classmethod
    def in_unit(cls, fit: FitResult[Stage], factor: float) -> "Alternative":
        """Where a fit comes out if a unit of its times is so many s."""
        powers = np.asarray([{"s": 1.0, "Hz": -1.0}.get(p.unit, 0.0) for p in fit.parameters])
        figures = [[getattr(p, name) for p in fit.parameters] for name in ("value", "lower", "upper")]
        return cls(*(factor**powers * np.asarray(each) for each in figures))

    def contradicted(self, fit: FitResult[Stage]) -> list[str]:
        """Say which parameters of a fit are far from these, one sentence each."""
        return [
            f"{p.name} would come out as {p.value:.4g} instead of {v:.4g} {p.unit}"
            for p, v in zip(fit.parameters, self.values, strict=True)
            if abs(v - p.value) > _RUINED * min(abs(v), abs(p.value))
        ]

    def widen(self, fit: FitResult[Stage], said: str, remedy: str = "") -> FitResult[Stage]:
        """Let a fit's intervals reach these, and say first what pulls it and what to do about that."""
        parameters = tuple(
            replace(
                p, sd=float(np.hypot(p.sd, v - p.value)), lower=min(p.lower, float(a)), upper=max(p.upper, float(b))
            )
            for p, v, a, b in zip(fit.parameters, self.values, self.low, self.high, strict=True)
        )
        listed = ", ".join(f"{p.name} {v:.5g} {p.unit}" for p, v in zip(fit.parameters, self.values, strict=True))
        remark = f"{said}; without that the parameters would be {listed}, and the intervals reach there"
        remark += f": {remedy}" if remedy else ""
        return replace(fit, parameters=parameters, remarks=(remark, *fit.remarks))


def fit_without_outliers(plan: Plan, solved: Solved) -> tuple[list[str], Alternative] | None:
    """Fit again without readings that jump out; the files that have such, and where the parameters come out.

    None where there are none, or where a robust loss weighs them less already, or where that fit fails.
    """
    bad = [outlying(one.residual_um, run.fitted) for one, run in zip(solved.sums, solved.runs, strict=True)]
    sources = [run.record.source for one, run in zip(bad, solved.runs, strict=True) if one.any()]
    if plan.loss != "squares" or not sources:
        return None
    runs = [replace(run, fitted=run.fitted & ~one) for run, one in zip(solved.runs, bad, strict=True)]
    plan.progress(f"fitting without the outliers of {', '.join(sources)}")
    try:
        found = solve_chain(solved.onward, runs, plan.loss, plan.progress, accept_best=True)
    except (FitError, np.linalg.LinAlgError):
        return None
    return sources, Alternative.of(Precision(found))
