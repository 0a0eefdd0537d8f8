"""A diagnosis in words, as a terminal shows it."""

import math

from fits.diagnosis._result import Diagnosis
from fits.report._diagnosis import KINDS


def describe_diagnosis(diagnosis: Diagnosis) -> str:
    """Put a diagnosis into a few lines, without a newline at the end: verdict, causes with parameters, and gain."""
    lines = [f"{KINDS[diagnosis.verdict]}; noise {diagnosis.noise_um:.3g} um, {diagnosis.noise_source}"]
    for cause in diagnosis.causes:
        also = f", or {', '.join(cause.also_consistent)}" if cause.also_consistent else ""
        lines.append(f"  {cause.name}{also}: {cause.z:.3g} standard deviations, by chance {cause.p_family:.1g}")
        if math.isfinite(cause.rms_um) and math.isfinite(cause.share_of_misfit):
            lines.append(f"    {cause.rms_um:.3g} um, {100 * cause.share_of_misfit:.0f} % of the misfit")
        for each in cause.parameters:
            unit = "" if each.unit == "1" else f" {each.unit}"
            below, above = each.value - each.lower, each.upper - each.value
            # An interval that ends at a bound, or reaches farther to one side, is no standard deviation.
            spread = f"+- {each.sd:.2g}{unit}"
            if not min(below, above) > 0.8 * max(below, above):
                spread = f"(95 %: {each.lower:.3g} to {each.upper:.3g}){unit}"
            lines.append(f"    {each.name:24} {each.value:.4g} {spread}")
    if diagnosis.unexplained_rms_um > 0:
        lines.append(f"  unexplained: {diagnosis.unexplained_rms_um:.3g} um")
    gain = diagnosis.gain
    if math.isfinite(gain.heldout_rms_before_um):
        line = f"error on held-out data: {gain.heldout_rms_before_um:.3g} um"
        if diagnosis.causes and math.isfinite(gain.heldout_rms_after_um):
            line += f" without, {gain.heldout_rms_after_um:.3g} um with what was found"
        lines.append(line)
    if diagnosis.next_experiment is not None:
        lines.append(f"next experiment: {diagnosis.next_experiment.purpose}")
    return "\n".join([*lines, *(f"Note: {remark}" for remark in diagnosis.remarks)])
