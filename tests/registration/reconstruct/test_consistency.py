"""Images whose matches contradict their poses."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.features.database import verified_matches
from chronoscene.registration.reconstruct.consistency import (
    MIN_MATCHES,
    agreement,
    deregister_misplaced,
    misplaced,
    pair_agreements,
)
from chronoscene.registration.reconstruct.models import known_images, set_pose


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
