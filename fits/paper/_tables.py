"""The paper's tables of compensation, and ours beside them: figures, JSON values and a page."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

SCHEMA = "microid.paper/1"
STEP_UNITS = {
    "settling_time_s": "settling time (s)",
    "overshoot_pct": "overshoot (%)",
    "settling_value_um": "settling value (um)",
    "positioning_error_pct": "positioning error (%)",
}
TRACK_UNITS = {"e_max_pct": "e_max (%)", "e_rms_pct": "e_rms (%)"}


def _rows(names: Iterable[str], rows: Mapping[str, Sequence[float]]) -> dict[str, dict[str, float]]:
    return {scheme: dict(zip(names, row, strict=True)) for scheme, row in rows.items()}


# Erratum 35: Z's open loop has an e_rms of 5.50 %, printed as 50.
PAPER: dict[str, Any] = {
    "table2": _rows(
        STEP_UNITS,
        {
            "HC": (0.84, 66.12, 6.429, 2.78),
            "HC+PID": (0.68, 0.0, 6.488, 1.89),
            "HC+BP-PID": (0.46, 0.0, 6.542, 1.07),
            "HC+CMAC-PID": (0.11, 1.39, 6.601, 0.18),
        },
    ),
    "table3": _rows(
        TRACK_UNITS,
        {
            "OPEN": (18.22, 6.70),
            "HC": (5.46, 2.61),
            "HC+PID": (2.91, 1.38),
            "HC+BP-PID": (1.07, 0.62),
            "HC+CMAC-PID": (0.63, 0.23),
        },
    ),
    "table4": {
        "z": _rows(TRACK_UNITS, {"OPEN": (11.62, 5.50), "HC": (6.79, 3.30), "HC+CMAC-PID": (1.77, 0.95)}),
        "alpha": _rows(TRACK_UNITS, {"OPEN": (30.77, 16.10), "HC": (22.16, 10.33), "HC+CMAC-PID": (6.97, 3.06)}),
        "gamma": _rows(TRACK_UNITS, {"OPEN": (54.17, 25.34), "HC": (31.53, 16.82), "HC+CMAC-PID": (19.02, 7.32)}),
    },
    "figures": _rows(
        ("loop_width_pct", "e_max_pct", "e_rms_pct"), {"fig6": (12.83, 1.43, 0.28), "fig9": (3.02, 1.84, 0.65)}
    ),
}
# What the bench was calibrated to: no result, and the rest is.
CALIBRATED = {("table2", "HC"), ("table3", "OPEN"), ("z", "OPEN"), ("alpha", "OPEN"), ("gamma", "OPEN")}
AXIS_TITLES = {"z": "Z", "alpha": "rotation about X, Y", "gamma": "rotation about Z"}


class Measured:
    """One figure of the true displacement by seed, `ours` of shape `(seeds,)`, which may not be finite.

    `paper` is what the paper prints, and `beside` the same of the readings, or for steps, of the true displacement
    where the sensor is noisy. It is `below_sensor` if the median stands for a distance that no single reading of the
    sensor shows (erratum 40). The spread is the largest less the smallest, the ratio that of the median to the
    paper's, and it is `worse` if the median, to the two digits that the paper prints, is above the paper's. What is
    not finite is None.
    """

    def __init__(self, paper: float, ours: np.ndarray, beside: np.ndarray | None = None, below_sensor: bool = False):
        self.paper, self.beside, self.below_sensor = paper, beside, below_sensor
        self.median = _finite(np.median(ours))
        self.median_beside = None if beside is None else _finite(np.median(beside))
        with np.errstate(invalid="ignore"):
            self.spread = _finite(np.ptp(ours))
        self.ratio = None if self.median is None or paper == 0 else self.median / paper
        self.worse = self.median is None or round(self.median, 2) > paper

    def json(self) -> dict[str, float | None]:
        return {"paper": self.paper, "ours": self.median, "spread": self.spread}


def _finite(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


@dataclass(eq=False)
class PaperResult:
    """All figures by table, then scheme (and axis, in Table 4), then name."""

    seed: int
    seeds: int
    table2: dict[str, dict[str, Measured]] = field(default_factory=dict)
    table3: dict[str, dict[str, Measured]] = field(default_factory=dict)
    table4: dict[str, dict[str, dict[str, Measured]]] = field(default_factory=dict)
    figures: dict[str, dict[str, Measured]] = field(default_factory=dict)
    assumed: Sequence[str] = ()

    def rows(self) -> list[tuple[str, str, str, Measured]]:
        """Place, scheme, name and figure of all rows of the tables."""
        return [
            (place, scheme, name, figure)
            for place, schemes in {"table2": self.table2, "table3": self.table3, **self.table4}.items()
            for scheme, figures in schemes.items()
            for name, figure in figures.items()
        ]

    def worse(self) -> list[str]:
        """Rows in which ours is worse than the paper's, calibrated ones and settling values apart."""
        return [
            f"{_PLACES[place]}, {scheme}: {name}"
            for place, scheme, name, figure in self.rows()
            if (place, scheme) not in CALIBRATED and name != "settling_value_um" and figure.worse
        ]


_PLACES = {"table2": "Table 2", "table3": "Table 3", **{axis: f"Table 4, {axis}" for axis in AXIS_TITLES}}


def paper_json(result: PaperResult) -> dict[str, Any]:
    """Put a result into JSON values, `microid.paper/1`."""

    def table(schemes: Mapping[str, Mapping[str, Measured]]) -> dict[str, Any]:
        return {
            scheme: {name: f.json() | {"below_sensor": f.below_sensor} for name, f in figures.items()}
            for scheme, figures in schemes.items()
        }

    return {
        "schema": SCHEMA,
        "seed": result.seed,
        "seeds": result.seeds,
        "table2": table(result.table2),
        "table3": table(result.table3),
        "table4": {axis: table(schemes) for axis, schemes in result.table4.items()},
        # Of the fits of whole records, which the sensor's noise does not bound.
        "figures": {
            place: {name: f.json() for name, f in figures.items()} for place, figures in result.figures.items()
        },
        "beside": [
            {"where": _PLACES[place], "scheme": scheme, "figure": name, "ours": f.median_beside}
            for place, scheme, name, f in result.rows()
            if f.beside is not None
        ],
        "worse_than_paper": result.worse(),
        "assumed": list(result.assumed),
    }


def paper_page(result: PaperResult, pictures: Sequence[tuple[str, str]]) -> str:
    """Put a result, and pictures by caption and file name, into a Markdown page."""
    names = STEP_UNITS | TRACK_UNITS | {"loop_width_pct": "width of the loop (%)"}
    return render("page.md.j2", result=result, pictures=pictures, names=names, axis_titles=AXIS_TITLES)


def render(template: str, **values: Any) -> str:
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(
        loader=loader, undefined=jinja2.StrictUndefined, trim_blocks=True, keep_trailing_newline=True
    )
    environment.filters |= {"number": _number, "verdict": _verdict}
    return environment.get_template(template).render(values)


def _verdict(figure: Measured, place: str, scheme: str, name: str) -> str:
    if (place, scheme) in CALIBRATED:
        return "calibrated"
    if name == "settling_value_um":
        return ""
    return "worse" if figure.worse else "no worse"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}" if abs(value) >= 1e-3 or value == 0 else "<0.001"
