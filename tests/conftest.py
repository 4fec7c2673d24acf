"""Small scene folders for tests, made by COLMAP's own generator rather than by our writer."""

import gc
import os
import shutil
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock
from hypothesis import settings
from PIL import Image

import chronoscene  # noqa: F401  (loads zlib before pycolmap)
from chronoscene.io.pycolmap import pycolmap
from chronoscene.kernels import runtime

# How long an example takes is not a property of the code on a machine that others use too. What is
# drawn is the same in every run, unless --hypothesis-profile=afresh asks for other draws.
settings.register_profile("fixed", deadline=None, derandomize=True, database=None, max_examples=25)
settings.register_profile("afresh", deadline=None, derandomize=False)
settings.load_profile("fixed")

FOUR_IMAGES = {"a/0001.png": 0, "a/0002.png": 0, "b/0001.png": 1, "b/0003.png": 1}
"""Image name to period; file names alone are ambiguous."""


def synthetic_model(names: list[str], *, points: int = 30) -> pycolmap.Reconstruction:
    """A model of exact observations; the camera has fx != fy and is off centre."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = 1
    options.num_cameras_per_rig = 1
    options.num_frames_per_rig = len(names)
    options.num_points3D = points
    options.camera_model_id = pycolmap.CameraModelId.PINHOLE
    options.camera_width, options.camera_height = 64, 48
    options.camera_params = [50.0, 52.0, 30.0, 25.5]
    pycolmap.set_random_seed(7)
    model = pycolmap.synthesize_dataset(options)
    for image_id, name in zip(sorted(model.images), names, strict=True):
        model.images[image_id].name = name
    for i, point_id in enumerate(sorted(model.points3D)):
        model.points3D[point_id].color = np.array([i % 256, 10, 20], np.uint8)
    return model


def write_images(folder: Path, names: list[str], size: tuple[int, int] = (64, 48)) -> None:
    """Random images, different for each name."""
    for i, name in enumerate(names):
        pixels = np.random.default_rng(i).integers(0, 256, (size[1], size[0], 3), np.uint8)
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(folder / name)


def write_model(model: pycolmap.Reconstruction, folder: Path, form: str) -> None:
    """Write as ``binary`` (five files), ``old`` (the three files of before 3.12) or ``text``."""
    folder.mkdir(parents=True, exist_ok=True)
    if form == "text":
        model.write_text(str(folder))
    else:
        model.write_binary(str(folder))
    if form == "old":
        (folder / "rigs.bin").unlink()
        (folder / "frames.bin").unlink()


def pytest_collection_finish() -> None:
    """Modules and tests stay to the end: looking through them for garbage takes a twelfth of the
    time, and looking for it as often as Python does up to a twentieth."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 10, 10)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Small scenes are quicker on one thread, most of all beside other tests."""
    runtime.set_threads(1)


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Make a folder that costs seconds once for all processes of the tests; do not change it."""

    def make(name: str, fill: Callable[[Path], object]) -> Path:
        root = tmp_path_factory.getbasetemp()
        if "PYTEST_XDIST_WORKER" in os.environ:
            root = root.parent
        folder = root / f"made-{name}"
        with FileLock(f"{folder}.lock"):
            if not folder.exists():
                unfinished = root / f"unfinished-{name}"
                shutil.rmtree(unfinished, ignore_errors=True)
                unfinished.mkdir()
                fill(unfinished)
                unfinished.rename(folder)
        return folder

    return make


@pytest.fixture
def threads() -> Callable[[int], None]:
    """Sets how many threads kernels have; the test is skipped where there are not so many."""
    import numba

    def set_threads(number: int) -> None:
        if number > numba.config.NUMBA_NUM_THREADS:  # type: ignore[attr-defined]
            pytest.skip(f"needs {number} threads")
        numba.set_num_threads(number)

    return set_threads


@pytest.fixture
def without_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """The code of a GPU, on a CPU."""
    monkeypatch.setattr("chronoscene.training.devices.has_kernels", lambda *tensors: False)


@pytest.fixture(params=["compiled", "torch"])
def both_codes(request: pytest.FixtureRequest) -> None:
    """The code of a CPU, then that of a GPU."""
    if request.param == "torch":
        request.getfixturevalue("without_kernels")


@pytest.fixture
def runs_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Benches in the test process."""
    from training_here import train_here

    train_here(monkeypatch)


@pytest.fixture
def make_scene_folder(tmp_path: Path) -> Callable[..., Path]:
    """Factory of scene folders in the ChronoScene format."""

    def make(
        periods: Mapping[str, int] = FOUR_IMAGES,
        *,
        name: str = "scene",
        form: str = "binary",
        tests: list[str] | None = None,
        points: int = 30,
    ) -> Path:
        root = tmp_path / name
        names = list(periods)
        write_model(synthetic_model(names, points=points), root / "sparse" / "0", form)
        write_images(root / "images", names)
        lines = "".join(f"{image} {period}\n" for image, period in periods.items())
        (root / "sparse" / "split.txt").write_text(lines)
        if tests is not None:
            (root / "sparse" / "0" / "test.txt").write_text("".join(f"{t}\n" for t in tests))
        return root

    return make


@pytest.fixture
def shared_data() -> Path:
    """Folder with real and rendered scenes; skips where there is none."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("CHRONOSCENE_SHARED_DATA", default))
    if not folder.is_dir():
        pytest.skip("no data: set CHRONOSCENE_SHARED_DATA to a folder with scenes")
    return folder


@pytest.fixture
def set_gsplat(monkeypatch: pytest.MonkeyPatch) -> Generator[Callable[[str | None], None]]:
    """Pretends that a version of gsplat is installed, or none."""

    def pretend(installed: str | None) -> None:
        def version(name: str) -> str:
            if installed is None:
                raise PackageNotFoundError
            return installed

        monkeypatch.setattr(runtime, "version", version)
        runtime.gsplat_release.cache_clear()

    yield pretend
    runtime.gsplat_release.cache_clear()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium of the system, without a screen and without WebGL, which is slow on a CPU."""
    with _chromium("--disable-gpu") as opened:
        yield opened


@pytest.fixture(scope="module")
def browser_with_webgl() -> Iterator[Any]:
    """Chromium with WebGL, for pages that draw in three dimensions."""
    options = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with _chromium(*options) as opened:
        yield opened


@contextmanager
def _chromium(*options: str) -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    program = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)
    if program is None:
        pytest.skip("no Chromium here")
    with api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(
            executable_path=program, args=[*options, "--no-sandbox"]
        )
        yield opened
        opened.close()
