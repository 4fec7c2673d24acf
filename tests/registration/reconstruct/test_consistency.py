"""Images whose matches contradict their poses."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.database import verified_matches
from chronoscene.registration.reconstruct.consistency import (
    MIN_MATCHES,
    agreement,
    deregister_misplaced,
    loose_parts,
    misplaced,
    pair_agreements,
    point_agreements,
)
from chronoscene.registration.reconstruct.gps_alignment import Priors
from chronoscene.registration.reconstruct.mapping import Task, triangulate
from chronoscene.registration.reconstruct.models import known_images, set_pose, set_poses
from chronoscene.registration.reconstruct.routes import rejoined
from chronoscene.scene.geometry import look_at
from chronoscene.scene.similarity import fit_robustly


def agreements(groups: list[int], false_edges: int, seed: int) -> dict[tuple[int, int], Any]:
    """Pairs agree within a group and not across, but for a few that led astray."""
    rng = np.random.default_rng(seed)
    group = np.repeat(np.arange(len(groups)), groups)
    found = {}
    for i in range(len(group)):
        for j in range(i + 1, len(group)):
            total = int(rng.integers(40, 200))
            share = rng.uniform(0.9, 1.0) if group[i] == group[j] else rng.uniform(0, 0.1)
            found[i, j] = (int(share * total), total)
    across = [pair for pair in found if group[pair[0]] != group[pair[1]]]
    for k in rng.permutation(len(across))[:false_edges]:
        found[across[k]] = (found[across[k]][1],) * 2
    return found


@given(st.integers(8, 25), st.integers(1, 5), st.integers(0, 2), st.integers(0, 10**6))
def test_a_group_that_agrees_with_itself_alone_is_found(
    right: int, wrong: int, false_edges: int, seed: int
) -> None:
    found = agreements([right, wrong], false_edges, seed)
    assert misplaced(found, range(right + wrong)) == list(range(right, right + wrong))


@given(st.integers(2, 30), st.integers(0, 10**6))
def test_where_all_agree_none_is_misplaced(count: int, seed: int) -> None:
    assert misplaced(agreements([count], 0, seed), range(count)) == []


@given(st.integers(6, 25), st.integers(3, 5), st.integers(0, 1), st.integers(0, 10**6))
def test_a_part_that_most_matches_contradict_is_loose(
    right: int, wrong: int, false_edges: int, seed: int
) -> None:
    found = agreements([right, wrong], false_edges, seed)
    part, every = set(range(right, right + wrong)), range(right + wrong)
    loose = set(loose_parts(found, every))
    assert loose >= part and len(loose - part) <= false_edges  # what hangs on a false edge


@given(st.integers(2, 30), st.integers(0, 10**6))
def test_where_all_agree_no_part_is_loose(count: int, seed: int) -> None:
    assert loose_parts(agreements([count], 0, seed), range(count)) == []


def test_halves_that_contradict_each_other_are_left() -> None:
    found = agreements([10, 10], 0, 0)
    assert misplaced(found, range(20)) == []
    assert misplaced(found, range(20), trusted=range(12, 20)) == []
    few = agreements([14, 6], 0, 0)
    assert misplaced(few, range(20), trusted=[0]) == [14, 15, 16, 17, 18, 19]


def test_a_trusted_minority_is_right() -> None:
    found = agreements([6, 8], 0, 0)
    wrong = misplaced(found, range(14), trusted=range(8, 14))
    assert wrong == []  # six of fourteen: too many to say
    assert misplaced(agreements([5, 8], 0, 0), range(13), trusted=range(5, 13)) == [0, 1, 2, 3, 4]


def test_few_matches_say_nothing() -> None:
    found = agreements([9, 1], 0, 0)
    weak = {pair: (0, 3) if pair[1] == 9 else n for pair, n in found.items()}
    assert MIN_MATCHES > 9 * 3
    assert misplaced(weak, range(10)) == []
    assert misplaced(found, range(10)) == [9]


def test_agreement_counts_the_images_asked_for() -> None:
    found = {(0, 1): (8, 10), (1, 2): (0, 10), (0, 2): (1, 10)}
    assert agreement(found, {0, 1}) == pytest.approx(0.8)
    assert agreement(found, {0, 1, 2}) == pytest.approx(0.3)
    assert agreement({}, {0}) == 0.0


@pytest.mark.parametrize("moved", [(), ("one",), ("one", "two")])
def test_poses_that_were_spoiled_are_taken_out(
    make_case: Callable[..., Any], moved: tuple[str, ...]
) -> None:
    case = make_case()
    model = known_images(case.database)
    for image_id, image in list(model.images.items()):
        set_pose(model, image_id, pycolmap.Rigid3d(case.truth[str(image.name)][:3]))
    _, matches = verified_matches(case.database)
    every = set(model.reg_image_ids())
    assert agreement(pair_agreements(model, matches), every) > 0.95
    spoiled = sorted(every)[3 : 3 + len(moved)]
    names = [str(model.images[i].name) for i in spoiled]
    for i in spoiled:  # the same wrong move: they go on agreeing with each other
        pose = model.images[i].cam_from_world()
        turned = pycolmap.Sim3d(1.0, pycolmap.Rotation3d(np.array([0.0, 0.2, 0.1])), [0.5, 0.2, 0])
        wrong = pycolmap.Rigid3d(pose.rotation * turned.rotation.inverse(), pose.translation)
        set_pose(model, i, wrong)
    remarks: list[str] = []
    assert deregister_misplaced(model, matches, remarks) == len(moved)
    assert set(model.reg_image_ids()) == every - set(spoiled)
    assert len(remarks) == min(len(moved), 1)
    assert all(name in remarks[0] for name in names)


@pytest.mark.parametrize("gps", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_part_of_another_size_is_found_and_placed_again(
    tmp_path: Path, write_database: Callable[..., Any], gps: bool
) -> None:
    """A row of photos whose end is scaled about one of them, so that pairs with it still agree."""
    rng = np.random.default_rng(2)
    ground = np.column_stack([rng.uniform(-40, 150, 3000), rng.uniform(-35, 35, 3000)])
    points = np.column_stack([ground, rng.uniform(-5, 5, 3000)])
    places = np.array([[8.0 * i, rng.normal(0, 2), 50.0] for i in range(14)])
    right = [look_at(p, np.array([p[0], 0.0, 0.0])) for p in places]
    camera = pycolmap.Camera(model="PINHOLE", width=1000, height=750, params=[800, 800, 500, 375])
    sees = [rng.uniform(size=3000) < 0.7 for _ in right]
    task = Task.start(write_database(tmp_path, right, points, sees, camera), lambda *_: None)
    _, matches = verified_matches(task.database)
    names = [f"{i:02d}.jpg" for i in range(14)]

    def model_at(centres: NDArray[np.float64]) -> pycolmap.Reconstruction:
        model = known_images(task.database)
        turns = [pose[:3, :3] for pose in right]
        poses = [np.column_stack([r, -r @ c]) for r, c in zip(turns, centres, strict=True)]
        set_poses(model, dict(zip(names, poses, strict=True)))
        return triangulate(model, task, "")

    def loose(model: pycolmap.Reconstruction) -> list[str]:
        found = loose_parts(point_agreements(model, matches), model.reg_image_ids())
        return [str(model.images[i].name) for i in found]

    assert loose(model_at(places)) == []
    wrong = places.copy()
    wrong[9:] = places[8] + 0.6 * (places[9:] - places[8])
    model = model_at(wrong)
    assert loose(model) == names[9:]
    enu = {n: list(p + rng.normal(0, 0.5, 3)) for n, p in zip(names, places, strict=True)}
    priors = Priors(enu if gps else {}, dict.fromkeys(enu, [0.5] * 3) if gps else {})
    again = rejoined(model, matches, priors, task)
    assert loose(again) == []
    assert len(task.remarks) > 0 and "where it is now" in task.remarks[-1]
    centres = {str(i.name): i.projection_center() for i in again.images.values()}
    error = fit_robustly(np.array([centres[n] for n in names]), places)
    assert error is not None and error[1].max() < 0.3
