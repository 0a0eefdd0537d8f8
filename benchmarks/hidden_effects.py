"""What `microid diagnose` finds of effects that the bench hides, over random rigs.

Each rig has a hysteresis, a driver, a mechanics and a noise of its own, and one hidden effect, none, a pair, or one
that no effect of the library describes. The diagnosis reads nothing but the CSVs; its answer is then held against the
truth. Every answer is appended to a JSON-lines file as it comes, so that the study can be stopped with Ctrl-C and
goes on where it was; answers of other code or settings are left alone. Prints the tables in Markdown. A few minutes
per rig on one core.

    python benchmarks/hidden_effects.py --rigs 20 --seed 700 [--effects creep none creep+slew_limit] [--jobs 2]

With `--truth second` the stage beneath the effects is never one of the library: few plays, a relaxation spectrum, a
gain that depends on the amplitude, and coloured noise. A row is replayed by `data_synth.hidden([effect], seed=seed,
truth=...)`.
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import secrets
import signal
import tempfile
import time
from pathlib import Path
from typing import Any

from _hidden_tables import predicts_worse, report

PAIRS = (
    ("creep", "second_resonance"),
    ("thermal_drift", "slew_limit"),
    ("transport_delay", "backlash"),
    ("creep", "sensor_nonlinearity"),
    ("mains_hum", "driver_saturation"),
    ("creep", "zero_shift"),
)
_NONE_PER_EFFECT = 4
# A worker keeps what it has compiled, and is replaced before that fills the memory or its mappings.
_TASKS_PER_WORKER = 2


def source_digest() -> str:
    """Name of the code that answers: answers of other code are not counted with its own."""
    root = Path(__file__).parents[1]
    parts = hashlib.sha256()
    for package in ("microid", "fits", "data_synth"):
        for path in sorted((root / package).rglob("*.py")):
            parts.update(path.read_bytes())
    return parts.hexdigest()[:12]


def begin() -> None:
    """Prepare a worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from fits.io._jax_setup import start_jax

    start_jax()


def hide(names: tuple[str, ...], seed: int, settings: dict[str, Any], temperature: bool | None = None) -> Any:
    """Hide effects in a rig."""
    import data_synth

    sizes = {name: settings[name] for name in ("rms_per_noise", "slow_samples", "fast_samples")}
    stage = {"hold": settings.get("hold", "first"), "truth": settings.get("truth", "first")}
    return data_synth.hidden(names, seed=seed, temperature=temperature, **stage, **sizes)


def read_back(bench: Any) -> tuple[list[Any], list[Any]]:
    """What the CSVs of a rig say: the runs, and those held out."""
    import data_synth
    import fits

    with tempfile.TemporaryDirectory() as folder:
        data_synth.write(bench, folder)
        slow, fast, *aside = (fits.read_csv(Path(folder) / f"{r.name}.csv") for r in bench.records)
    return [slow, fast], aside


def answer(task: tuple[str, int, dict[str, Any]]) -> dict[str, Any]:
    """Hide, diagnose and compare."""
    hidden, seed, settings = task
    import fits
    from fits import diagnose
    from fits.diagnosis._score import best_of

    names = () if hidden == "none" else tuple(hidden.split("+"))
    bench = hide(names, seed, settings)
    row: dict[str, Any] = {
        "hidden": hidden,
        "seed": seed,
        "settings": settings,
        "rig": bench.rig.kind,
        "noise_um": bench.scenario.sensor.noise_um,
        "resonance_Hz": bench.plant.natural_frequency_Hz if bench.plant else None,
        "range_V": [bench.rig.lower_V, bench.rig.upper_V],
        "columns": sorted({name for r in bench.records for name in r.columns()} & {"temperature_C", "other_um"}),
        "truth": {
            e.name: {"parameters": e.parameters, "rms_um": e.rms_um, "capped": e.capped} for e in bench.effects
        },
    }
    began = time.monotonic()
    try:
        records, aside = read_back(bench)
        found = diagnose(records, holdout=aside, false_alarm=settings["false_alarm"])
        again = play_next(bench, found, names, records, aside, settings)
    except (fits.DataError, fits.FitError) as error:
        return row | {"refused": str(error), "seconds": time.monotonic() - began}
    except Exception as error:  # a study does not end for one rig
        return row | {"failed": f"{type(error).__name__}: {error}", "seconds": time.monotonic() - began}
    best = best_of(found.details["selection"].scores)
    gain = found.gain
    row |= {
        "seconds": time.monotonic() - began,
        "verdict": found.verdict,
        "found_noise_um": found.noise_um,
        "unexplained_rms_um": found.unexplained_rms_um,
        "truth_z": {name: float(best[name].z) if name in best else None for name in names},
        "causes": [
            {
                "name": cause.name,
                "form": cause.form,
                "also": list(cause.also_consistent),
                "z": float(cause.z),
                "p": float(cause.p_family),
                "share": float(cause.share_of_misfit),
                "parameters": {p.name: [p.value, p.sd] for p in cause.parameters},
            }
            for cause in found.causes
        ],
        "heldout_um": [float(gain.heldout_rms_before_um), float(gain.heldout_rms_after_um)],
        "heldout_sd_um": float(gain.sd_of_difference_um),
        "remarks": list(found.remarks),
        "next_experiment": None if found.next_experiment is None else found.next_experiment.kind,
        "again": again,
    }
    return row | {"heldout_worse": predicts_worse(row)}


def play_next(
    bench: Any, found: Any, names: tuple[str, ...], records: list[Any], aside: list[Any], settings: dict[str, Any]
) -> dict[str, Any] | None:
    """Where a class stayed open, play the experiment that was suggested, and ask again with its record."""
    import numpy as np

    import fits
    from fits import diagnose

    ahead = found.next_experiment
    if not names or not found.causes or not found.causes[0].also_consistent or ahead is None:
        return None
    if ahead.extra_column.startswith("temperature") and "temperature_C" not in bench.records[0].columns():
        # The same rig, measured again with the column that is asked for.
        bench = hide(names, bench.scenario.seed, settings, temperature=True)
        records, aside = read_back(bench)
    played = bench.play(ahead.time_s, ahead.voltage_V, np.random.default_rng(0))
    own = played.columns()
    extra = {name: own[name] for name in own if name not in ("time_s", "voltage_V", "displacement_um")}
    more = fits.Record(played.time_s, played.voltage_V, played.displacement_um, extra, source="again.csv")
    better = diagnose([*records, more], holdout=aside, false_alarm=settings["false_alarm"])
    first = better.causes[0] if better.causes else None
    return {
        "predicted_z": float(ahead.predicted_z),
        "first": first and first.name,
        "also": list(first.also_consistent) if first else [],
        "resolved": first is not None and first.name in names and not first.also_consistent,
    }


def read_rows(path: Path) -> list[dict[str, Any]]:
    """All whole lines; the last may have been cut off."""
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return rows


def words(row: dict[str, Any]) -> str:
    """Say what a row says, for the progress."""
    if "verdict" not in row:
        return row.get("refused") or row.get("failed") or ""
    named = ", ".join(" or ".join([c["name"], *c["also"]]) + f" {c['z']:.1f}" for c in row["causes"])
    return f"{row['verdict']} {named}" + (", held-out runs predicted worse" if predicts_worse(row) else "")


def main() -> None:
    """Run the study."""
    # Before NumPy is imported: each worker is one thread.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    os.environ["JAX_PLATFORMS"] = "cpu"
    from data_synth import EFFECTS, OUTSIDE

    singles = [*EFFECTS, *OUTSIDE, "none"]
    parser = argparse.ArgumentParser(description="What a diagnosis finds of hidden effects.")
    parser.add_argument("--rigs", type=int, default=10, help="for each effect (default 10)")
    parser.add_argument("--none", type=int, help="rigs without effect (default 4 times --rigs)")
    parser.add_argument("--seed", type=int, help="of the first rig (default a fresh one)")
    parser.add_argument(
        "--effects", nargs="+", metavar="EFFECT", help="some, `none`, or pairs as a+b; all by default"
    )
    parser.add_argument("--rms-per-noise", type=float, default=5.0, help="strength over the noise (default 5)")
    parser.add_argument("--samples", type=int, nargs=2, default=(4000, 8000), metavar=("SLOW", "FAST"))
    parser.add_argument("--hold", choices=["first", "zero"], default="first", help="command in lines, or in steps")
    parser.add_argument("--truth", choices=["first", "second"], default="first", help="stage beneath the effects")
    parser.add_argument("--false-alarm", type=float, default=0.01)
    parser.add_argument("--jobs", type=int, default=2, help="rigs at a time (default 2)")
    parser.add_argument(
        "--results", type=Path, default=Path("build/hidden_effects.jsonl"), help="where answers are kept"
    )
    parser.add_argument("--out", type=Path, metavar="FILE.md", help="also write the tables to a file")
    parser.add_argument("--tables", action="store_true", help="tables of the answers that there are, and no more")
    options = parser.parse_args()
    chosen = options.effects or [*singles, *("+".join(pair) for pair in PAIRS)]
    unknown = sorted({part for name in chosen for part in name.split("+")} - set(singles))
    if unknown:
        parser.error(f"there is no effect {unknown[0]!r}: choose some of {', '.join(singles)}")
    seed = secrets.randbelow(10**6) if options.seed is None else options.seed
    settings = {
        "code": source_digest(),
        "rms_per_noise": options.rms_per_noise,
        "slow_samples": options.samples[0],
        "fast_samples": options.samples[1],
        "false_alarm": options.false_alarm,
        "hold": options.hold,
    }
    if options.truth != "first":
        settings["truth"] = options.truth
    plain = _NONE_PER_EFFECT * options.rigs if options.none is None else options.none
    counts = {name: plain if name == "none" else options.rigs for name in chosen}
    # Rig by rig, so that a study that is stopped has some of everything.
    wanted = [(name, seed + k) for k in range(max(counts.values())) for name in chosen if k < counts[name]]
    rows = {(r["hidden"], r["seed"]): r for r in read_rows(options.results) if r["settings"] == settings}
    tasks = [] if options.tables else [(*one, settings) for one in wanted if one not in rows]
    print(f"{len(wanted)} rigs from seed {seed}, {len(tasks)} to go, code {settings['code']}", flush=True)
    try:
        run(tasks, options.jobs, options.results, rows)
    except KeyboardInterrupt:
        print("stopped: the same command with this seed goes on")
    text = report([rows[one] for one in wanted if one in rows], settings, seed)
    print(text)
    if options.out is not None:
        options.out.write_text(text + "\n", encoding="utf-8")


def run(tasks: list[Any], jobs: int, path: Path, rows: dict[tuple[str, int], dict[str, Any]]) -> None:
    """Answer the tasks, and keep each answer at once."""
    if not tasks:
        return
    began = time.monotonic()
    path.parent.mkdir(parents=True, exist_ok=True)
    pool = multiprocessing.get_context("spawn").Pool(min(jobs, len(tasks)), begin, maxtasksperchild=_TASKS_PER_WORKER)
    with pool, path.open("a", encoding="utf-8") as file:
        for k, row in enumerate(pool.imap_unordered(answer, tasks), 1):
            rows[row["hidden"], row["seed"]] = row
            file.write(json.dumps(row, default=float) + "\n")
            file.flush()
            left_min = (time.monotonic() - began) / k * (len(tasks) - k) / 60
            print(
                f"{k}/{len(tasks)} {row['hidden']} {row['seed']}: {words(row)}; {row['seconds']:.0f} s, "
                f"{left_min:.0f} min to go",
                flush=True,
            )


if __name__ == "__main__":
    main()
