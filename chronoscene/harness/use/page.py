"""A page to walk through what finished runs reconstructed, which opens from a file."""

from __future__ import annotations

import io
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from chronoscene.arrays import Array, Pixels
from chronoscene.errors import ConfigError
from chronoscene.harness.use.page_gaussians import PackedGaussians, Reduction, fit_gaussians
from chronoscene.harness.use.trained_run import TrainedRun
from chronoscene.images.store import ImageStore
from chronoscene.io.pages import render_page
from chronoscene.io.processes import Report
from chronoscene.io.staging import staged_folder
from chronoscene.io.wording import counted, joined
from chronoscene.scene import Camera, Frame, Scene
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.orbit import find_up, orbit
from chronoscene.scene.similarity import Sim3

SCRIPTS = (
    *("vectors", "view", "spz", "sorting", "shaders", "renderer", "picking"),
    *("overlay", "link", "controls", "panel", "app", "start"),
)
"""Files of ``io/templates/run_page`` in their order in the page."""
EXTENT = 100.0
"""Distance of the farthest camera in units of the page. The steps of centres in SPZ are then small
beside it, and its largest scales larger."""
AXES = np.array([1.0, -1.0, -1.0])
"""Signs of the axes of SPZ, right, up and back, in a frame that is right, down, front."""
PHOTO_SIDE, PHOTO_QUALITY = 400, 78
FRUSTUM = 0.2
"""Length of a drawn frustum in mean distances between neighbouring cameras."""
STEP_BACK = 1.5
"""Distance of the first view in that of the cameras: most of them are in it."""
TEST_PHOTO_SHARE = 0.25
"""Part of the limit that photos of test views may take before the Gaussians."""


@dataclass(frozen=True, slots=True)
class PageSummary:
    """Account of what a page holds. Sizes are in bytes."""

    path: Path
    gaussians: int
    photos: int
    total: int
    packed: tuple[PackedGaussians, ...]
    """Gaussians of each run."""
    missing_photos: int
    reduction: Reduction


def write_page(
    runs: Sequence[TrainedRun],
    out: Path,
    scene: Scene,
    periods: Sequence[int],
    *,
    max_bytes: float,
    report: Report,
) -> PageSummary:
    """Write the page of one run, or of several runs of a scene, into a new folder.

    Args:
        runs: Methods to compare; `check_runs` has checked them.
        out: The folder: ``index.html``, and what that loads from ``data`` and ``photos``.
        scene: The scene that the runs were trained on.
        periods: Periods that are in the page.
        max_bytes: Limit of all files together. Photos of training views are left out first, then
            what `fit_gaussians` names.
        report: Called with the progress.

    Raises:
        ConfigError: If a method has no Gaussians, or the limit is too small.
        CheckpointError: If a model is missing.
        SceneError: If the folder is in use or cannot be written to.
        DiskFullError: If there is no space.
    """
    page_from_world = Sim3(EXTENT, np.eye(3), np.zeros(3)) @ runs[0].training_from_world
    frames = [frame for frame in scene.frames if frame.period in periods]
    with staged_folder(out) as staged:
        clouds = _gaussians(runs, scene, periods, page_from_world, report)
        document = _document(runs, scene, frames, periods, page_from_world)
        photos = _Photos(runs[0].photos(scene), staged)
        room = max_bytes - _size_of_rest(document, runs, periods)
        for frame in _test_first(frames):
            if frame.split == "test" and photos.size < TEST_PHOTO_SHARE * max_bytes:
                photos.add(frame, room)
        filtered = [run.is_filtered for run in runs]
        report("packing", 0, 1)
        packed, reduction = fit_gaussians(clouds, filtered, room - photos.size)
        size = sum(len(each.text) for each in packed)
        for i, frame in enumerate(_test_first(frames)):
            report("photos", i, len(frames))
            photos.add(frame, room - size)
        for item, frame in zip(document["frames"], frames, strict=True):
            item["photo"] = photos.files.get(frame.name)
        missing = len(frames) - len(photos.files)
        (staged / "data").mkdir()
        for item, each in zip(document["runs"], packed, strict=True):
            text = _script(item["file"], each.text)
            (staged / "data" / f"{item['file']}.js").write_text(text, encoding="ascii")
        page = _page(document, reduction, runs, periods, missing)
        (staged / "index.html").write_text(page, encoding="utf-8", newline="\n")
        total = sum(path.stat().st_size for path in staged.rglob("*.*"))
    return PageSummary(
        out / "index.html", size, photos.size, total, tuple(packed), missing, reduction
    )


def check_runs(runs: Sequence[TrainedRun]) -> None:
    """Check that runs can be shown in one page.

    Raises:
        ConfigError: If they are of several scenes, or know other periods.
    """
    for run in runs[1:]:
        for what in ("scene_hash", "period_labels"):
            if getattr(run.record, what) != getattr(runs[0].record, what):
                raise ConfigError(
                    run.folder,
                    expected=f"a run of the scene and periods of {runs[0].folder}",
                    found=f"one of {run.record.scene}, {run.num_periods} periods",
                    todo="make a page for each scene",
                )


def chosen_periods(run: TrainedRun, text: str | None) -> range:
    """Return the periods that a number, a label or a range ``FROM:TO`` names; all for None.

    Raises:
        ConfigError: If the run has no such period, or one is a fraction.
    """
    if text is None:
        return range(run.num_periods)
    ends = run.parse_periods(text)
    if any(end != int(end) for end in ends):
        raise ConfigError(
            f"--period {text}",
            expected="whole periods",
            found="a fraction",
            todo="choose periods with photos: the page fades between them",
        )
    low, high = sorted((int(ends[0]), int(ends[-1])))
    return range(low, high + 1)


def _gaussians(
    runs: Sequence[TrainedRun],
    scene: Scene,
    periods: Sequence[int],
    page_from_world: Sim3,
    report: Report,
) -> list[list[GaussianCloud]]:
    """Return the Gaussians of each run and period."""
    clouds: list[list[GaussianCloud]] = []
    for i, run in enumerate(runs):
        clouds.append([])
        for k, period in enumerate(periods):
            report("Gaussians", i * len(periods) + k, len(runs) * len(periods))
            clouds[-1].append(run.gaussians(period, scene=scene, target_from_world=page_from_world))
    return clouds


def _document(
    runs: Sequence[TrainedRun],
    scene: Scene,
    frames: Sequence[Frame],
    periods: Sequence[int],
    page_from_world: Sim3,
) -> dict[str, Any]:
    """Collect what the page knows beside the Gaussians, in its frame and axes."""
    store = runs[0].photos(scene)
    poses = page_from_world.apply_to_pose(np.stack([frame.cam_from_world for frame in frames]))
    middle = page_from_world.apply(scene.points.xyz[scene.points.finite])
    start = orbit(poses, middle, 1)[0]
    distance = STEP_BACK * np.linalg.norm(camera_centre(start) - np.median(middle, axis=0))
    start[2, 3] += distance * (1 - 1 / STEP_BACK)
    labels = list(runs[0].record.period_labels.values())
    return {
        "periods": [labels[period] for period in periods],
        "metric": scene.world.unit == "metre",
        "unitsPerLength": 1 / page_from_world.scale,
        "up": _rounded(AXES * find_up(poses)),
        "home": {**_camera(store.camera(frames[0]), start), "distance": float(distance)},
        "frustum": float(FRUSTUM * EXTENT * np.sqrt(len(periods) / len(frames))),
        "runs": [
            {
                "name": name,
                "file": f"run-{i}",
                "near": _near_plane(run) * page_from_world.scale,
                "antialiased": run.is_filtered,
            }
            for i, (run, name) in enumerate(zip(runs, _names(runs), strict=True))
        ],
        "frames": [
            {
                "name": frame.name,
                "period": periods.index(frame.period),
                "split": frame.split,
                **_camera(store.camera(frame), pose),
                "photo": None,
            }
            for frame, pose in zip(frames, poses, strict=True)
        ],
    }


def _names(runs: Sequence[TrainedRun]) -> list[str]:
    """Name runs by their methods, and by the rest of their settings where a method is there twice.

    A run that is there twice has the same name twice.
    """
    records = [run.record for run in runs]
    settings = [", ".join(filter(None, (r.strategy, r.preset, r.variant))) for r in records]
    names = [run.spec.title for run in runs]
    longer = [f"{name} ({setting})" for name, setting in zip(names, settings, strict=True)]
    longest = [f"{name[:-1]}, seed {r.seed})" for name, r in zip(longer, records, strict=True)]
    for more in (longer, longest):
        count = Counter(names)
        names = [m if count[n] > 1 else n for n, m in zip(names, more, strict=True)]
    return names


def _camera(camera: Camera, cam_from_page: Array) -> dict[str, Any]:
    """Describe a camera in the axes of the page."""
    K = camera.K
    return {
        "eye": _rounded(AXES * camera_centre(cam_from_page)),
        "rotation": _rounded((cam_from_page[:3, :3] * AXES).ravel()),
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "fx": K[0, 0],
            "fy": K[1, 1],
            "cx": K[0, 2],
            "cy": K[1, 2],
        },
    }


def _rounded(values: Array) -> list[float]:
    return [round(float(value), 7) for value in values]


def _near_plane(run: TrainedRun) -> float:
    """Return the depth from which Gaussians of a run are drawn, in world units."""
    near = float(getattr(run.config, "near_plane", 0.01))
    in_world = getattr(run.config, "length_unit", "world") == "world"
    return near if in_world else near / run.training_from_world.scale


def _test_first(frames: Sequence[Frame]) -> Iterator[Frame]:
    """Yield test views, then training views, of each kind an even choice first."""
    for split in ("test", "train"):
        of_split = [frame for frame in frames if frame.split == split]
        for i in np.random.default_rng(0).permutation(len(of_split)):
            yield of_split[i]


class _Photos:
    """Small photos in the folder of a page."""

    def __init__(self, store: ImageStore, folder: Path) -> None:
        self.files: dict[str, str] = {}
        """File of each frame that has one, as the page names it."""
        self.size = 0
        self._store, self._folder = store, folder
        (folder / "photos").mkdir()

    def add(self, frame: Frame, room: float) -> None:
        """Write the photo of a frame if all photos then fit into so many bytes."""
        if frame.name in self.files:
            return
        data = _jpeg(self._store.load(frame))
        if self.size + len(data) <= room:
            name = _photo_file(len(self.files))
            (self._folder / name).write_bytes(data)
            self.files[frame.name] = name
            self.size += len(data)


def _jpeg(pixels: Pixels) -> bytes:
    from PIL import Image

    picture, file = Image.fromarray(pixels), io.BytesIO()
    picture.thumbnail((PHOTO_SIDE, PHOTO_SIDE))
    picture.save(file, "jpeg", quality=PHOTO_QUALITY)
    return file.getvalue()


def _script(file: str, gaussians: str) -> str:
    return f"viewer.receive({json.dumps(file)},{gaussians});\n"


def _size_of_rest(
    document: dict[str, Any], runs: Sequence[TrainedRun], periods: Sequence[int]
) -> int:
    """Return how many bytes a page takes at most without its Gaussians and photos."""
    # All photos have names, and each note is there.
    frames = [frame | {"photo": _photo_file(0)} for frame in document["frames"]]
    least = Reduction(degree=1, share=0.5)
    page = _page(document | {"frames": frames}, least, runs, periods, len(frames))
    return len(page.encode()) + sum(len(_script(run["file"], "")) for run in document["runs"])


def _photo_file(number: int) -> str:
    return f"photos/{number:05}.jpg"


def _page(
    document: dict[str, Any],
    reduction: Reduction,
    runs: Sequence[TrainedRun],
    periods: Sequence[int],
    missing: int,
) -> str:
    notes = []
    if str(reduction):
        notes.append(f"To keep the page small, it lacks {reduction}.")
    if missing:
        notes.append(f"To keep the page small, it lacks {counted(missing, 'photo')}.")
    names = joined(dict.fromkeys(run.spec.title for run in runs))
    data = json.dumps(document, ensure_ascii=False, separators=(",", ":"))
    return render_page(
        "run_page/index",
        title=runs[0].record.scene,
        subtitle=f"{names}, {len(periods)} periods" if len(periods) > 1 else names,
        scene=Markup(data.replace("<", "\\u003c")),  # No text can end the script
        scripts=SCRIPTS,
        notes=notes,
    )
