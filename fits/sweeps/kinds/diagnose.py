"""The job `diagnose`: what a fitted stage gets wrong in each of many records, one by one."""

from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from fits.io._record import Record
from fits.io._typed import typed
from fits.loop._plain import INITIAL_STATES
from fits.sweeps._records import Files, Holdout, Initial, Simulated, assumed_initial, each_alone, requested_records
from fits.sweeps._types import AbstractJob, Block, Facts, Output, Parameter, Request, Rows, choice

KEYS = ("model", "initial", "program", "records", "diagnose")
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


class _Options(msgspec.Struct):
    """The table `[diagnose]`."""

    false_alarm: Annotated[float, Meta(gt=0, le=0.5, description="a probability above 0 and up to 0.5")] = 0.01
    holdout: Holdout = 0.2
    initial: Initial = None


@dataclass(frozen=True, eq=False)
class DiagnoseJob(AbstractJob):
    """Diagnoses of records, with the options of `fits.diagnose` and the memory before each record."""

    records: Files | Simulated
    options: _Options
    initial: str

    @property
    def facts(self) -> Facts:
        """What is known before it runs."""
        options = (
            Parameter("diagnose.false_alarm", "1", self.options.false_alarm, 1e-6, 0.5),
            Parameter("diagnose.holdout", "1", self.options.holdout, 0.0, 0.9),
            choice("diagnose.initial", INITIAL_STATES, self.initial),
        )
        return Facts((*self.records.parameters, *options), _OUTPUTS, 1, self.records.sources, alone=True)

    def compute(self, block: Block) -> Rows:
        """Diagnose one record; see `AbstractJob.compute`."""
        alarm = block.numbers("diagnose.false_alarm", self.options.false_alarm).tolist()
        holdout = block.numbers("diagnose.holdout", self.options.holdout).tolist()
        initial = block.words("diagnose.initial", INITIAL_STATES, self.initial)
        seeds = [block.seed] * len(alarm)
        return each_alone(_OUTPUTS, self.records.records(block), _diagnosed, alarm, holdout, initial, seeds)


def _diagnosed(record: Record, false_alarm: float, holdout: float, initial: str, seed: int) -> dict[str, Any]:
    from fits.diagnosis._diagnose import diagnose

    found = diagnose([record], holdout=holdout, false_alarm=false_alarm, initial=initial, seed=seed)
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
    }


def make(request: Request) -> DiagnoseJob:
    """Make the job that a sweep asks for; a `DataError` says what is wrong with it."""
    records = requested_records(request)
    options = typed(request.table.get("diagnose", {}), _Options, "diagnose")
    return DiagnoseJob(records, options, options.initial or assumed_initial(request, records))
