"""The painted balls are a training set: every view sees all of them, at its own period."""

import numpy as np
import pytest

from chronoscene.harness.train.painted_balls import VIEWS_PER_PERIOD, make_training_set


@pytest.mark.parametrize("periods", [1, 2, 50])
def test_views_see_the_points(periods):
    train = make_training_set(periods)
    count = VIEWS_PER_PERIOD * periods
    assert [v.period for v in train.views] == [i // VIEWS_PER_PERIOD for i in range(count)]
    for i, view in enumerate(train.views):
        inside = train.points @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
        assert inside[:, 2].min() > 0.2
        if i % 40 == 0:
            assert train.load_image(i).shape == (view.height, view.width, 3)
            assert train.load_image(i) is train.load_image(i)


def test_every_third_ball_is_repainted():
    train = make_training_set(2)
    images = np.stack([train.load_image(i) for i in range(len(train.views))])
    assert images.std(axis=(1, 2)).min() > 10
