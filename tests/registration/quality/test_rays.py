"""Evidence: gathered once, equal to what each figure would gather for itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.registration.generated import CaseSettings, generate_case
from chronoscene.registration.output import inspect_registration
from chronoscene.registration.quality import rays
from chronoscene.registration.quality.rays import TrackRays, model_rays, place


def test_every_point_is_placed_once_in_each_period(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = generate_case(CaseSettings(periods=3, seed=5)).model
    placed, unprojected = [], []

    def counted(of: TrackRays) -> rays.PlacedPoints:
        placed.append(len(of))
        return place(of)

    def counted_pixels(*arguments: object) -> object:
        unprojected.append(1)
        return before(*arguments)  # type: ignore[arg-type]

    before = rays.unproject
    monkeypatch.setattr(rays, "place", counted)
    monkeypatch.setattr(rays, "unproject", counted_pixels)
    inspect_registration(model, tmp_path)
    assert len(placed) == 2 * 3  # points of the model and held-out tracks, by each period
    assert len(unprojected) == 2  # observations and held-out tracks


def test_samples_hold_whole_tracks(monkeypatch: pytest.MonkeyPatch) -> None:
    model = generate_case(CaseSettings(seed=6)).model
    every = model_rays(model)
    monkeypatch.setattr(rays, "MAX_OBSERVATIONS", 1000)
    found = rays.gather(model)
    for period in range(2):
        alone = place(every.where(model.periods[every.image] == period))
        known, slot = alone.find(found.clouds[period].track)
        assert known.all() and 0 < len(known) < len(alone.track)
        np.testing.assert_array_equal(found.clouds[period].xyz, alone.xyz[slot])
    tied = np.unique(found.ties.track)
    assert len(tied) > 0 and found.seen[tied].all()
    assert len(found.ties) == np.isin(every.track, tied).sum()
