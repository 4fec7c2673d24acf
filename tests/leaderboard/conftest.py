"""Finished runs that nobody trained, with their predictions; a scene to verify entries with."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from made_runs import record, write_scored

from chronoscene.formats import read_scene
from chronoscene.harness.files.ground_truth import freeze_ground_truth
from chronoscene.harness.files.predictions import ImageWriter, load_image
from chronoscene.harness.files.protocols import PROTOCOLS
from chronoscene.harness.files.provenance import scene_hash
from chronoscene.harness.files.records import PREDICTIONS, write_run
from chronoscene.harness.score.scoring import rescore
from chronoscene.metrics.registry import make_scorers
from chronoscene.scene.splits import split_hash
from leaderboard.submit import submit

IMAGES = {f"{period}/{i}.png": period for period in range(2) for i in range(4)}
TESTS = [name for name in IMAGES if name[2] in "02"]


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Path]:
    """Factory of folders of runs below ``tmp_path / "runs"``."""
    return partial(write_scored, tmp_path / "runs", scene="square")


@pytest.fixture(scope="session")
def enter() -> Callable[..., list[Path]]:
    """As `submit`, with the values that runs say, whatever their images are."""

    def as_they_are(folders: list[Path], to: Path) -> list[Path]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("leaderboard.submit.check_values", lambda *_: None)
            return submit(folders, to)

    return as_they_are


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for what a module makes once."""
    return tmp_path_factory.mktemp("kept")


@pytest.fixture
def honest(kept: Path, make_scene_folder: Callable[..., Path]) -> Path:
    """Folder of a ``scene``, ``runs`` on it with true scores, and their ``entries``.

    Two seeds of ``3dgs``, and one of ``4dgs``: photos with noise, of 64 x 48 pixels.
    """
    if not (kept / "entries").exists():
        make_scene_folder(IMAGES, name="yard", tests=TESTS).rename(kept / "yard")
        scene = read_scene(kept / "yard")
        for seed in (0, 1):
            write_noisy(kept / "runs", scene, "3dgs", seed, noise=30)
        write_noisy(kept / "runs", scene, "4dgs", 0, noise=60)
        rescore(kept / "runs", make_scorers(["psnr", "ssim"]))
        submit([kept / "runs"], kept / "entries")
    return kept


@pytest.fixture(scope="session")
def noisy() -> Callable[..., None]:
    """Writer of runs without scores."""
    return write_noisy


def write_noisy(
    runs: Path, scene, method: str, seed: int, *, noise: int, protocol: str = ""
) -> None:
    """A run without scores, whose predictions are photos with noise."""
    hashes = {"scene_hash": scene_hash(scene), "split_hash": split_hash(scene)}
    run = record(
        method, seed, scene=scene.name, config_hash="c" * 64, commit="1" * 40,
        max_width=PROTOCOLS[protocol].max_width if protocol else 1600,
        period_labels={str(p.id): p.label for p in scene.periods}, iterations=1000,
        protocol=protocol, **hashes,
    )  # fmt: skip
    truth = freeze_ground_truth(runs, scene, run.scene_hash, run.max_width)
    folder = runs / scene.name / f"{method}-joint-fast" / f"seed{seed}"
    writer, rng = ImageWriter(folder / PREDICTIONS), np.random.default_rng((seed, noise))
    for photo in truth.images:
        pixels = load_image(runs / "ground_truth" / scene.name, photo).astype(int)
        pixels = np.clip(pixels + rng.integers(-noise, noise, pixels.shape), 0, 255)
        period = photo.camera_period
        writer.add(
            photo.view, pixels.astype(np.uint8), camera_period=period, rendered_period=period
        )
    writer.close_run(run)
    write_run(folder, run, [])
