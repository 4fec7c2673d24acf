"""Clicked points instead of matches: two dates that no feature connects, in the whole command."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageOps

from benchmarks.registration.generated import pose_errors
from chronoscene.formats import read_scene
from chronoscene.registration.context import Context, Options
from chronoscene.registration.features.correspondences import Matched
from chronoscene.registration.output import Inspection
from chronoscene.registration.photos.captures import Captures, read_captures
from chronoscene.registration.photos.gps_priors import locate
from chronoscene.registration.photos.inputs import PhotoInputs
from chronoscene.registration.pipeline import run
from chronoscene.registration.reconstruct.estimation import estimate, refined
from chronoscene.registration.reconstruct.models import known_images
from chronoscene.registration.result import Registered
from chronoscene.registration.ties.tie_alignment import TieAlignment, align_with_tie_points, tie
from chronoscene.registration.ties.tie_points import read_tie_points
from chronoscene.registration.work_folder import Stages, work_folder
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


def assert_placed_by_clicks(model: Registered, truth: Mapping[str, np.ndarray]) -> None:
    """The second period lies where the precision of the clicks puts it."""
    poses = np.stack([truth[name] for name in model.names])
    rotation, centre = pose_errors(model.cam_from_world, poses, model.periods == 0)
    extent = np.linalg.norm(np.ptp(camera_centre(poses), axis=0))
    second = model.periods == 1
    assert np.median(rotation[second]) < 0.2
    assert np.median(centre[second]) < 0.003 * extent


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
    assert (model.periods == 1).sum() >= 9
    assert_placed_by_clicks(model, {name: known[Path(name).name] for name in model.names})


def write_projections(case: Any, path: Path, count: int, *, control: bool = False) -> None:
    """Points near the middle of a case, each clicked in three images of either period."""
    rng = np.random.default_rng(4)
    model = known_images(case.database)  # its cameras end with it
    cameras = {str(i.name): i.camera for i in model.images.values()}
    lines = ["point,image,x,y" + ",X,Y,Z,sX,sY,sZ" * control + "\n"]
    for i, xyz in enumerate(rng.uniform(-1, 1, (count, 3))):
        world = "".join(f",{v:.5f}" for v in xyz) + 3 * ",0.001" if control else ""
        for period in (0, 1):
            for name in [n for n, p in sorted(case.periods.items()) if p == period][i % 2 :: 3]:
                local = case.truth[name][:3, :3] @ xyz + case.truth[name][:3, 3]
                x, y = cameras[name].img_from_cam(local) + rng.normal(0, CLICK_PIXELS, 2)
                lines.append(f"p{i},{name},{x:.2f},{y:.2f}{world}\n")
    path.write_text("".join(lines))


def tied(case: Any, clicks: Path) -> tuple[Registered, TieAlignment]:
    """All that comes after matching, on given matches instead of photos: before and after ties."""
    inputs = PhotoInputs(
        captures=Captures(case.folder, (), (), (), ()), scene=None, images=(), periods=case.periods,
        labels=LABELS, dates=LABELS, refused={}, positions=locate(()), georeference=None,
    )  # fmt: skip
    nothing = np.zeros(0, np.int64)
    np.savez(
        case.folder / "held_out.npz",
        names=np.frombuffer(b"{}", np.uint8), track=nothing, image=nothing, xy=np.zeros((0, 2)),
    )  # fmt: skip
    (case.folder / "lock").touch()
    with work_folder(case.folder) as lock:
        options = Options(threads=1, tie_points=clicks)
        context = Context(case.folder, Stages(case.folder), options, None, lock)
        first = estimate(inputs, Matched({}, {}, {}, {}), context)
        result = tie(
            first,
            read_tie_points(clicks),
            lambda arguments: refined(first, arguments, inputs, context),
        )
    return first, result


def test_clicks_place_a_period_that_nothing_matches(
    make_case: Callable[..., Any], tmp_path: Path
) -> None:
    case = make_case(cross_matches=0.0)
    clicks = tmp_path / "clicks.csv"
    write_projections(case, clicks, 12)
    first, result = tied(case, clicks)
    assert len({case.periods[name] for name in first.unplaced}) == 1
    model = result.model
    assert result.replaced and len(model.names) == len(case.truth)
    linking = np.array(
        [len(set(model.periods[image])) for image in np.split(model.track_image, model.track_start)]
    )
    assert (linking == 2).sum() == 12  # the adjustment had the clicked points
    assert_placed_by_clicks(model, case.truth)


def test_control_is_adjusted_with(make_case: Callable[..., Any], tmp_path: Path) -> None:
    """Cameras lie where they are in the world, nearer than the similarity alone puts them."""
    case = make_case(points=100, noise=1.0)
    clicks = tmp_path / "control.csv"
    write_projections(case, clicks, 8, control=True)
    first, result = tied(case, clicks)
    assert result.controlled and not result.replaced
    moved = align_with_tie_points(first, read_tie_points(clicks)).model

    def error(model: Registered) -> float:
        truth = np.stack([case.truth[name] for name in model.names])
        gaps = camera_centre(model.cam_from_world) - camera_centre(truth)
        return float(np.sqrt(np.mean(gaps**2)))

    assert error(result.model) < 0.8 * error(moved)
    assert all(r.used and r.error is not None for r in result.residuals)
    assert any("8 control points" in remark for remark in result.remarks)
