"""Finished runs of radiance fields: what they show, and what is refused by name."""

import numpy as np
import pytest

from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import read_run
from chronoscene.harness.use.compression import compress_run
from chronoscene.harness.use.export import prepare
from chronoscene.harness.use.trained_run import open_run

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("method", ["clnerf", "neusc"])
def test_a_run_renders_and_has_no_gaussians(bench_here, method):
    outcome, _ = bench_here(method, preset="fast", iterations=20)
    assert outcome.failures == ()
    folder = outcome.finished[0]
    record = read_run(folder)
    assert record.empty_steps == record.skipped_steps == 0
    assert np.isfinite(record.aggregates["macro"]["psnr"])
    run = open_run(folder)
    scene = run.scene()
    frame = scene.frames[0]
    shown = run.render(frame.camera, frame.cam_from_world, 0.0)
    assert shown.depth is not None
    assert (shown.depth[shown.alpha > 0] > 0).all()
    repainted = run.render(frame.camera, frame.cam_from_world, 0.0, appearance_period=1.0)
    assert np.array_equal(repainted.depth, shown.depth)
    with pytest.raises(ConfigError, match="a method that gives its Gaussians"):
        prepare(run, scene, 0.0)
    with pytest.raises(ConfigError, match="a method with anchors or Gaussians"):
        compress_run(run, scene, max_loss=None, log=print)
