"""Tables of a study of hidden effects, in Markdown."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from datetime import date
from statistics import median
from typing import Any

from scipy.stats import binomtest

Row = dict[str, Any]
_HOLDS = {"first": "lines", "zero": "steps"}
# Standard deviations by which held-out runs are predicted worse beyond chance.
_WORSE = 3.0
_BINS = ((-math.inf, 3.0, "below 3"), (3.0, 5.5, "3 to 5.5"), (5.5, 11.0, "5.5 to 11"), (11.0, math.inf, "above 11"))
_SECOND = (
    "The second truth: every stage is 24 to 60 plays of random radii and weights, with a relaxation of eight "
    "exponential terms and a gain that depends on the amplitude, each 0.5 to 1 times the noise, and its noise is "
    "correlated from sample to sample by 0.5 to 0.9. No form of the library is that: the relaxation is nearest to "
    "creep, so that creep named where nothing is hidden is not all wrong."
)


def _same(truth: str) -> Callable[[Row, Row], float]:
    return lambda parameters, row: parameters[truth]


# For each form of an effect: parameters of the model, and what they are in truth.
SAME: dict[tuple[str, str], dict[str, Callable[[Row, Row], float]]] = {
    ("accommodation", ""): {"feedback_V_per_um": _same("feedback_V_per_um")},
    ("backlash", ""): {"half_gap_um": _same("half_gap_um")},
    ("clock_mismatch", ""): {"rate_ppm": lambda p, row: 1e6 * p["rate_share"]},
    ("creep", ""): {"gain_per_decade": _same("share"), "onset_s": _same("onset_s")},
    ("cross_coupling", ""): {"gain": _same("share")},
    ("driver_saturation", ""): {
        "rail_V": lambda p, row: row["range_V"][1] - p["missing_share"] * (row["range_V"][1] - row["range_V"][0])
    },
    ("driver_asymmetry", ""): {"asymmetry": _same("slower_share")},
    ("end_stop", ""): {"gain_beyond": lambda p, _: 1 / (1 + p["stiffness"])},
    ("floor_vibration", ""): {"frequency_Hz": _same("frequency_Hz")},
    ("friction", ""): {"amplitude_um": _same("force_um"), "length_um": _same("length_um")},
    ("load_change", "within"): {"mass_ratio": _same("mass_share")},
    ("mount_relaxation", ""): {"change_um": _same("settling_um"), "time_constant_s": _same("time_constant_s")},
    ("quantisation", ""): {"step_um": _same("step_um")},
    ("second_resonance", ""): {
        "share": _same("share"),
        "frequency_Hz": lambda p, row: p["frequency_ratio"] * row["resonance_Hz"],
        "damping_ratio": _same("damping_ratio"),
    },
    ("sensor_lowpass", ""): {"time_constant_s": _same("time_constant_s")},
    ("slew_limit", ""): {"limit_V_per_s": _same("rate_V_per_s")},
    ("thermal_drift", ""): {"rate_um_per_s": lambda p, row: p["drift_um"] / 60},
    ("thermal_drift", "temperature"): {
        "expansion_um_per_K": _same("drift_um"),
        "time_constant_s": _same("time_constant_s"),
    },
    ("thermal_gain", "temperature"): {
        "gain_per_K": _same("gain_per_K"),
        "time_constant_s": _same("time_constant_s"),
    },
    # Not timestamp_jitter: on the bench no sample is late by half a period, which fast runs would be.
    ("transport_delay", ""): {"delay_s": _same("delay_s")},
    ("voltage_dependent_capacitance", ""): {"slope": _same("change_share")},
    ("zero_shift", ""): {"shift_um": _same("shift_um")},
}


def report(rows: Sequence[Row], settings: Row, seed: int) -> str:
    """All tables of a study."""
    from data_synth import EFFECTS, OUTSIDE

    done = [row for row in rows if "verdict" in row]
    groups = {name: [r for r in done if r["hidden"] == name] for name in dict.fromkeys(r["hidden"] for r in done)}
    singles = {name: own for name, own in groups.items() if name in EFFECTS}
    outside = {name: own for name, own in groups.items() if name in OUTSIDE}
    pairs = {name: own for name, own in groups.items() if "+" in name}
    second = settings.get("truth") == "second"
    title = "Hidden effects, second truth" if second else "Hidden effects"
    parts = [
        f"# {title}, {date.today()}\n\nRigs from seed {seed}, effects of {settings['rms_per_noise']:g} times "
        f"the noise, {settings['slow_samples']} and {settings['fast_samples']} samples, commands in "
        f"{_HOLDS[settings.get('hold', 'first')]}, false alarms asked for "
        f"{settings['false_alarm']:g}, code {settings['code']}: {len(done)} of {len(rows)} rigs were diagnosed."
    ]
    if second:
        parts.append(_SECOND)
    if "none" in groups:
        parts.append(_none(groups["none"], settings["false_alarm"]))
    if singles:
        parts += [_effects(singles), _bins(singles), _confusion(singles), _columns(singles)]
    if outside:
        parts.append(_outside(outside))
    if pairs:
        parts.append(_pairs(pairs))
    open_ = [row for row in done if row["hidden"] != "none" and row["causes"] and row["causes"][0]["also"]]
    if open_:
        parts.append(_again(open_))
    parts.append(_heldout(done))
    parts.append(_undone([row for row in rows if "verdict" not in row]))
    return "\n\n".join(part for part in parts if part)


def predicts_worse(row: Row) -> bool:
    """Whether the causes predicted the held-out runs worse than the plain stage, beyond chance."""
    if not row["causes"] or row.get("heldout_sd_um") is None:
        return False
    before_um, after_um = row["heldout_um"]
    return bool(after_um - before_um > _WORSE * row["heldout_sd_um"])


def outcome(row: Row, name: str) -> str:
    """What became of a hidden effect."""
    causes = row["causes"]
    if not causes:
        return "not named"
    if causes[0]["name"] == name:
        return "first"
    if name in causes[0]["also"]:
        return "class"
    if any(name == cause["name"] or name in cause["also"] for cause in causes[1:]):
        return "later"
    return "wrong"


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *lines))


def _share(count: int, total: int) -> str:
    if not total:
        return "-"
    interval = binomtest(count, total).proportion_ci(method="exact")
    return f"{count} of {total} ({100 * interval.low:.1f} to {100 * interval.high:.1f} %)"


def _middle(values: Sequence[float], digits: str = ".1f") -> str:
    known = [value for value in values if value is not None and math.isfinite(value)]
    return f"{median(known):{digits}}" if known else "-"


def within(row: Row, name: str) -> list[bool]:
    """For each parameter that the found form shares with the truth: whether it is within three of its sds."""
    found = next((cause for cause in row["causes"] if cause["name"] == name), None)
    if found is None or (name == "thermal_drift" and not found["form"] and "temperature_C" in row["columns"]):
        return []
    truth = row["truth"][name]["parameters"]
    inside = []
    for parameter, true in SAME.get((name, found["form"]), {}).items():
        value, sd = found["parameters"].get(parameter) or found["parameters"].get(
            f"{parameter} in run 1", (None, None)
        )
        if value is not None:
            inside.append(abs(value - true(truth, row)) <= 3 * sd)
    return inside


def _effects(singles: dict[str, list[Row]]) -> str:
    lines = []
    for name, rows in singles.items():
        found = Counter(outcome(row, name) for row in rows)
        inside = [one for row in rows for one in within(row, name)]
        lines.append(
            [
                name,
                *(str(found[word]) for word in ("first", "class", "later", "not named", "wrong")),
                str(len(rows)),
                _middle([row["truth_z"][name] for row in rows]),
                _middle([1 + len(row["causes"][0]["also"]) for row in rows if row["causes"]], ".0f"),
                f"{sum(inside)} of {len(inside)}" if inside else "-",
                _middle([row["heldout_um"][0] / row["noise_um"] for row in rows], ".2f"),
                _middle([row["heldout_um"][1] / row["noise_um"] for row in rows], ".2f"),
                _middle([row["truth"][name]["rms_um"] / row["noise_um"] for row in rows], ".1f"),
            ]
        )
    total = Counter(outcome(row, name) for name, rows in singles.items() for row in rows)
    count = sum(total.values())
    head = ["effect", "first", "in the first's class", "named later", "not named", "wrong", "rigs", "z", "class size"]
    head += ["parameters within 3 sd", "held out before / noise", "after / noise", "size / noise"]
    return (
        "## Effects of the library\n\n"
        f"Named first: {_share(total['first'], count)}; first or in the first's class: "
        f"{_share(total['first'] + total['class'], count)}; a wrong name: {_share(total['wrong'], count)}. Numbers "
        "with a point are medians; z is the effect's best score at the plain stage.\n\n" + _table(head, lines)
    )


def _bins(singles: dict[str, list[Row]]) -> str:
    lines = []
    every = [(name, row) for name, rows in singles.items() for row in rows]
    for low, high, label in _BINS:
        own = [(n, r) for n, r in every if r["truth_z"][n] is not None and low <= r["truth_z"][n] < high]
        found = Counter(outcome(row, name) for name, row in own)
        hits = found["first"] + found["class"]
        lines.append([label, _share(hits, len(own)), *(str(found[w]) for w in ("later", "not named", "wrong"))])
    own = [(n, r) for n, r in every if r["truth_z"][n] is None]
    found = Counter(outcome(row, name) for name, row in own)
    counts = (str(found[w]) for w in ("later", "not named", "wrong"))
    lines.append(["no score", _share(found["first"] + found["class"], len(own)), *counts])
    return "## Detection by evidence\n\n" + _table(["z", "first or class", "later", "not named", "wrong"], lines)


def _confusion(singles: dict[str, list[Row]]) -> str:
    lines = []
    for name, rows in singles.items():
        first = Counter(row["causes"][0]["name"] if row["causes"] else row["verdict"] for row in rows)
        extra = Counter(cause["name"] for row in rows for cause in row["causes"][1:] if cause["name"] != name)
        lines.append([name, _counts(first), _counts(extra) or "-"])
    return "## Confusion\n\n" + _table(["hidden", "first cause", "further causes that are not hidden"], lines)


def _counts(counter: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counter.most_common())


def _columns(singles: dict[str, list[Row]]) -> str:
    """How often a column that was recorded, and did nothing, is blamed."""
    lines = []
    for column, blamed in (
        ("temperature_C", {("thermal_drift", "temperature"), ("thermal_gain", "temperature")}),
        ("other_um", {("cross_coupling", ""), ("cross_coupling", "quadratic")}),
    ):
        guilty = {name for name, _ in blamed}
        own = [
            row for name, rows in singles.items() if name not in guilty for row in rows if column in row["columns"]
        ]
        accused = sum(any((cause["name"], cause["form"]) in blamed for cause in row["causes"]) for row in own)
        lines.append([column, _share(accused, len(own))])
    return "## Innocent columns\n\n" + _table(["column", "blamed"], lines)


def _none(rows: list[Row], asked: float) -> str:
    alarms = [row for row in rows if row["causes"]]
    named = _counts(Counter(cause["name"] for row in alarms for cause in row["causes"]))
    verdicts = _counts(Counter(row["verdict"] for row in rows))
    ratio = _middle([row["found_noise_um"] / row["noise_um"] for row in rows], ".3f")
    seeds = ", ".join(str(row["seed"]) for row in alarms)
    return (
        f"## No effect\n\nA cause was named on {_share(len(alarms), len(rows))} of rigs without one, where "
        f"{asked:g} is asked for. Verdicts: {verdicts}. Noise found over that of the sensor, median: {ratio}."
        + (f" Named: {named}; seeds {seeds}." if alarms else "")
    )


def _outside(outside: dict[str, list[Row]]) -> str:
    lines = []
    for name, rows in outside.items():
        verdicts = Counter(row["verdict"] for row in rows)
        first = Counter(row["causes"][0]["name"] for row in rows if row["causes"])
        counts = (str(verdicts[word]) for word in ("unexplained", "effect_found", "no_effect"))
        after = _middle([row["heldout_um"][1] / row["noise_um"] for row in rows], ".2f")
        lines.append([name, *counts, _counts(first) or "-", after])
    head = ["hidden", "unexplained", "effect found", "no effect", "first cause", "held out after / noise"]
    return "## Effects outside the library\n\n" + _table(head, lines)


def _pairs(pairs: dict[str, list[Row]]) -> str:
    from data_synth import EFFECTS

    lines = []
    for pair, rows in pairs.items():
        # What is outside the library has no name to be found by.
        names = [name for name in pair.split("+") if name in EFFECTS]
        hits = [sum(outcome(row, name) in ("first", "class", "later") for name in names) for row in rows]
        wrong = [sum(not {cause["name"], *cause["also"]} & set(names) for cause in row["causes"]) for row in rows]
        after = _middle([row["heldout_um"][1] / row["noise_um"] for row in rows], ".2f")
        every, nothing = hits.count(len(names)), hits.count(0)
        counts = (str(count) for count in (every, len(rows) - every - nothing, nothing))
        lines.append([pair.replace("+", " + "), *counts, str(sum(map(bool, wrong))), str(len(rows)), after])
    head = ["hidden", "all named", "one of two", "none", "with another name too", "rigs", "held out after / noise"]
    return "## Two at once\n\n" + _table(head, lines)


def _again(rows: list[Row]) -> str:
    lines, resolved = [], 0
    for row in rows:
        again = row.get("again")
        line = [row["hidden"], str(row["seed"]), " or ".join([row["causes"][0]["name"], *row["causes"][0]["also"]])]
        if again is None:
            lines.append([*line, "-", "no experiment", "no"])
            continue
        resolved += again["resolved"]
        after = " or ".join([again["first"] or "nothing", *again["also"]])
        lines.append([*line, f"{again['predicted_z']:.1f}", after, "yes" if again["resolved"] else "no"])
    text = "## The suggested experiment, played on the same rig\n\nResolved: " + _share(resolved, len(rows))
    return text + "\n\n" + _table(["hidden", "seed", "before", "sd apart, predicted", "after", "resolved"], lines)


def _heldout(done: list[Row]) -> str:
    """Every rig whose held-out runs were predicted worse with the causes than without."""
    asked = [row for row in done if row["causes"] and math.isfinite(row.get("heldout_sd_um") or math.nan)]
    if not asked:
        return ""
    worse = [row for row in asked if predicts_worse(row)]
    text = (
        f"## Held-out runs\n\nPredicted worse with the causes than without, by more than {_WORSE:g} standard "
        f"deviations: {_share(len(worse), len(asked))} of rigs with a cause."
    )
    lines = []
    for row in worse:
        named = ", ".join(cause["name"] for cause in row["causes"])
        ratios = (f"{value_um / row['noise_um']:.3f}" for value_um in (*row["heldout_um"], row["heldout_sd_um"]))
        lines.append([row["hidden"], str(row["seed"]), named, *ratios])
    head = ["hidden", "seed", "causes", "before / noise", "after / noise", "sd of the difference / noise"]
    return text + ("\n\n" + _table(head, lines) if lines else "")


def _undone(rows: list[Row]) -> str:
    if not rows:
        return ""
    lines = [[row["hidden"], str(row["seed"]), row.get("refused") or row.get("failed", "")] for row in rows]
    return "## Not diagnosed\n\n" + _table(["hidden", "seed", "why"], lines)
