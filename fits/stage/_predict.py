"""Predictions of a fitted model: a hysteresis alone, or a whole stage."""

import numpy as np

from fits.io._record import Record
from fits.loop._uncertainty import AbstractUncertainty, Prediction
from fits.stage._run import prepare_program, simulate_stage
from microid import Preisach, Stage


def predict(
    model: Preisach | Stage, uncertainty: AbstractUncertainty | None, record: Record, initial: str = "negative"
) -> Prediction:
    """Predict the displacement of a voltage program, with its uncertainty.

    Parameters
    ----------
    model, uncertainty
        From a fit or a model file; without an uncertainty the standard deviations are NaN.
    record
        The program; its displacement, if any, is not looked at.
    initial
        Memory before the first sample: `negative`, `positive` or `demagnetised`.

    Raises
    ------
    DataError
        If the voltage leaves the range that the model was fitted on, a stage has an effect of another column that the
        program lacks, or the uncertainty is that of another kind of model.
    """
    if uncertainty is not None:
        return uncertainty.predict(model, record, initial)
    stage, run = prepare_program(model if isinstance(model, Stage) else Stage.of(hysteresis=model), record, initial)
    return Prediction(simulate_stage(stage, run), np.full(len(record), np.nan))
