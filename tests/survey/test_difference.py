"""Differences, their uncertainty, and volumes, against known truth and Monte Carlo."""

import json

import numpy as np
import pytest

from chronoscene.errors import SceneError
from chronoscene.survey.difference import Difference, Volumes, measure_volumes, subtract
from chronoscene.survey.grid import Grid
from chronoscene.survey.surface import Surface
from chronoscene.survey.uncertainty import (
    Registration,
    StableGround,
    find_registration,
    stable_ground,
    variance_of_mean,
)

GRID = Grid(0.0, 40.0, 0.5, 80, 80, -5.0, 5.0)
WHOLE = np.ones(GRID.shape, bool)


def correlated(length, count, size=80, seed=0):
    """Fields of variance 1 with a spherical variogram of this range, in cells. [count, n, n]"""
    n = 2 * size
    steps = np.minimum(np.arange(n), n - np.arange(n))
    near = np.minimum(np.hypot(steps[:, None], steps) / length, 1)
    power = np.fft.fft2(1 - 1.5 * near + 0.5 * near**3).real.clip(0)
    noise = np.fft.fft2(np.random.default_rng(seed).normal(size=(count, n, n)))
    return np.fft.ifft2(np.sqrt(power) * noise).real[:, :size, :size]


@pytest.mark.parametrize("length", [3.0, 10.0])
def test_the_variance_of_a_mean_against_monte_carlo(length):
    means = correlated(length, 300, size=48).mean(axis=(1, 2))
    wanted = np.sqrt(variance_of_mean(48 * 48, length, 48 * 48))
    assert means.std() == pytest.approx(wanted, rel=0.15)


def test_the_variance_of_a_mean_at_its_ends():
    assert variance_of_mean(1e-6, 10.0, 1) == 1
    assert variance_of_mean(1e6, 0.1, 400) == 1 / 400
    area = np.pi * 10.0**2
    assert variance_of_mean(area * 0.999999, 10.0, 10**9) == pytest.approx(0.2, rel=1e-4)
    assert variance_of_mean(area * 1.000001, 10.0, 10**9) == pytest.approx(0.2, rel=1e-4)


@pytest.mark.parametrize("length", [4.0, 12.0])
def test_stable_ground_is_found_beside_changes(length):
    noise = correlated(length, 1, size=160)[0]
    differences = 0.1 * noise + 0.03
    differences[:60, :60] += 4.0
    differences[100:, 100:] = np.nan
    found = stable_ground(differences, np.full(noise.shape, 0.2), 0.5)
    assert found.median == pytest.approx(0.03, abs=0.03)
    assert found.nmad == pytest.approx(0.1, rel=0.15)
    assert found.factor == pytest.approx(0.6, rel=0.2)  # changes of 14 % widen it a little
    assert found.length == pytest.approx(0.5 * length, rel=0.35)
    assert found.cells == pytest.approx(160 * 160 - 60 * 60 - 60 * 60, rel=0.01)


def test_nothing_known():
    nothing = np.full((4, 4), np.nan)
    assert stable_ground(nothing, nothing, 0.5) == StableGround(0, 0.0, 0.0, 5.0, 1.0)


def surface(heights, spread):
    nothing = np.zeros((*heights.shape, 3), np.uint8)
    return Surface(heights, nothing, np.full(heights.shape, spread), WHOLE.astype(np.int64))


def test_level_of_detection_and_volumes(scene):
    rng = np.random.default_rng(1)
    first = rng.normal(0, 0.05, GRID.shape)
    second = rng.normal(0, 0.05, GRID.shape)
    second[10:20, 10:30] += 3.0
    second[40:44, 50:60] -= 2.0
    second[70:, :] = np.nan
    found = subtract(scene, GRID, {0: surface(first, 0.05), 1: surface(second, 0.05)}, (0, 1))
    assert found.stable.factor == pytest.approx(1.067, abs=0.03)  # 4.3 % have changed
    assert found.registration.sigma < 0.01
    np.testing.assert_allclose(found.level[~np.isnan(second)], 1.96 * 0.0707 * 1.067, rtol=0.05)
    volumes = measure_volumes(found, GRID, "all", WHOLE)
    assert volumes.fill_m3 == pytest.approx(200 * 0.25 * 3, rel=0.15)  # with 5 % false alarms
    assert volumes.cut_m3 == pytest.approx(40 * 0.25 * 2, rel=0.5)
    assert abs(volumes.net_m3 - 130) < volumes.net_interval_m3 < 30
    assert volumes.area_m2 == 70 * 80 * 0.25 and volumes.known_share == 70 / 80
    assert measure_volumes(found, GRID, "cut", WHOLE, 0.5).known_share == 0.5 * 70 / 80
    inside = np.zeros(GRID.shape, bool)
    inside[10:20, 10:30] = True
    box = measure_volumes(found, GRID, "box", inside)
    assert box.net_m3 == box.fill_m3 == pytest.approx(150, rel=0.01) and str(box.cut_m3) == "0.0"
    unknown = measure_volumes(found, GRID, "unknown", np.isnan(second))
    assert unknown == Volumes("unknown", 0.0, 0.0, None, None, None, None, None, None)


def test_intervals_of_volumes_against_monte_carlo():
    stable = StableGround(6400, 0.0, 0.1, 0.5 * 8, 1.0)
    fields, rng = correlated(8.0, 200), np.random.default_rng(5)
    inside, covered = np.zeros(GRID.shape, bool), 0
    inside[20:60, 20:60] = True
    for field in fields:
        values = 1.0 + 0.1 * field + rng.normal(0, 0.02)
        found = Difference(
            (0, 1), values, np.full(GRID.shape, 0.01), stable, Registration(0.02, "made up")
        )
        made = measure_volumes(found, GRID, "", inside)
        covered += abs(made.net_m3 - 400) <= made.net_interval_m3
    assert 0.9 <= covered / 200 <= 0.99


def certificate(labels=("before", "after"), unit="m", name="displacement by held-out tracks"):
    figure = {"name": name, "unit": unit, "value": 0.02, "interval": [0.0, 0.0392]}
    periods = [{"period": i + 3, "label": label} for i, label in enumerate(labels)]
    return {"periods": periods, "pairs": [{"periods": [3, 4], "figures": [figure]}]}


STABLE = StableGround(1000, 0.03, 0.1, 1.0, 1.0)


def test_the_certificate_says_how_well_periods_are_aligned(scene):
    path = scene.root / "registration.json"
    path.write_text(json.dumps(certificate()))
    found = find_registration(scene, (0, 1), STABLE, 250.0)
    assert found.sigma == pytest.approx(0.02) and "registration.json" in found.source


@pytest.mark.parametrize("made", [certificate(labels=("x", "y")), certificate(unit="px"), None])
def test_without_a_certificate_stable_ground_does(scene, made):
    if made is not None:
        (scene.root / "registration.json").write_text(json.dumps(made))
    found = find_registration(scene, (0, 1), STABLE, 250.0)
    deviation = 0.1 * np.sqrt(variance_of_mean(250.0, 1.0, 1000))
    assert found.sigma == pytest.approx(np.hypot(0.03, deviation))
    assert found.source.startswith("stable ground")


def test_nothing_says_how_well_periods_are_aligned(scene):
    found = find_registration(scene, (0, 1), StableGround(0, 0.0, 0.0, 1.0, 1.0), 0.0)
    assert found.sigma == 0 and found.source.startswith("unknown")


@pytest.mark.parametrize("text", ['{"pairs": 3}', "{", '{"periods": [{}], "pairs": []}'])
def test_a_damaged_certificate(scene, text):
    (scene.root / "registration.json").write_text(text)
    with pytest.raises(SceneError, match=r"registration\.json"):
        find_registration(scene, (0, 1), STABLE, 250.0)
