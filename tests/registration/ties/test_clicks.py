"""Clicked points instead of matches: two dates that no feature connects, in the whole command."""

from pathlib import Path

import numpy as np
import pytest
from generated_registrations import pose_errors
from PIL import Image, ImageOps

from chronoscene.formats import read_scene
from chronoscene.registration.output import Inspection
from chronoscene.registration.photos.captures import read_captures
from chronoscene.registration.pipeline import Options, run
from chronoscene.registration.result import Registered
from chronoscene.scene import Scene
from chronoscene.scene.geometry import camera_centre
from chronoscene.synth import SynthSettings, generate

LABELS = ("2016", "2023")

SETTINGS = SynthSettings(
    periods=2, width=640, height=480, views=14, points=1000, blocks=2, supersample=1, seed=5
)

CLICK_PIXELS = 0.7
"""Standard deviation of a click."""


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Large enough for either date to hold together by itself."""
    folder = tmp_path_factory.mktemp("generated") / "scene"
    generate(folder, SETTINGS)
    return read_scene(folder)


@pytest.fixture(scope="module")
def negatives(truth: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The second date comes as negatives: SIFT matches them with each other, but not across."""
    root = tmp_path_factory.mktemp("negatives")
    for frame in truth.frames:
        target = root / LABELS[frame.period] / frame.name
        target.parent.mkdir(exist_ok=True)
        with Image.open(truth.image_path(frame)) as image:
            picture = ImageOps.invert(image.convert("RGB")) if frame.period else image
            picture.save(target, quality=95)
    return root


def write_clicks(truth: Scene, path: Path, count: int) -> None:
    """Points that both dates see, each clicked in three images of either date."""
    rng = np.random.default_rng(4)
    points = truth.points
    periods = np.array([f.period for f in truth.frames])
    lines = []
    for i in rng.permutation(len(points)):
        rows = np.arange(points.track_start[i], points.track_start[i + 1])
        seen = periods[points.track_frame[rows]]
        if min((seen == 0).sum(), (seen == 1).sum()) < 3:
            continue
        for period in (0, 1):
            for row in rows[seen == period][:3]:
                x, y = points.track_xy[row] + rng.normal(0, CLICK_PIXELS, 2)
                name = f"{LABELS[period]}/{truth.frames[points.track_frame[row]].name}"
                lines.append(f"p{i},{name},{x:.2f},{y:.2f}\n")
        count -= 1
        if not count:
            break
    assert not count
    path.write_text("point,image,x,y\n" + "".join(lines))


def placed(root: Path, out: Path, clicks: Path | None) -> tuple[Registered, str]:
    options = Options(
        threads=1, max_features=3000, tie_points=clicks, work=root.parent / "work", overwrite=True
    )
    found: list[Inspection] = []
    model = run(read_captures(root), out, options, inspected=found.append)
    return model, found[0].verdict.level


@pytest.mark.slow
def test_clicks_replace_an_alignment_that_failed(
    truth: Scene, negatives: Path, tmp_path: Path
) -> None:
    model, verdict = placed(negatives, tmp_path / "out", None)
    assert verdict == "fail"
    assert len(set(model.periods)) == 1  # nothing places the other
    clicks = tmp_path / "clicks.csv"
    write_clicks(truth, clicks, 12)
    model, verdict = placed(negatives, tmp_path / "out", clicks)
    assert verdict != "pass"  # clicks took part in the estimation: nothing proves it
    assert len(model.names) >= len(truth.frames) - 3
    known = {f.name: f.cam_from_world for f in truth.frames}
    poses = np.stack([known[Path(name).name] for name in model.names])
    rotation, centre = pose_errors(model.cam_from_world, poses, model.periods == 0)
    extent = np.linalg.norm(np.ptp(camera_centre(poses), axis=0))
    second = model.periods == 1
    assert second.sum() >= 9
    assert np.median(rotation[second]) < 0.2
    assert np.median(centre[second]) < 0.003 * extent
