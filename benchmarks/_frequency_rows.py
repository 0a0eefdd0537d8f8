"""Rows for the frequency domain: modes of a measured mirror, with and without hysteresis, held out."""

import time
from pathlib import Path

from _timing import Line, Table

import fits

_DATA = Path(__file__).parents[2] / "shared" / "data"
# The first two modes; a third one stands for the next above the band.
_BAND_Hz, _MODES = (5.0, 860.0), 3
# Thresholds over the root mean square of the voltage.
_THRESHOLDS = (0.3, 1.6)
_LEARNT, _TESTED = slice(0, 4), slice(4, 6)


def frequency(table: Table) -> dict[str, tuple[float, float]]:
    """Fit realizations 0 to 3 of the fine steering mirror, judge by 4 and 5.

    Returns the relative errors of each record, linear and with hysteresis.
    """
    found: dict[str, tuple[float, float]] = {}
    for level_mV in (100, 300):
        path = _DATA / f"fsm_cubespec_{level_mV}mV_train.csv"
        what = f"mirror, {level_mV} mV, {_BAND_Hz[0]:g}-{_BAND_Hz[1]:g} Hz, held-out realizations"
        if not path.exists():
            table.add(Line(what, "", "", note="skipped: shared/data does not lie beside the repository"))
            continue
        measured = fits.read_multisine(path)
        learnt, tested = measured.take(_LEARNT), measured.take(_TESTED)
        begin = time.process_time()
        plain, smooth = (fits.relative_error(fits.estimate_response(learnt, n), tested) for n in (0, None))
        middle = time.process_time()
        table.add(
            Line(
                f"mirror, {level_mV} mV, whole band, held-out realizations, without a model",
                "wins",
                f"{100 * smooth:.2f} %",
                f"{middle - begin:.3g}",
                note=f"neighbouring lines together; line by line {100 * plain:.2f} %",
            )
        )
        begin = middle
        whole = fits.estimate_nonlinear_response(learnt)
        middle = time.process_time()
        table.add(
            Line(
                f"mirror, {level_mV} mV, whole band, held-out realizations, with distortion",
                "wins",
                f"{100 * fits.relative_error(whole, tested):.2f} %",
                f"{middle - begin:.3g}",
                note=f"plays and products explain {100 * whole.explained:.0f} % of what was left out, in squares",
            )
        )
        begin = middle
        linear = fits.fit_response(fits.estimate_response(learnt), _MODES, _BAND_Hz, coupled=True)
        middle = time.process_time()
        threshold_V = [share * level_mV / 1000 for share in _THRESHOLDS]
        bent = fits.fit_hysteresis(learnt, linear, threshold_V, _BAND_Hz, coupled=True)
        end = time.process_time()
        errors = tuple(fits.relative_error(model, tested, _BAND_Hz) for model in (linear.model, bent.model))
        found[path.name] = (errors[0], errors[1])
        natural = ", ".join(f"{value:.1f}" for value in sorted(linear.model.natural_frequency_Hz.tolist())[:2])
        note = f"modes at {natural} Hz, misfit {linear.misfit:.2f}"
        table.add(Line(f"{what}, linear", "", f"{100 * errors[0]:.2f} %", f"{middle - begin:.3g}", note=note))
        note = f"misfit {bent.misfit:.2f}, {len(threshold_V)} plays of each voltage, at 0.3 and 1.6 times its rms"
        table.add(Line(f"{what}, with plays", "wins", f"{100 * errors[1]:.2f} %", f"{end - middle:.3g}", note=note))
    return found
