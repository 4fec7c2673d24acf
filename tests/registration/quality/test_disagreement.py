"""Disagreeing observations that are scattered, move by one step, or gather in images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.registration.generated import CaseSettings, generate_case
from chronoscene.registration.quality.certificate import HeldOut, certify
from chronoscene.registration.quality.disagreement import _images, _step
from chronoscene.registration.quality.verdict import judge


def test_gaps_of_one_step_are_told_from_scattered_ones() -> None:
    rng = np.random.default_rng(0)
    spread = np.broadcast_to(0.01**2 * np.eye(3), (30, 3, 3))
    scattered = rng.normal(0, 1.0, (30, 3))
    assert _step(scattered, spread) == 0
    together = scattered.copy()
    together[:16] = rng.normal([0.5, 0.2, 0.0], 0.01, (16, 3))
    assert _step(together, spread) == pytest.approx(15 / 29, abs=0.07)
    assert _step(together[:3], spread[:3]) == 0  # too few to tell


def test_observations_gather_where_an_image_has_many_more_than_usual() -> None:
    image = np.repeat(np.arange(10), 20)
    rng = np.random.default_rng(0)
    scattered = rng.random(200) < 0.2
    assert _images(image, scattered) == 0
    wrong = scattered | (image == 3)
    assert _images(image, wrong) == pytest.approx(20 / wrong.sum())
    assert _images(image, np.zeros(200, bool)) == 0


@pytest.mark.parametrize("case", ["outliers", "repeated"])
def test_scattered_false_ties_do_no_harm_and_steps_need_surfaces(case: str) -> None:
    settings = CaseSettings(ties=500, points=2000, seed=7, gps_noise=None, **{case: 0.35})
    certificate = certify(generate_case(settings).model)
    (pair,) = certificate.pairs
    assert isinstance(pair.held_out, HeldOut)
    assert pair.held_out.agreeing < 0.75
    assert (pair.held_out.disagreement.step > 0.5) == (case == "repeated")
    assert judge(certificate).level == "pass"
    blind = replace(pair, by_surfaces=None, independent=None, by_ties_and_surfaces=None)
    verdict = judge(replace(certificate, pairs=(blind,)))
    assert any(o.check == "together" for o in verdict.objections) == (case == "repeated")
