"""Measured loops: `fits.fit` beside plain non-negative least squares, on what neither has seen.

Usage: `python benchmarks/real_loops.py [RECORD ...]`, records named as in `RECORDS`. Each is read from
`../shared/data`; its first two thirds are fitted, its last third is predicted, with the sensor offset of the fitted
part. The peer has as many levels as the fit chose: a density that is constant in each cell of the half-plane, a slope
that is the same everywhere, all non-negative, and negative saturation before the first sample. Figures are in %
of the stroke; the last are those of `fits.fit_slow`, with a lag and three relaxations, beside the same peer.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.optimize import nnls

import fits

jax.config.update("jax_enable_x64", True)

DATA = Path(__file__).parents[1].parent / "shared" / "data"
RECORDS = (
    "picma_p885_sine_1hz",
    "picma_p885_amplitude_modulated",
    "afm_z_piezo_hold30s",
    "afm_z_piezo_50um_2rates",
    "afm_z_piezo_5um",
)
HELD_OUT = 1 / 3
RELAXATIONS = 3
# Strips into which the peer divides each level, to integrate over the upper thresholds.
STRIPS = 16


def responses(voltage_V: np.ndarray, levels: int) -> np.ndarray:
    """Share of the relays of every cell that are on, and the voltage, shape `(n, levels (levels + 1) / 2 + 1)`."""
    place = (voltage_V - voltage_V.min()) / np.ptp(voltage_V)
    strips = levels * STRIPS
    lower, middle = np.arange(strips) / strips, (np.arange(strips) + 0.5) / strips
    # Of the relays that switch on within a strip those are on whose lower threshold is below `front`; `turned` is
    # where that was when the voltage last turned up.
    front, turned, before = np.zeros(strips), np.zeros(strips), 0.0
    out = np.empty((len(place), levels * (levels + 1) // 2 + 1))
    which = np.tril_indices(levels)
    for k, v in enumerate(place):
        if v < before:
            front = turned = np.minimum(front, v)
        else:
            swept = np.clip((v - lower) * strips, 0.0, 1.0)
            front = np.maximum(front, swept * middle + (1 - swept) * turned)
        before = v
        share = np.clip(front[:, None] * levels - np.arange(levels), 0.0, 1.0)
        out[k, :-1] = share.reshape(levels, STRIPS, levels).mean(axis=1)[which]
    out[:, -1] = place
    return out


def peer(record: fits.Record, levels: int, seen: np.ndarray) -> np.ndarray:
    """Predict a record by non-negative least squares on the samples seen, shape `(n,)`."""
    columns, measured = responses(record.voltage_V, levels), record.displacement_um
    middle, mean = columns[seen].mean(axis=0), measured[seen].mean()
    root, short = np.linalg.qr(np.c_[columns[seen] - middle, measured[seen] - mean])[1], columns.shape[1]
    weights, _ = nnls(root[:, :short], root[:, short], maxiter=100 * short)
    return mean + (columns - middle) @ weights


def errors_pct(record: fits.Record, predicted_um: np.ndarray, seen: np.ndarray) -> tuple[float, float]:
    """Root mean square errors where seen and after, in % of the stroke, the offset taken off where seen."""
    off = record.displacement_um - predicted_um
    known = np.arange(len(off)) >= np.argmax(seen)
    off = 100 * (off - off[seen].mean()) / np.ptp(record.displacement_um[known])
    after = known & (np.arange(len(off)) > np.flatnonzero(seen)[-1])
    return float(np.sqrt(np.mean(off[seen] ** 2))), float(np.sqrt(np.mean(off[after] ** 2)))


def compare(record: fits.Record, **options: Any) -> None:
    """Print a line of figures for each fit of one record."""
    started = time.perf_counter()
    try:
        found = fits.fit([record], holdout=HELD_OUT, **options)
    except fits.DataError:
        # It never comes to an end of its range: the fit is told what the peer assumes.
        options["initial"] = "negative"
        found = fits.fit([record], holdout=HELD_OUT, **options)
    took = time.perf_counter() - started
    more = fits.fit_slow([record], lag=True, relaxations=RELAXATIONS, holdout=HELD_OUT, **options)
    run, levels = found.runs[0], found.hysteresis.density.levels
    seen = np.arange(len(record)) < len(record) - round(HELD_OUT * len(record))
    seen[: run.unknown] = False
    inside, after = run.in_sample.e_rms_pct, run.held_out.e_rms_pct
    peer_inside, peer_after = errors_pct(record, peer(record, levels, seen), seen)
    print(
        f"{Path(record.source).stem:32} {levels:3d} {run.unknown:6d}  {inside:7.4f} {after:7.4f}  {peer_inside:7.4f} "
        f"{peer_after:7.4f}  {after / peer_after:5.2f}  {more.in_sample.e_rms_pct:7.4f} "
        f"{more.held_out.e_rms_pct:7.4f}  {more.held_out.e_rms_pct / peer_after:5.2f}  {took:5.1f} s",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("records", nargs="*", default=RECORDS, metavar="RECORD")
    parser.add_argument("--levels", type=int)
    given = parser.parse_args()
    print(
        f"{'record':32} levels unused  fit: in, held out  peer: in, held out  ratio  lagging: in, held out ratio time"
    )
    for name in given.records:
        compare(fits.read_csv(DATA / f"{name}.csv"), levels=given.levels)


if __name__ == "__main__":
    main()
