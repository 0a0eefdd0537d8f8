import html.parser
import json
import re
from dataclasses import fields, replace
from html import unescape

import jax.numpy as jnp
import numpy as np
import pytest
from _diagnosis import KINDS, cause, diagnosis, run_view

from fits import ParameterEstimate
from fits.diagnosis._findings import _given
from fits.diagnosis._result import Gain, RunView, law_in_words
from fits.plots._diagnosis import residual_figure
from fits.plots._residual_views import VIEWS
from fits.plots._style import thinned
from fits.report._diagnosis import report_html
from fits.report._diagnosis_json import diagnosis_json, diagnosis_schema
from fits.report._words import chance, estimate, heading, number, parameter_name, percent, plain, shown_unit, sigmas
from microid import Mechanics
from microid.effects import EFFECTS, card_of

VOID = {"meta", "link", "br", "img", "hr", "input"}


def violations(value, schema, where="$"):
    """What a JSON Schema of the few words that ours has finds wrong with a value."""
    known = {"$schema", "title", "description", "type", "properties", "required", "additionalProperties"}
    assert set(schema) <= known | {"items", "enum", "const", "minimum", "maximum", "minLength"}, where
    kinds = {
        "object": dict,
        "array": list,
        "string": str,
        "number": (int, float),
        "integer": int,
        "null": type(None),
    }
    wanted = schema.get("type", list(kinds))
    wanted = wanted if isinstance(wanted, list) else [wanted]
    if isinstance(value, bool) or not isinstance(value, tuple(np.hstack([kinds[name] for name in wanted]))):
        return [f"{where}: not {wanted}"]
    wrong = []
    if value not in schema.get("enum", [value]) or value != schema.get("const", value):
        wrong.append(f"{where}: another value")
    if isinstance(value, int | float) and not schema.get("minimum", value) <= value <= schema.get("maximum", value):
        wrong.append(f"{where}: out of bounds")
    if isinstance(value, str) and len(value) < schema.get("minLength", 0):
        wrong.append(f"{where}: too short")
    if isinstance(value, list):
        for place, item in enumerate(value):
            wrong += violations(item, schema.get("items", {}), f"{where}[{place}]")
    if isinstance(value, dict):
        wrong += [f"{where}: lacks {name}" for name in schema.get("required", ()) if name not in value]
        for name, item in value.items():
            inner = schema.get("properties", {}).get(name, schema.get("additionalProperties", {}))
            wrong += (
                [f"{where}: {name} is too much"] if inner is False else violations(item, inner, f"{where}.{name}")
            )
    return wrong


@pytest.mark.parametrize("kind", KINDS)
def test_json_is_strict_and_keeps_to_its_schema(rng, kind):
    content, schema = diagnosis_json(diagnosis(rng, kind)), diagnosis_schema()
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    assert violations(content, schema) == []
    for broken in (
        {"schema": "microid.diagnosis/2"},
        {"verdict": "maybe"},
        {"noise_um": -1.0},
        {"noise_um": "0.1"},
        {"causes": [{"name": "creep"}]},
        {"remarks": [1]},
        {"further": 1},
    ):
        assert violations(content | broken, schema), broken
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.Draft202012Validator(schema).validate(content)


@pytest.mark.parametrize("kind", KINDS)
def test_the_summary_tells_parameters_with_units_and_is_what_a_notebook_shows(rng, kind):
    found = diagnosis(rng, kind)
    text = found.summary()
    assert text.splitlines()[0].startswith(("no effect found", "effect found", "unexplained error"))
    for one in found.causes:
        assert re.search(rf"{one.name}.*: 24.3 standard deviations, by chance below 1e-09$", text, re.MULTILINE)
        assert re.search(r"gain_per_decade +0\.01542 \+- 0\.00031$", text, re.MULTILINE)
        assert re.search(r"onset_s +0\.1 \(95 %: nan to inf\) s$", text, re.MULTILINE)
    assert repr(found) == text
    assert "<script" not in found._repr_html_()
    assert unescape(found._repr_html_()) == f"<pre>{text}</pre>"


def test_json_says_what_the_diagnosis_says(rng):
    content = diagnosis_json(diagnosis(rng))
    assert content["causes"][0]["parameters"] == {
        "gain_per_decade": {"value": 0.01542, "sd": 0.00031, "unit": "1", "lower": 0.0148, "upper": 0.016},
        "onset_s": {"value": 0.1, "sd": None, "unit": "s", "lower": None, "upper": None},
    }
    assert content["baseline_parameters"]["mechanics.natural_frequency_Hz"]["sd"] == 0.21
    assert (
        content["extended_parameters"]["creep.gain_per_decade"]
        == content["causes"][0]["parameters"]["gain_per_decade"]
    )
    assert content["causes"][0]["also_consistent"] == ["thermal_drift"]
    assert content["upper_bounds"][1]["bound_um"] is None
    assert content["gain"]["heldout_rms_after_um"] == 0.0123
    assert content["gain"]["heldout_max_after_um"] is None
    assert content["next_experiment"]["highest_V"] == 100.0
    assert diagnosis_json(diagnosis(rng, "no_effect"))["next_experiment"] is None


class Page(html.parser.HTMLParser):
    """Tags that must be balanced, identifiers, links and text of a page."""

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.links, self.text = [], [], [], ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.ids += [value for name, value in attrs if name == "id"]
        self.links += [value for name, value in attrs if name in ("src", "href", "xlink:href", "srcset", "action")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.text += data


@pytest.mark.parametrize("kind", KINDS)
def test_report_is_one_whole_page(rng, kind):
    found = diagnosis(rng, kind)
    text = report_html(found)
    page = Page(text)
    words = " ".join(page.text.split())
    for each in found.causes:
        assert each.fingerprint in words
        assert each.name.replace("_", " ") in words.lower()
    for shown in (*found.remarks, *(view.source for view in found.runs), "Friction", found.upper_bounds[1].reason):
        assert shown in words
    if found.causes:
        assert "0.01542" in words
        # The stage before and after, down to the second digit of its standard deviation.
        assert "(Hz)149.80149.39 to 150.21150.020149.950 to 150.090" in words
        assert "47.1 nm" in words
        assert found.next_experiment.purpose in words
    else:
        assert "frequency (Hz)149.80149.39 to 150.21" in words
    assert "<b>" not in text
    for link in page.links:
        assert link.startswith(("#", "data:"))
    assert not re.search(r"@import|url\((?!#)|<script[^>]|fetch\(|import\(", text)
    linked = {link[1:] for link in page.links if link.startswith("#")}
    assert linked <= set(page.ids)
    if kind == "effect_found":
        # Every word that is explained is linked to from where it stands.
        assert set(re.findall(r'<dt id="(\w+)">', text)) <= linked
    assert "nan" not in re.sub(r"[a-z]{4,}", "", words.lower()).split()
    assert len(set(page.ids)) == len(page.ids)


def test_the_stage_stands_right_behind_what_was_read_and_names_are_written_as_people_write_them(rng):
    found = diagnosis(rng)
    found = replace(found, causes=(replace(found.causes[0], name="bouc_wen_hysteresis"),))
    text = report_html(found)
    heads = re.findall("<h2>(.*?)</h2>", text)
    assert heads[1:3] == ["What was read", "The stage, before and after"]
    assert "<h3>Bouc-Wen hysteresis</h3>" in text
    assert "The stage shows Bouc-Wen hysteresis or thermal drift." in text
    assert "bouc wen" not in text.lower()
    assert "displacement_um is 0 at rest at the lowest voltage" in text
    assert (plain("mains_hum"), heading("mains_hum")) == ("mains hum", "Mains hum")


def test_the_band_of_the_noise_lies_over_the_curves_and_lets_them_through(rng):
    (axes, *_) = residual_figure(diagnosis(rng)).axes
    (band,) = [patch for patch in axes.patches if patch.get_alpha() is not None]
    assert 0 < band.get_alpha() < 0.3
    assert band.get_zorder() > max(line.get_zorder() for line in axes.lines if len(line.get_xdata()) > 2)


def test_the_same_diagnosis_gives_the_same_report(rng):
    found = diagnosis(rng, "no_effect", count=1)
    assert report_html(found) == report_html(found)


def test_report_of_long_runs_is_small(rng):
    text = report_html(diagnosis(rng, n=100_000, count=8))
    assert len(text.encode()) < 1_500_000
    assert "2 more are not" in text


def test_report_does_without_runs_and_numbers(rng):
    bare = replace(diagnosis(rng), runs=(), noise_um=np.nan, upper_bounds=(), tests=(), remarks=(), gain=Gain())
    assert "not known" in Page(report_html(bare)).text
    short = tuple(replace(run_view(rng, "short", 5), before_um=np.full(5, np.nan)) for _ in range(2))
    Page(report_html(replace(bare, runs=short)))


def test_an_envelope_keeps_every_spike(rng):
    values = rng.standard_normal(100_000)
    # No two within what becomes one point.
    spikes = 500 * rng.choice(200, 20, replace=False) + rng.integers(400, size=20)
    values[spikes] += 50
    kept = thinned(values, 2000)
    assert len(kept) <= 2002
    assert set(np.sort(spikes)[[0, -1]]) <= set(kept)
    assert np.isin(np.argmax(values), kept)
    assert np.all(np.diff(kept) > 0)


def test_the_view_of_creep_shows_its_logarithm():
    hold = 0.01 * np.arange(1000)
    heights = [10.0, 20.0, 5.0, 60.0, 30.0]
    voltage = np.repeat(heights, hold.size)
    signs = np.sign(np.diff(heights, prepend=10.0))
    residual = np.concatenate([0.3 + sign * np.log10(1 + hold / 0.1) for sign in signs])
    one = RunView("", 0.01 * np.arange(voltage.size), voltage, voltage, residual, 0 * residual, residual < 9)
    look = VIEWS[card_of("creep").view].look
    (before,), (after,) = look([one], lambda run: run.before_um), look([one], lambda run: run.after_um)
    expected = np.log10(1 + before.x / 0.1)
    np.testing.assert_allclose(before.y - before.y.mean(), expected - expected.mean(), atol=0.03)
    assert np.ptp(before.y) > 1.5
    np.testing.assert_array_equal(after.y, 0.0)


def test_the_view_of_hum_shows_its_line(rng):
    time_s = 0.001 * np.arange(8192)
    hum = np.sin(2 * np.pi * 50 * time_s) + 0.1 * rng.standard_normal(time_s.size)
    one = RunView("", time_s, time_s, time_s, hum, 0 * hum, hum < 9)
    (before,) = VIEWS[card_of("mains_hum").view].look([one], lambda run: run.before_um)
    assert before.x[np.argmax(before.y)] == pytest.approx(50, rel=0.02)


def test_numbers_have_sensible_digits():
    shown = [number(x) for x in (0.0, 1234.5, 12.345, 0.09996, -0.000123, 2.5e-7, np.nan, 999.96)]
    assert shown == ["0", "1234", "12.3", "0.100", "−0.000123", "2.50 × 10⁻⁷", "–", "1000"]  # noqa: RUF001
    # However exactly a small number is known, its interval has two ends.
    assert estimate(ParameterEstimate("a", "s", 1.668e-3, 7e-8, 1.66786e-3, 1.66814e-3)) == (
        "0.001668000",
        "7.0 × 10⁻⁸",  # noqa: RUF001
        "0.001667860 to 0.001668140",
    )
    assert estimate(ParameterEstimate("a", "1", 12.3456, 0.0234, 12.29, 12.41)) == (
        "12.346",
        "0.023",
        "12.290 to 12.410",
    )
    assert [percent(x) for x in (0.0, 0.004, 0.5, 0.999, 1.0)] == ["0 %", "< 1 %", "50 %", "> 99 %", "100 %"]
    assert (chance(1e-12), chance(0.0123)) == ("below 10⁻⁹", "0.012")
    assert [sigmas(z) for z in (0.04, -2.71, 24.31, 12345.0)] == ["0.0", "−2.7", "24.3", "12345"]  # noqa: RUF001
    named = [
        parameter_name(ParameterEstimate(n, u, 1, 1, 1, 1)) for n, u in (("onset_s", "s"), ("a_um_per_s", "um/s"))
    ]
    assert named == ["onset (s)", "a (µm/s)"]
    assert [shown_unit(u) for u in ("1", "um", "um/K", "1/K", "um/V^2")] == ["", "µm", "µm/K", "1/K", "µm/V²"]


@pytest.mark.parametrize(("form", "mains_Hz"), [("50_Hz", 50), ("60_Hz", 60)])
def test_a_hum_is_told_by_the_amplitudes_of_its_lines(rng, form, mains_Hz):
    """Against amplitudes of many draws of its cosines and sines, which only JSON has."""
    values, sd = rng.normal(0, 0.1, (2, 2, 3)), rng.uniform(1e-4, 2e-3, (2, 2, 3))
    parameters = [
        ParameterEstimate(f"{field}[{h}] in run {run + 1}", "um", values[run, k, h], sd[run, k, h], -1.0, 1.0)
        for run in range(2)
        for k, field in enumerate(("cosine_um", "sine_um"))
        for h in range(3)
    ]
    frequency = ParameterEstimate("frequency_Hz", "Hz", mains_Hz + 0.01, 0.001, 49.0, 61.0)
    found = diagnosis(rng)
    hum = replace(found.causes[0], name="mains_hum", form=form, parameters=(*parameters, frequency))
    found = replace(found, causes=(hum,))
    assert [one.name for one in hum.shown] == [
        *(f"amplitude at {h * mains_Hz} Hz in run {run}" for run in (1, 2) for h in (1, 2, 3)),
        "frequency_Hz",
    ]
    drawn = np.hypot(*np.moveaxis(values + sd * rng.standard_normal((20_000, 2, 2, 3)), 2, 0))
    np.testing.assert_allclose([one.value for one in hum.shown[:-1]], drawn.mean(0).ravel(), rtol=0.05)
    # Where the line is seen; below its noise an amplitude is no Gaussian.
    for one, spread_um, size_um in zip(hum.shown, drawn.std(0).ravel(), drawn.mean(0).ravel(), strict=False):
        assert one.sd == pytest.approx(spread_um, rel=0.1) or size_um < 5 * spread_um
    for text in (found.summary(), report_html(found)):
        # But in the law, which is there to be unfolded.
        assert "cosine" not in re.sub(r'<pre class="law">.*?</pre>', "", text, flags=re.DOTALL)
        assert f"amplitude at {mains_Hz}" in text.replace("\N{NO-BREAK SPACE}", " ")
    assert "cosine_um[0] in run 1" in diagnosis_json(found)["causes"][0]["parameters"]


@pytest.mark.parametrize("form", [form for form in EFFECTS if not form.statistic], ids=lambda form: form.__name__)
def test_the_law_of_an_effect_says_what_each_parameter_is(form):
    law = law_in_words(form)
    for one in fields(form):
        if one.name != "inner":
            assert re.search(rf"\b{one.name}\b", law), one.name
    assert "inner" not in law.split()
    assert not {"`", "math::", "----"} & set(re.findall(r"`|math::|----", law))


def test_constants_that_are_not_fitted_are_shown_with_the_parameters(rng, tmp_path):
    known = replace(cause("creep"), given={"half_stroke_um": 17.25})
    found = replace(diagnosis(rng), causes=(known,))
    assert re.search(r"half_stroke_um +17\.25, given", found.summary())
    hardening = next(form for form in EFFECTS if form.name == "stiffness_hardening")
    effect = hardening(Mechanics(100.0, 0.1, 1.0), *map(jnp.asarray, (0.01, 3.0, 17.25)))
    assert _given(effect) == {"half_stroke_um": 17.25}
