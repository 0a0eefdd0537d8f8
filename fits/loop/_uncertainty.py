"""How sure a prediction is."""

from abc import abstractmethod

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from fits.io._errors import DataError
from fits.io._record import Record
from fits.loop._design import Grid
from fits.loop._plain import Perturbations
from fits.loop._prediction import Initial, Prediction, inside, predict_from
from fits.loop._run import Run, prepare_run, simulate_run
from microid import Preisach, Stage


class AbstractUncertainty(eqx.Module):
    """How sure the predictions of a fitted model are.

    `discrepancy_um` is the standard deviation of the model's own error, as predicting parts of records shows it.
    """

    discrepancy_um: eqx.AbstractVar[Float[Array, ""]]

    @abstractmethod
    def sd_um(self, model: Preisach | Stage, run: Run) -> np.ndarray:
        """Standard deviation of the predicted displacement of a run, shape `(n,)`."""

    @abstractmethod
    def predict_known(self, model: Preisach | Stage, record: Record, initial: Initial) -> Prediction:
        """Predict the displacement of a voltage program from a memory that is known; see `fits.predict`."""

    def predict(self, model: Preisach | Stage, record: Record, initial: Initial) -> Prediction:
        """Predict the displacement of a voltage program; see `fits.predict`."""
        return predict_from(initial, lambda state: self.predict_known(model, record, state))


class Uncertainty(AbstractUncertainty):
    """Independent perturbations of a hysteresis, each one standard deviation long.

    The variance of a prediction is the sum of the squared responses to all of them: the covariance of the weights,
    carried through the linear operator. To that comes what the model is seen to leave out. It is the uncertainty of
    the noise-free displacement: sensor noise is not in it. Perturbations of the columns of the grid and of the sensor
    offset go together; `discrepancy_um` is as in `AbstractUncertainty`.
    """

    columns_um: Float[Array, "k D"]
    offset_um: Float[Array, " k"]
    discrepancy_um: Float[Array, ""]
    grid: Grid

    def sd_um(self, model: Preisach | Stage, run: Run) -> np.ndarray:
        """Standard deviation of the predicted displacement of a run, shape `(n,)`; it is that of any such model."""
        del model
        densities, discrepancy_um = self.grid.densities(np.asarray(self.columns_um).T), float(self.discrepancy_um)
        return Perturbations(*densities, self.grid.ends_V, np.asarray(self.offset_um), discrepancy_um).sd_um(run.path)

    def predict_known(self, model: Preisach | Stage, record: Record, initial: Initial) -> Prediction:
        if not isinstance(model, Preisach):
            raise DataError("the uncertainty is that of a hysteresis, and the model is a stage: fit it again")
        range_V = float(model.density.lower_V), float(model.density.upper_V)
        run = prepare_run(inside(record, *range_V), range_V, initial, holdout=1.0)
        return Prediction(simulate_run(model, run), self.sd_um(model, run), run.record.warnings)
