"""The job `diagnose`: what a fitted stage gets wrong in each of many records, one by one."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fits.io._errors import DataError, shown
from fits.io._record import Record
from fits.loop._result import FitError
from fits.loop._run import INITIAL_STATES
from fits.machining._design import nearest
from fits.sweeps._choices import choice, chosen
from fits.sweeps._jobs import Request
from fits.sweeps._programs import number
from fits.sweeps._records import Files, Simulated, requested_records
from fits.sweeps._types import AbstractJob, Facts, FloatArray, Output, Parameter, Rows

_KEYS = ("false_alarm", "holdout", "initial")
_OUTPUTS = (
    Output("causes", "1", "number of causes found"),
    Output("z", "1", "evidence for the first cause, in standard deviations"),
    Output("noise_um", "um", "standard deviation of the noise"),
    Output("unexplained_rms_um", "um", "error that nothing explains"),
    Output("heldout_rms_before_um", "um", "error on held-out data without what was found"),
    Output("heldout_rms_after_um", "um", "error on held-out data with what was found"),
    Output("verdict", "1", "no_effect, effect_found or unexplained", dtype="U16"),
    Output("first_cause", "1", "name of the first cause", dtype="U64"),
)


class DiagnoseJob(AbstractJob):
    """Diagnoses of records."""

    def __init__(self, records: Files | Simulated, false_alarm: float, holdout: float, initial: str):
        """Take the records and the options of `fits.diagnose`."""
        self._records, self._false_alarm = records, false_alarm
        self._holdout, self._initial = holdout, initial

    @property
    def facts(self) -> Facts:
        """What is known before it runs."""
        sources = self._records.names if isinstance(self._records, Files) else ()
        options = (
            Parameter("diagnose.false_alarm", "1", self._false_alarm, 1e-6, 0.5),
            Parameter("diagnose.holdout", "1", self._holdout, 0.0, 0.9),
            choice("diagnose.initial", INITIAL_STATES, self._initial),
        )
        return Facts((*self._records.parameters, *options), _OUTPUTS, 1, sources, alone=True)

    def compute(
        self, values: Mapping[str, FloatArray], rows: NDArray[np.int64], sources: NDArray[np.int64], seed: int
    ) -> Rows:
        """Diagnose one record; see `AbstractJob.compute`."""
        records, every = self._records.records(values, rows, sources, seed), np.ones(len(rows))
        alarm = values.get("diagnose.false_alarm", every * self._false_alarm).tolist()
        holdout = values.get("diagnose.holdout", every * self._holdout).tolist()
        initial = chosen(values, "diagnose.initial", INITIAL_STATES, self._initial, len(rows))
        found = [self._one(*options, seed) for options in zip(records, alarm, holdout, initial, strict=True)]
        outputs = {
            output.name: np.array(
                [each[0].get(output.name, "" if output.dtype[0] == "U" else np.nan) for each in found]
            )
            for output in _OUTPUTS
        }
        return Rows(outputs, tuple(reason for _, reason in found))

    def _one(
        self, record: Record | str, false_alarm: float, holdout: float, initial: str, seed: int
    ) -> tuple[dict[str, Any], str]:
        if isinstance(record, str):
            return {}, record
        from fits.diagnosis._diagnose import diagnose

        try:
            found = diagnose([record], holdout=holdout, false_alarm=false_alarm, initial=initial, seed=seed)
        except (DataError, FitError) as error:
            return {}, " ".join(str(error).split())
        first = found.causes[0] if found.causes else None
        return {
            "causes": float(len(found.causes)),
            "z": 0.0 if first is None else first.z,
            "noise_um": found.noise_um,
            "unexplained_rms_um": found.unexplained_rms_um,
            "heldout_rms_before_um": found.gain.heldout_rms_before_um,
            "heldout_rms_after_um": found.gain.heldout_rms_after_um,
            "verdict": found.verdict,
            "first_cause": "" if first is None else first.name,
        }, ""


def make(request: Request) -> DiagnoseJob:
    """Make the job that a sweep asks for; a `DataError` says what is wrong with it."""
    records, table = requested_records(request), request.table.get("diagnose", {})
    for key in table:
        if key not in _KEYS:
            raise DataError(f"diagnose.{key}: expected a known key, found {shown(key)}; {nearest(key, _KEYS)}")
    known = request.table.get("initial", "negative") if isinstance(records, Simulated) else "unknown"
    initial = table.get("initial", known)
    if initial not in INITIAL_STATES:
        raise DataError(
            f"diagnose.initial: expected one of {', '.join(INITIAL_STATES)}, found {shown(initial)}; choose one."
        )
    alarm = number(table.get("false_alarm", 0.01), "diagnose.false_alarm")
    if not 0 < alarm <= 0.5:
        raise DataError(f"diagnose.false_alarm: expected a probability above 0 and up to 0.5, found {alarm:g}.")
    holdout = number(table.get("holdout", 0.2), "diagnose.holdout")
    if not 0 <= holdout <= 0.9:
        raise DataError(f"diagnose.holdout: expected a share between 0 and 0.9, found {holdout:g}; correct it.")
    return DiagnoseJob(records, alarm, holdout, initial)
