"""Of an effect that was found in one form, the form that explains more beside other causes."""

import numpy as np
import pytest
from test_diagnosis_foreign import SLOW_V, plays

from fits import Record
from fits.diagnosis._forms import in_best_forms
from fits.diagnosis._prepare import Reading, prepare_diagnosis
from fits.diagnosis._refit import nothing, refit_beside
from fits.diagnosis._score import score

INTERVAL_s = 0.02


@pytest.mark.study
def test_a_creep_taken_for_one_relaxation_goes_along_the_logarithm_of_time(rng):
    """As many relaxations as a logarithm has, each solved for by itself."""
    moved, late = plays(SLOW_V), np.zeros(len(SLOW_V))
    for constant_s in np.geomspace(0.05, 500, 25):
        decay, slow = np.exp(-INTERVAL_s / constant_s), 0.0
        for k in range(1, len(moved)):
            slow = decay * slow + (1 - decay) * (moved[k] - moved[0])
            late[k] += 5e-4 * slow
    reading = moved + late + 0.004 * rng.standard_normal(len(moved))
    record = Record(INTERVAL_s * np.arange(len(moved)), SLOW_V, reading, source="creeps.csv")
    ready = prepare_diagnosis(Reading([record], [], 0.0, "unknown"), lambda _: None)
    plain = nothing(ready.bench, ready.projector)
    creeps = [probe for probe in ready.probes if probe.name == "creep"]
    once = [probe for probe in creeps if probe.form.form == "kelvin_voigt"]
    best = max(score(ready.projector, once, plain.residual).each, key=lambda one: one.z)
    model = refit_beside(ready.bench, ready.projector, plain, best)
    *_, found = in_best_forms(ready.bench, ready.projector, model, ready.probes)
    print(model.cost, found.cost, found.laws[0].form, found.laws[0].values(found.x[0], 0))
    assert model.laws[0].form.form == "kelvin_voigt"
    assert found.laws[0].form.form == ""
    assert found.cost < model.cost - 50
    # It is in the best form, and stays.
    *_, again = in_best_forms(ready.bench, ready.projector, found, ready.probes)
    assert again is found
