"""Photos within limits: the estimate, what is refused, results that limits do not change."""

import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from chronoscene.errors import ConfigError, SceneError
from chronoscene.harness.plan import memory as planning
from chronoscene.harness.plan.memory import (
    check_room,
    device_need,
    open_store,
    photo_needs,
    views_at_a_time,
)
from chronoscene.harness.plan.parts import make_parts
from chronoscene.harness.plan.stop import StopRule
from chronoscene.harness.train.checkpoints import Checkpoints
from chronoscene.harness.train.loop import train
from chronoscene.images.store import ImageStore
from chronoscene.methods import build_config, import_object, load_spec

PIXELS = 24 * 16
PHOTO = 3 * PIXELS
DECODING = 20 * PIXELS + 2 * PHOTO
LITTLE = DECODING + 3 * PHOTO
"""Memory in which training photos just fit; there are five."""


@pytest.fixture
def settings(tmp_path):
    """Fields of `RunSettings` that matter here."""
    return SimpleNamespace(
        max_width=1600, threads=1, photo_memory=10**6, photo_disk=10**6, runs=tmp_path / "runs"
    )


@pytest.fixture
def free(monkeypatch):
    """Sets what is free: bytes of memory, bytes on disk."""

    def free(memory, disk):
        monkeypatch.setattr(planning, "machine_memory", lambda: (10**12, memory))
        monkeypatch.setattr(planning.shutil, "disk_usage", lambda path: SimpleNamespace(free=disk))

    return free


def room(scene, settings, runs, **options):
    return check_room(photo_needs(scene, settings), settings.runs, runs, **options)


def test_the_estimate_counts_photos_masks_and_decoding(make_scene, settings, tmp_path):
    scene = make_scene()
    needs = photo_needs(scene, settings)
    assert (needs.count, needs.total, needs.largest) == (5, 5 * PHOTO, PHOTO)
    assert (needs.decoding, needs.decoders) == (DECODING, 2)
    assert needs.in_memory == 5 * PHOTO + 2 * DECODING and needs.on_disk == 0
    masked = replace(scene, masks={"a/0.png": tmp_path / "m.png"})
    assert photo_needs(masked, settings).total == 5 * PHOTO + PIXELS
    settings.max_width = 12
    assert photo_needs(scene, settings).largest == PHOTO // 4


def test_what_does_not_fit_goes_to_the_disk(make_scene, settings):
    settings.photo_memory = 5 * PHOTO + DECODING
    needs = photo_needs(make_scene(), settings)
    assert needs.decoders == 1 and needs.on_disk == 0
    settings.photo_memory -= 1
    needs = photo_needs(make_scene(), settings)
    assert needs.on_disk == 5 * PHOTO and needs.in_memory == settings.photo_memory
    settings.photo_disk = 100
    assert photo_needs(make_scene(), settings).on_disk == 100


def test_half_of_the_threads_decode_if_memory_allows_it(make_scene, settings):
    settings.threads = 12
    assert photo_needs(make_scene(), settings).decoders == 6
    settings.photo_memory = 8 * DECODING
    assert photo_needs(make_scene(), settings).decoders == 4


def test_the_line_says_what_is_taken(make_scene, settings, free):
    free(2 * 10**9, 10**9)
    line = room(make_scene(), settings, runs=1)
    assert line.startswith("ring: 5 training photos, 5.8 kB when decoded: 25.7 kB in memory; a ")
    assert line.endswith("training takes 0.50 GB and its model besides")
    settings.photo_memory = LITTLE
    assert "kB in memory, 5.8 kB on disk; a" in room(make_scene(), settings, runs=1)


def test_the_memory_of_a_gpu_is_estimated_by_parts(make_scene, settings):
    scene = make_scene()
    needs = photo_needs(scene, settings)
    spec = load_spec("3dgs")
    config = build_config(spec, preset="fast", overrides={"max_gaussians": 1_000_000})
    assert device_need(scene, needs, spec, config) == (
        "ring: 3dgs takes about 1.24 GB of the GPU with 1,000,000 primitives in view: model "
        "0.24 GB, gradients and moments 0.71 GB, drawn Gaussians 0.11 GB, rasterizer 0.18 GB, "
        "images 96.0 kB; an estimate, without what CUDA takes. "
        "Photos stay there, too, up to a quarter of its free memory (here 5.8 kB)"
    )
    nerf = load_spec("nerf")
    assert device_need(scene, needs, nerf, build_config(nerf, preset="fast")) == ""


def test_memory_counts_where_the_run_will_be(make_scene, settings, free):
    free(10**6, 10**9)
    with pytest.raises(ConfigError, match=r"expected 0\.50 GB of memory"):
        room(make_scene(), settings, runs=1)
    room(make_scene(), settings, runs=1, here=False)
    assert 1.50e9 < photo_needs(make_scene(), settings).of_run(views=1) < 1.51e9


def test_views_at_a_time_are_at_most_the_threads():
    spec = load_spec("3dgs")

    def views(option, threads):
        config = build_config(spec, preset="fast", overrides={"views_per_step": option})
        return views_at_a_time(config, threads)

    assert [views(3, threads) for threads in (1, 2, 8)] == [1, 2, 3]
    assert [views("auto", threads) for threads in (1, 2, 4, 64)] == [1, 1, 2, 4]
    assert views_at_a_time(build_config(load_spec("nerf"), preset="fast"), 8) == 1


def test_further_views_at_a_time_take_memory(make_scene, settings, free):
    free(10**12, 10**12)
    scene = big(make_scene())
    settings.photo_memory, settings.max_width = 900_000_000, 6000
    assert "a training takes 6.50 GB" in room(scene, settings, 1)
    assert "a training takes 16.58 GB" in room(scene, settings, 1, views=4)


def big(scene):
    """The scene with photos of 24 and test photos of 4 megapixels."""
    frames = []
    for frame in scene.frames:
        size = (6000, 4000) if frame.split == "train" else (2000, 2000)
        camera = replace(frame.camera, width=size[0], height=size[1])
        frames.append(replace(frame, camera=camera))
    return replace(scene, frames=tuple(frames))


def refusal(scene, settings, runs=1):
    with pytest.raises(ConfigError) as caught:
        room(scene, settings, runs)
    return str(caught.value)


def test_too_little_memory_for_one_photo_is_refused_with_what_is_enough(make_scene, settings, free):
    free(10**12, 10**12)
    scene = big(make_scene())
    assert refusal(scene, settings) == (
        "ring: memory for photos: expected at least 0.51 GB to decode photos of 6000 x 4000 "
        "pixels, found 1.0 MB; scale the photos down, or use --photo-memory 0.51"
    )
    settings.photo_memory = 510_000_000
    room(scene, settings, runs=1)


def test_more_than_is_free_is_refused_with_a_smaller_setting(make_scene, settings, free):
    scene = big(make_scene())
    settings.photo_memory, settings.max_width = 900_000_000, 6000
    free(7_400_000_000, 10**12)
    room(scene, settings, runs=1)
    free(7_390_000_000, 10**12)
    assert refusal(scene, settings) == (
        "ring: expected 7.40 GB of memory, 0.90 GB of it for photos, found 7.39 GB free; "
        "end other programs, or use --photo-memory 0.89"
    )
    free(7_330_000_000, 10**12)
    assert refusal(scene, settings).endswith(
        "end other programs, or use a machine with more memory"
    )


def test_a_full_disk_is_refused_with_a_smaller_setting(make_scene, settings, free, tmp_path):
    scene = big(make_scene())
    settings.photo_memory, settings.photo_disk, settings.max_width = 900_000_000, 10**9, 6000
    decoded, images = 5 * 72_000_000, 3 * 3 * 12_000_000
    free(10**12, decoded + images)
    room(scene, settings, runs=2)
    free(10**12, decoded + images - 10_000_000)
    message = refusal(scene, settings, runs=2)
    assert "expected room for 0.36 GB of decoded photos and at most 0.11 GB of test" in message
    assert "found 0.46 GB free" in message
    assert message.endswith("or make room there, or use bench --photo-disk 0.35")
    kept = tmp_path / "runs" / "photos"
    kept.mkdir(parents=True)
    (kept / "x.npz").write_bytes(b"")
    (kept / "x.npz").open("r+b").truncate(10_000_000)  # what is there already needs no room
    room(scene, settings, runs=2)


def test_bench_says_it_and_refuses_before_anything_is_written(bench, tmp_path, runs_here):
    _, said = bench("MEAN")
    assert any(line.startswith("ring: 5 training photos, 5.8 kB when") for line in said)
    _, said = bench("MEAN", photo_memory=1)  # finished: needs no photos
    assert not any("training photos" in line for line in said)
    with pytest.raises(ConfigError, match="ring: memory for photos: expected at least"):
        bench("MEAN", photo_memory=1, runs=tmp_path / "others")
    assert not (tmp_path / "others").exists()


@pytest.mark.parametrize("method", ["3dgs", "chronogs"])
def test_limits_do_not_change_results(bench_here, tmp_path, method):
    folders = []
    for name, memory in (("plenty", 10**9), ("little", LITTLE)):
        runs = tmp_path / name
        outcome, _ = bench_here(
            method, preset="fast", iterations=12, runs=runs, photo_memory=memory, threads=1
        )
        folders += outcome.finished
        assert (runs / "photos").exists() == (name == "little")
    assert len(list((tmp_path / "little" / "photos").iterdir())) == 5
    assert len({(f / "checkpoint" / "model.safetensors").read_bytes() for f in folders}) == 1


def test_a_photo_that_changes_in_a_run_is_refused(make_scene, settings):
    scene = make_scene()
    store, path = open_store(scene, settings), scene.image_path(scene.frames[0])
    os.utime(path, ns=(0, 10**18))
    with pytest.raises(SceneError, match="expected a file that stays as it was when the run began"):
        store.load(scene.frames[0])


def test_a_training_that_goes_on_with_photos_from_disk_ends_alike(make_scene, settings, tmp_path):
    """Without disk and interruption, and with both; one photo has a mask."""
    Image.fromarray(np.eye(16, 24, dtype=np.uint8)).save(tmp_path / "m.png")
    scene = replace(make_scene(), masks={"a/0.png": tmp_path / "m.png"})
    settings.photo_memory = LITTLE + 2 * PIXELS + 3 * PIXELS
    spec = load_spec("3dgs")
    config = build_config(spec, preset="fast", overrides={"iterations": 16})

    def run(store, until=None, **options):
        method = import_object(spec.method)(config)

        def stop(iteration, *report):
            if iteration == until:
                raise SystemExit

        (part,) = make_parts(scene, store, "joint")
        train(method, part, StopRule(16, None), {}, seed=0, device="cpu", observer=stop, **options)
        return method

    undisturbed = run(ImageStore(scene))
    common = {"settings": {}, "commit": "abc", "every": 0.0, "keep_last": False, "start": None}
    common["device"] = "cpu"
    folder = tmp_path / "training" / "all"
    for until in (5, 9):
        with pytest.raises(SystemExit):
            checkpoints = Checkpoints(folder=folder, log=lambda line: None, **common)
            run(open_store(scene, settings), until, checkpoints=checkpoints)
    assert len(list((tmp_path / "runs" / "photos").iterdir())) == 5
    checkpoints = Checkpoints(folder=folder, log=lambda line: None, **common)
    resumed = run(open_store(scene, settings), checkpoints=checkpoints)
    for name, tensor in undisturbed.stored_tensors().items():
        assert tensor.equal(resumed.stored_tensors()[name])
