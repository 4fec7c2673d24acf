"""The scene folder as a whole: bytes, names, splits, dates."""

from __future__ import annotations

import filecmp
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from chronoscene.errors import SceneError
from chronoscene.formats import chronoscene as scene_format
from chronoscene.harness.files.provenance import scene_hash
from chronoscene.kernels.runtime import set_threads
from chronoscene.synth import generate, preset
from chronoscene.validation.run import validate_scene

SMALL: dict[str, Any] = {"width": 32, "height": 24, "views": 4, "points": 80, "probe_spacing": 8.0}


def files(folder: Path) -> list[Path]:
    return sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("small") / "two"
    set_threads()
    generate(folder, preset("tiny", **SMALL))
    return folder


def test_same_seed_same_bytes_with_one_thread(small: Path, tmp_path: Path) -> None:
    cores = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(cores)})
        generate(tmp_path / "one", preset("tiny", **SMALL))
    finally:
        os.sched_setaffinity(0, cores)
    names = files(small)
    assert names == files(tmp_path / "one")
    same, different, failed = filecmp.cmpfiles(small, tmp_path / "one", names, shallow=False)
    assert not different and not failed and len(same) == len(names)


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() != "x86_64", reason="names a processor of x86-64")
def test_same_seed_same_hash_on_an_old_processor(small: Path, tmp_path: Path) -> None:
    """Our code, numpy's linear algebra and the library of the system without AVX and FMA.

    Poses have other last bits then, which the hash rounds.
    """
    old = {
        "NUMBA_CPU_NAME": "x86-64",
        "NUMBA_CPU_FEATURES": "",
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "OPENBLAS_CORETYPE": "Prescott",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX,-AVX2,-FMA,-AVX512F",
    }
    script = (
        "import sys; from chronoscene.synth import generate, preset\n"
        f"generate(sys.argv[1], preset('tiny', **{SMALL}))"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "old")]
    subprocess.run(command, env={**os.environ, **old}, check=True)
    hashes = {scene_hash(scene_format.read(folder)) for folder in (small, tmp_path / "old")}
    assert len(hashes) == 1


@pytest.mark.slow
def test_another_seed_is_another_place(small: Path) -> None:
    from chronoscene.synth.city.plan import make_world

    first = make_world(preset("tiny", **SMALL))
    second = make_world(preset("tiny", **SMALL, seed=1))
    assert np.abs(first.core - second.core).max() > 0.1
    assert first.lights[0].azimuth != second.lights[0].azimuth


def test_folder_has_what_the_format_asks_for(made) -> None:  # type: ignore[no-untyped-def]
    names = {str(p) for p in files(made.folder)}
    assert {"sparse/split.txt", "sparse/0/test.txt", "sparse/periods.json"} <= names
    assert {"sparse/world.json", "gt/periods.json", "gt/contact_sheet.png"} <= names
    assert made.scene.world.unit == "metre"
    assert made.scene.split_rule == "sparse/0/test.txt"
    dates = [p.date for p in made.scene.periods]
    assert dates == sorted(set(dates))
    assert not [p for p in made.folder.parent.iterdir() if p != made.folder], "leftovers"


def test_images_are_of_the_camera_and_not_flat(made) -> None:  # type: ignore[no-untyped-def]
    for frame in made.scene.frames:
        image = cv2.imread(str(made.scene.image_path(frame)))
        assert image.shape == (frame.camera.height, frame.camera.width, 3)
        assert image.std() > 15 and 40 < image.mean() < 200
        clipped = ((image <= 2) | (image >= 253)).all(axis=2).mean()
        assert clipped < 0.05, f"{frame.name}: {clipped:.0%} black or white"


def test_periods_differ_in_number_and_every_part_of_a_flight_is_tested(made) -> None:  # type: ignore[no-untyped-def]
    scene = made.scene
    counts = [len(scene.select(period=p)) for p in range(scene.num_periods)]
    assert len(set(counts)) == len(counts)
    for period, count in enumerate(counts):
        numbers = [int(f.name[3:7]) for f in scene.select(split="test", period=period)]
        assert len(numbers) >= 2
        cuts = np.linspace(0, count, len(numbers) + 1)
        parts = np.searchsorted(cuts, np.array(numbers), side="right") - 1
        assert parts.tolist() == list(range(len(numbers)))


def test_off_centre_camera(made) -> None:  # type: ignore[no-untyped-def]
    fx, fy, cx, cy = made.scene.frames[0].camera.params
    assert fx != fy
    assert abs(cx - made.settings.width / 2) > 1 and abs(cy - made.settings.height / 2) > 1


def test_refuses_a_folder_in_use(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(SceneError, match="expected a new or empty folder"):
        generate(tmp_path, preset("tiny"))
    assert (tmp_path / "mine.txt").read_text() == "keep"


def test_interrupted_run_leaves_nothing(tmp_path: Path) -> None:
    class StopError(Exception):
        pass

    def stop(what: str, done: int, total: int) -> None:
        if what == "photos":
            raise StopError

    with pytest.raises(StopError):
        generate(tmp_path / "scene", preset("tiny", **SMALL, periods=1), stop)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_progress_counts_to_the_end(tmp_path: Path) -> None:
    seen: list[tuple[str, int, int]] = []
    settings = preset("tiny", **SMALL, kind="street", periods=1)
    generate(tmp_path / "scene", settings, lambda *x: seen.append(x))
    done = [count for _, count, _ in seen]
    # A step that takes long is named when it begins, with the count as it was.
    assert done == sorted(done) and set(done) == set(range(seen[-1][2] + 1))


@pytest.mark.parametrize(
    "change",
    [
        {"kind": "street", "off_centre": True, "noise": 0.5},
        *(
            pytest.param(change, marks=pytest.mark.slow)
            for change in (
                {"kind": "facing"},
                {"off_centre": True},
                {"rebuilt": 1.0},
                {"noise": 0.5},
                {"periods": 1},
            )
        ),
    ],
    ids=str,
)
def test_the_validator_has_nothing_to_say(tmp_path: Path, change: dict[str, Any]) -> None:
    generate(tmp_path / "scene", preset("tiny", **change))
    report = validate_scene(tmp_path / "scene", decode=True)
    assert [str(f) for f in report.findings if f.severity != "info"] == []
    assert not report.skipped
