"""Camera paths of the viewer pass through their views, and ``render`` reads them."""

import numpy as np
import pytest

from chronoscene.harness.use.cameras import find_viewpoints
from chronoscene.harness.use.trained_run import open_run
from chronoscene.harness.view.paths import FPS, KeyView, interpolate, path_file


@pytest.fixture
def views(trained):
    frames = open_run(trained["chronogs"]).scene().frames
    return [KeyView(frames[i].cam_from_world, 0.8 + 0.1 * i, i / 3) for i in range(3)]


def test_a_path_passes_through_its_views(views):
    path = interpolate(views, 21)
    for view, there in zip(views, path[::10], strict=True):
        assert np.allclose(view.pose, there.pose, atol=1e-9)
        assert (there.fov, there.period) == pytest.approx((view.fov, view.period))
    for view in path:
        rotation = view.pose[:3, :3]
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    periods = [view.period for view in path]
    assert periods == sorted(periods)


def test_one_view_stands_still(views):
    assert interpolate(views[:1], 5) == views[:1] * 5


def test_render_reads_what_was_saved(views, trained, tmp_path):
    file = tmp_path / "camera_path.json"
    file.write_bytes(path_file(views, 2.0, (801, 400), 2, whole=False))
    found = find_viewpoints(str(file), open_run(trained["chronogs"]), None, 1).viewpoints
    assert len(found) == 2 * FPS
    assert found[0].camera.size == (1280, 640)
    for view, there in ((views[0], found[0]), (views[-1], found[-1])):
        assert np.allclose(view.pose, there.cam_from_world, atol=1e-9)
        assert there.period == pytest.approx(view.period)
        assert 2 * np.arctan(320 / there.camera.params[0]) == pytest.approx(view.fov)


def test_periods_are_whole_for_methods_that_need_that(views, trained, tmp_path):
    file = tmp_path / "camera_path.json"
    file.write_bytes(path_file(views, 1.0, (640, 480), 2, whole=True))
    found = find_viewpoints(str(file), open_run(trained["4dgs"]), None, 1).viewpoints
    assert {viewpoint.period for viewpoint in found} == {0.0, 1.0}
