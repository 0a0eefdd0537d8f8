"""Evidence of scores, against SciPy's distributions and non-negative least squares."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad
from scipy.optimize import nnls

from fits.diagnosis._score import Family, Probe, Scored, Scores
from fits.stats._score_test import evidence, standard_deviations


def test_what_cannot_be_negative_is_no_evidence_where_it_would_have_to_be(rng):
    for k in (1, 2, 3):
        columns = rng.standard_normal((200, k)) + 0.3 * rng.standard_normal((200, 1))
        residual = rng.standard_normal(200) + columns @ rng.normal(0, 0.2, k)
        expected, left = nnls(columns, residual)
        z, multiples, drop = evidence(columns, residual, True)
        assert multiples == pytest.approx(expected, abs=1e-6)
        assert drop == pytest.approx(residual @ residual - left**2, abs=1e-6)
        chance = stats.chi2.sf(drop, np.sum(expected > 0)) if np.any(expected) else 1.0
        assert 2 * stats.norm.sf(z) == pytest.approx(chance, rel=1e-6)
        assert evidence(columns, -columns @ np.ones(k), True)[0] == 0
        assert evidence(1e-3 * columns, residual, True, 0.1)[0] < 0.5


def test_standard_deviations_are_those_of_a_normal_variable_of_the_same_chance():
    for freedom in (1, 2, 6, 13):
        drop = np.array([0.1, 4.0, 36.0, 400.0])
        z = standard_deviations(drop, freedom)
        assert 2 * stats.norm.sf(z) == pytest.approx(stats.chi2.sf(drop, freedom), rel=1e-9)
        # Where that probability is no number any more, the density of chi-square says how fast it falls.
        for far in (1500.0, 1e5):
            tail, _ = quad(lambda t, k=freedom, x=far: (1 + t / x) ** (k / 2 - 1) * np.exp(-t / 2), 0, 200)
            log_p = np.log(tail * stats.chi2(freedom).pdf(900.0)) - (far - 900) / 2
            log_p += (freedom / 2 - 1) * np.log(far / 900)
            found = standard_deviations(far, freedom)
            assert np.log(2) + stats.norm.logsf(found) == pytest.approx(log_p, abs=0.02)
    assert standard_deviations(5.0, 0) == 0


def test_what_has_many_coefficients_is_found_by_chance_no_more_often(rng):
    # Frequencies of many lines in many runs, beside sixty effects of one strength each.
    sizes = [60] * 5 + [1] * 60
    each = tuple(
        Scored(
            Probe((SimpleNamespace(name="", finite=False),), ((np.zeros(1),),) * k, False),
            1.0,
            0.0,
            0.0,
            np.zeros(k),
            0.0,
            1.0,
        )
        for k in sizes
    )
    family = Family(Scores(each, np.eye(sum(sizes))), rng)
    # Decreases that nothing but chance makes, each as evidence.
    drops = rng.chisquare(np.asarray(sizes)[:, None], (len(sizes), 20_000))
    largest = np.max(standard_deviations(drops, np.asarray(sizes)[:, None]), axis=0)
    for chance in (0.05, 1e-3):
        # The family is a table of 2000 draws, and what lies beyond goes on from the largest twenty.
        assert np.mean([family.p(z) < chance for z in largest]) == pytest.approx(chance, rel=1.2)
