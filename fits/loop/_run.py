"""A record made ready for fitting: its memory, which samples count, and where it is held out."""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits.io._errors import DataError
from fits.io._record import Record
from microid import Preisach, Staircase, demagnetised, negative_saturation, positive_saturation, remember

# All records pass through the same compiled functions in pieces of this many samples.
_PIECE = 8192
_STAIRCASES = (64, 512, 4096)
# A record has met an end of the range, or an extreme of its own, once it comes this close, as a fraction of the
# range: the first of these that does not cost most of the samples, as peaks of a smooth command miss an end by a
# little.
_NEAR = (1e-3, 3e-3, 1e-2)

INITIAL_STATES = ("unknown", "negative", "positive", "demagnetised")
VIRGIN = "virgin"
"""As `unknown`, where relays that the range does not reach back may have any state, too."""


@dataclass(frozen=True)
class Run:
    """One record and what its voltage alone says about it.

    Attributes
    ----------
    record
        The measured columns.
    lower_V, upper_V
        Range of the switching voltages.
    starts
        Memory at the beginning of every piece.
    anchor_V, rising
        Per sample, the remembered extreme its branch hangs from, and the branch's direction, shape `(n,)`.
    known
        Samples whose output does not depend on an unknown past, but for a constant, shape `(n,)`.
    fitted
        Samples that may be used for fitting: known and not held out, shape `(n,)`.
    weight
        Of each sample in the sum of squares, shape `(n,)`; None where all count alike.
    """

    record: Record
    lower_V: float
    upper_V: float
    starts: tuple[Staircase, ...]
    anchor_V: np.ndarray
    rising: np.ndarray
    known: np.ndarray
    fitted: np.ndarray
    weight: np.ndarray | None = None

    def weighed(self, residual_um: np.ndarray) -> np.ndarray:
        """Make a residual as large as it counts, shape `(n,)`."""
        return residual_um if self.weight is None else np.sqrt(self.weight) * residual_um

    @property
    def displacement_um(self) -> np.ndarray:
        """Measured displacement, shape `(n,)`."""
        if self.record.displacement_um is None:
            raise DataError(f"{self.record.source}: a displacement column is needed here")
        return self.record.displacement_um

    @property
    def held_out(self) -> np.ndarray:
        """Samples that are predicted, not fitted, shape `(n,)`."""
        return self.known & ~self.fitted


def prepare_run(record: Record, lower_V: float, upper_V: float, initial: str, holdout: float) -> Run:
    """Follow the memory along a record.

    Parameters
    ----------
    record
        Measured voltage and displacement.
    lower_V, upper_V
        Range of the switching voltages; covers the record.
    initial
        Memory before the first sample, one of `INITIAL_STATES`.
    holdout
        Fraction at the end that is kept out of the fit.

    Raises
    ------
    DataError
        If nothing of the record is left to fit.
    """
    voltage = record.voltage_V
    starts, anchor_V, rising = _walk(voltage, initial_state(initial, lower_V, upper_V))
    known = known_samples(voltage, lower_V, upper_V, initial)
    fitted = known.copy()
    if holdout > 0:
        fitted[len(voltage) - round(holdout * len(voltage)) :] = False
    if holdout < 1 and fitted.sum() < 50:
        raise DataError(
            f"{record.source}: only {fitted.sum()} samples are left to fit, 50 are needed: the others come before "
            "the voltage has been at an end of its range, where its unknown history still counts, or are held out; "
            "state the initial state with --initial, hold out less, or record a full loop first"
        )
    return Run(record, lower_V, upper_V, starts, anchor_V, rising, known, fitted)


def initial_state(name: str, lower_V: float, upper_V: float) -> Staircase:
    """Make the memory before a record from its name, one of `INITIAL_STATES`.

    An unknown state is stood in for by negative saturation; the samples that would show the difference are not
    known ones.
    """
    if name in ("negative", "unknown", VIRGIN):
        return negative_saturation(lower_V)
    if name == "positive":
        return positive_saturation(lower_V, upper_V)
    if name == "demagnetised":
        return demagnetised(lower_V, upper_V)
    raise DataError(f"unknown initial state {name!r}: choose one of {', '.join(INITIAL_STATES)}")


def known_samples(voltage: np.ndarray, lower_V: float, upper_V: float, initial: str = "unknown") -> np.ndarray:
    """Mark what no longer depends on a past that is `initial`, one of `INITIAL_STATES` or `VIRGIN`.

    At an end of the range every relay is in a known state, if none lies beyond: one that a voltage within the range
    switches on and none switches off is on after the first loop, and may have been off before. Short of that, relays
    outside the extremes that this run itself reaches either never switch or switch on the way to them; once both
    have been visited they are a constant, which the run's own offset takes up.
    """
    if initial not in ("unknown", VIRGIN):
        return np.ones(len(voltage), dtype=bool)
    highest, lowest = np.maximum.accumulate(voltage), np.minimum.accumulate(voltage)
    found: list[np.ndarray] = []
    for share in _NEAR:
        near = share * (upper_V - lower_V)
        saturated = (lowest <= lower_V + near) | (highest >= upper_V - near)
        own = near if found else 0.0
        both = (highest >= voltage.max() - own) & (lowest <= voltage.min() + own)
        found.append(both if initial == VIRGIN else saturated | both)
    return next(known for known in found if 2 * known.sum() >= found[-1].sum())


def _walk(voltage: np.ndarray, start: Staircase) -> tuple[tuple[Staircase, ...], np.ndarray, np.ndarray]:
    for size in _STAIRCASES:
        walked = _pieces(voltage, _resized(start, size))
        if walked is not None:
            return walked
    raise DataError(
        f"the voltage nests more than {_STAIRCASES[-1]} loops into each other: that is noise, not a drive; "
        "use the commanded voltage"
    )


def _resized(start: Staircase, size: int) -> Staircase:
    old = start.extremes_V.shape[0]
    if old >= size:
        return start
    pad = jnp.full(size - old, start.extremes_V[0])
    return Staircase(jnp.concatenate([start.extremes_V, pad]), start.count)


def _pieces(voltage: np.ndarray, start: Staircase) -> tuple[tuple[Staircase, ...], np.ndarray, np.ndarray] | None:
    starts, anchors, risings = [], [], []
    for piece in split(voltage):
        starts.append(start)
        anchor, rising, start = _remember(jnp.asarray(piece), start)
        anchors.append(anchor)
        risings.append(rising)
        if np.isnan(start.extremes_V[0]):
            return None
    n = len(voltage)
    return tuple(starts), np.concatenate(anchors)[:n], np.concatenate(risings)[:n]


def split(values: np.ndarray) -> list[np.ndarray]:
    """Cut values into pieces of one length; the last is filled up with its final value, which changes no memory."""
    pieces = []
    for first in range(0, len(values), _PIECE):
        piece = values[first : first + _PIECE]
        pieces.append(np.pad(piece, (0, _PIECE - len(piece)), mode="edge"))
    return pieces


@eqx.filter_jit
def _remember(
    voltage_V: Float[Array, " n"], start: Staircase
) -> tuple[Float[Array, " n"], Bool[Array, " n"], Staircase]:
    memory = remember(voltage_V, start)
    anchor = memory.path_V[memory.anchor]
    return anchor[memory.lead :], memory.rising[memory.lead :], memory.end()


@eqx.filter_jit
def _respond(model: Preisach, voltage_V: Float[Array, " n"], start: Staircase) -> Float[Array, " n"]:
    return model(voltage_V, start)


def simulate_run(model: Preisach, run: Run) -> np.ndarray:
    """Predict the displacement of a run, in um, shape `(n,)`."""
    pieces = split(run.record.voltage_V)
    out = [_respond(model, jnp.asarray(v), start) for v, start in zip(pieces, run.starts, strict=True)]
    return np.concatenate(out)[: len(run.record)]
