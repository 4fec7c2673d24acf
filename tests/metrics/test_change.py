"""Change maps against scikit-learn, and constructed images whose leakage is known."""

import numpy as np
import pytest

from chronoscene.errors import ShapeError
from chronoscene.images.truth import APPEARANCE, GEOMETRY, UNCHANGED
from chronoscene.metrics.change import change_scores, share_of_other


def test_golden_values():
    """average_precision_score, f1_score and jaccard_score of scikit-learn 1.9.1; many ties."""
    rng = np.random.default_rng(0)
    scores = rng.integers(0, 20, 500) / 20
    truth = np.where(rng.random(500) < 0.2 + 0.5 * scores, GEOMETRY, UNCHANGED)
    values = change_scores(scores, truth, threshold=0.5)
    assert values["change_ap"] == pytest.approx(0.5925218032675572, abs=1e-14)
    assert values["change_f1"] == pytest.approx(0.6040816326530613, abs=1e-14)
    assert values["change_iou"] == pytest.approx(0.4327485380116959, abs=1e-14)


def test_by_hand():
    """The two highest are changed, then one that is not, then the third change of five pixels."""
    truth = np.array([[GEOMETRY, UNCHANGED, GEOMETRY, UNCHANGED, GEOMETRY]])
    scores = np.array([[0.9, 0.5, 0.8, 0.1, 0.4]])
    values = change_scores(scores, truth, threshold=0.5)
    assert values["change_ap"] == pytest.approx((1 + 1 + 3 / 4) / 3)
    assert values["change_f1"] == pytest.approx(2 / 3) and values["change_iou"] == 0.5


def test_a_map_that_says_nothing_has_the_share_of_changed_pixels():
    truth = np.full((4, 5), UNCHANGED)
    truth[0] = GEOMETRY
    assert change_scores(np.zeros((4, 5)), truth)["change_ap"] == 0.25
    flags = np.zeros((4, 5), np.uint8)
    flags[0] = 200  # bytes must not wrap around when they are ordered
    assert change_scores(flags, truth)["change_ap"] == 1


def test_kinds_apart():
    """Each kind against what is unchanged: a map of new objects is no worse for missing paint."""
    truth = np.array([GEOMETRY, GEOMETRY, APPEARANCE, APPEARANCE, UNCHANGED, UNCHANGED])
    scores = np.array([0.9, 0.8, 0.0, 0.1, 0.1, 0.0])
    values = change_scores(scores, truth, threshold=0.5)
    assert values["change_ap_geometry"] == values["change_f1_geometry"] == 1
    assert values["change_ap_appearance"] == 0.5 and values["change_iou_appearance"] == 0
    assert values["change_iou"] == 0.5
    only = change_scores(scores, np.where(truth == APPEARANCE, UNCHANGED, truth))
    assert set(only) == {"change_ap", "change_ap_geometry"}


def test_pixels_that_do_not_count():
    truth, scores = np.array([GEOMETRY, UNCHANGED, UNCHANGED]), np.array([0.5, 0.9, 0.1])
    assert change_scores(scores, truth)["change_ap"] == 0.5
    assert change_scores(scores, truth, [True, False, True])["change_ap"] == 1
    assert change_scores(scores, truth, [False, True, True]) == {}


@pytest.fixture
def truths():
    rng = np.random.default_rng(0)
    return rng.random((6, 7, 3)), rng.random((6, 7, 3))


@pytest.mark.parametrize("share", [0, 0.25, 0.5, 1, 1.5])
def test_a_blend_of_both_truths(truths, share):
    own, other = truths
    blend = (1 - share) * own + share * other
    assert share_of_other(blend, own, other) == pytest.approx(share, abs=1e-12)


def test_errors_at_right_angles_to_the_change_do_not_count(truths):
    own, _ = truths
    other = own + np.array([0.2, -0.2, 0.0])
    assert share_of_other(own + 0.3, own, other) == pytest.approx(0, abs=1e-12)


def test_a_ghost_outside_the_mask_is_none(truths):
    own, other = truths
    mask = np.zeros((6, 7), bool)
    mask[:3] = True
    image = np.where(mask[..., None], own, other)
    assert share_of_other(image, own, other, mask) == 0
    assert share_of_other(image, own, other, ~mask) == pytest.approx(1)
    with pytest.raises(ShapeError, match="expected a change where pixels count, found none"):
        share_of_other(image, own, own, mask)
