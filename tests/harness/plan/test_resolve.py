"""What decides a run: options that change nothing are not part of it."""

from pathlib import Path

from chronoscene.harness.files.source import RunOrigin
from chronoscene.harness.plan.job import Job
from chronoscene.harness.plan.resolve import resolve_method
from chronoscene.harness.plan.settings import RunSettings
from chronoscene.methods import load_spec


def document(photo_pixels, **overrides):
    settings = RunSettings(Path(), preset="fast", overrides=overrides)
    job = Job(
        origin=RunOrigin(method="chronogs", scene_root="", scene_format=""),
        scene="", scene_hash="", split_hash="",
        method_name="chronogs", strategy="joint", seed=0,
        settings=settings, photo_pixels=photo_pixels,
    )  # fmt: skip
    run = resolve_method("chronogs", load_spec("chronogs"), settings).run(job)
    return run.document


def test_a_share_at_half_size_counts_where_a_photo_is_large():
    without, halved = (
        [document(pixels, half_size_share=share) for pixels in (399_999, 400_000)]
        for share in ("0", "0.5")
    )
    assert len({found["config_hash"] for found in (*without, halved[0])}) == 1
    assert halved[1]["config_hash"] != without[1]["config_hash"]
    assert halved[1]["config"]["method_config"]["half_size_share"] == 0.5
