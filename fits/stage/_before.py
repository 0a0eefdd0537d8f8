"""What the hysteresis of a stage must have been through before a record."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fits.loop._run import Run
from fits.stage._run import ahead, hysteresis_of, place_of_hysteresis, static_gain, yields_inside
from microid import Preisach, Stage, Staircase, innermost


def memory_before(stage: Stage, run: Run, predicted_um: Float[np.ndarray, " n"], noise_um: float) -> Staircase:
    """The memory before a run, estimated from the samples that depend on it; as the run has it where none does.

    The prediction is that from the run's own start. What another one adds grows as slowly as the voltage goes on to
    where it has not been, so that the parts behind the hysteresis pass it on by their static gains.
    """
    place, law, count = place_of_hysteresis(stage), innermost(hysteresis_of(stage)), run.of_past
    if place is None or not isinstance(law, Preisach) or yields_inside(stage) or not count:
        return run.start
    from fits.loop._estimate_start import estimate_start  # its solver takes long to import

    gain = float(static_gain(stage.parts[place + 1 :]))
    seen_V = np.asarray(ahead(stage, place, run.samples).values)[:: run.stride][:count]
    added_um = (run.displacement_um - predicted_um)[:count] / gain
    return estimate_start(law, seen_V, np.asarray(law(jnp.asarray(seen_V), run.start)) + added_um, noise_um / gain)
