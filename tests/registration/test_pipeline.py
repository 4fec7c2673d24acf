"""The whole command on small generated photos of two dates."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.registration.generated import pose_errors
from chronoscene.cli.scenes.register import summary
from chronoscene.errors import RegistrationError, SceneError
from chronoscene.formats import read_scene
from chronoscene.registration.context import Options
from chronoscene.registration.photos.captures import read_captures
from chronoscene.registration.pipeline import log_text, run
from chronoscene.registration.quality.rays import cross_matches
from chronoscene.registration.result import Registered
from chronoscene.scene import Scene
from chronoscene.scene.geometry import camera_centre
from chronoscene.validation.run import validate_scene

OPTIONS = Options(threads=1, max_features=3000)

SAME = ("--threads", "1", "--max-features", "3000")
"""The same for the command line."""

COMMAND = "from chronoscene.cli import main; main()"


@pytest.fixture(scope="module")
def captures(truth: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of photos for each period, and some that are of no use."""
    root = tmp_path_factory.mktemp("captures")
    for frame in truth.frames:
        target = root / ("2016", "2023")[frame.period] / frame.name
        target.parent.mkdir(exist_ok=True)
        shutil.copyfile(truth.image_path(frame), target)
    first = sorted((root / "2016").iterdir())[0]
    shutil.copyfile(first, root / "2023" / "copy of 2016.jpg")
    (root / "2023" / "cut.jpg").write_bytes(first.read_bytes()[:5000])
    Image.new("RGB", (400, 300), (128, 128, 128)).save(root / "2023" / "grey.jpg")
    return root


@pytest.fixture(scope="module")
def joint(captures: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Registered]:
    out = tmp_path_factory.mktemp("joint") / "scene"
    return out, run(read_captures(captures), out, OPTIONS)


def errors(scene: Scene, truth: Scene, reference: int) -> tuple[float, float]:
    """Median rotation (degrees) and centre error (share of the extent) of the other period."""
    known = {f.name: f.cam_from_world for f in truth.frames}
    found = {Path(f.name).name: f.cam_from_world for f in scene.frames}
    names = sorted(found.keys() & known)
    fitted = np.array([name.startswith(f"p{reference}") for name in names])
    poses, right = (np.stack([d[name] for name in names]) for d in (found, known))
    angles, distances = pose_errors(poses, right, fitted)
    extent = np.linalg.norm(np.ptp(camera_centre(np.stack(list(known.values()))), axis=0))
    return float(np.median(angles[~fitted])), float(np.median(distances[~fitted]) / extent)


def test_a_scene_comes_out(joint: tuple[Path, Registered], truth: Scene) -> None:
    out, registered = joint
    scene = read_scene(out)
    assert [p.label for p in scene.periods] == ["2016", "2023"]
    assert len(scene.frames) == len(registered.names) >= len(truth.frames) - 2
    assert all(f.camera.model == "PINHOLE" for f in scene.frames)
    assert {f.period for f in scene.frames if f.split == "test"} == {0, 1}
    degrees, share = errors(scene, truth, 0)
    assert degrees < 0.5  # photos of 400 x 300 pixels, whose focal length is not known
    assert share < 0.01
    assert not [f for f in validate_scene(out).findings if f.severity == "error"]


def test_every_photo_that_is_missing_has_a_reason(joint: tuple[Path, Registered]) -> None:
    out, registered = joint
    reasons = registered.unregistered
    assert reasons["2023/copy of 2016.jpg"].startswith("the same file as 2016/")
    assert reasons["2023/cut.jpg"].startswith("cannot be decoded")
    assert "features: blurred" in reasons["2023/grey.jpg"]
    assert {registered.unregistered_periods[n] for n in reasons} == {1}
    log = json.loads((out / "registration_log.json").read_text())
    assert {u["image"] for u in log["unregistered"]} == set(reasons)
    certificate = json.loads((out / "registration.json").read_text())
    counted = [[(p["photos"], p["registered"]) for p in f["periods"]] for f in (log, certificate)]
    assert counted[0] == counted[1]
    stages = [s["stage"] for s in log["stages"]]
    assert stages.index("features") < stages.index("matches") < stages.index("joint")
    remarks = log["stages"][stages.index("matches")]["remarks"]
    assert any(r.startswith("periods 2016 and 2023: ") for r in remarks)


def test_the_result_hangs_together(joint: tuple[Path, Registered]) -> None:
    _, registered = joint
    assert registered.route == "joint"
    assert registered.unit == "unknown"
    assert np.isnan(registered.gps_enu).all()
    assert registered.track_start[-1] == len(registered.track_image) == len(registered.track_xy)
    assert registered.track_image.max() < len(registered.names)
    tracks = registered.held_out_tracks
    assert len(tracks.start) > 5
    assert tracks.start[-1] == len(tracks.image) == len(tracks.xy)
    for a, b in cross_matches(tracks, registered.periods):
        earlier, later = registered.periods[tracks.image[a]], registered.periods[tracks.image[b]]
        assert len(a) == len(b) > 0 and (earlier < later).all()


def test_held_out_tracks_are_not_points_of_the_model(joint: tuple[Path, Registered]) -> None:
    _, registered = joint
    tracks = registered.held_out_tracks
    held = set(zip(tracks.image.tolist(), *tracks.xy.round(3).T.tolist(), strict=True))
    xy = registered.track_xy.round(3)
    used = set(zip(registered.track_image.tolist(), *xy.T.tolist(), strict=True))
    assert len(held) > 10
    assert not held & used


@pytest.mark.slow
def test_features_of_a_database_are_used_and_named(
    joint: tuple[Path, Registered], captures: Path, truth: Scene, tmp_path: Path
) -> None:
    database = shutil.copy(joint[0].with_name("scene.work") / "features.db", tmp_path)
    options = Options(threads=1, features=str(database), max_features=100)  # were SIFT extracted
    registered = run(read_captures(captures), tmp_path / "out", options)
    assert len(registered.names) == len(joint[1].names)
    assert len(registered.points) > 0.8 * len(joint[1].points)
    assert max(errors(read_scene(tmp_path / "out"), truth, 0)) < 0.5
    certificate = json.loads((tmp_path / "out/registration.json").read_text())
    assert certificate["features"].startswith("features of features.db (COLMAP, SHA-256 ")


@pytest.mark.slow
def test_route_separate(
    joint: tuple[Path, Registered], captures: Path, truth: Scene, tmp_path: Path
) -> None:
    work = tmp_path / "work"
    shutil.copytree(joint[0].with_name("scene.work"), work, symlinks=True)
    reported: list[str] = []
    registered = run(
        read_captures(captures),
        tmp_path / "out",
        Options(threads=1, max_features=3000, route="separate", work=work),
        report=lambda what, done, total: reported.append(what),
    )
    assert "features" not in reported  # found in the work folder
    assert registered.route == "separate"
    scene = read_scene(tmp_path / "out")
    degrees, share = errors(scene, truth, 0)
    assert degrees < 1.0
    assert share < 0.02


@pytest.mark.slow
def test_a_new_period_leaves_the_old_poses_to_the_last_bit(
    joint: tuple[Path, Registered], captures: Path, truth: Scene, tmp_path: Path
) -> None:
    base = tmp_path / "base"
    shutil.copytree(captures / "2016", tmp_path / "first" / "2016")
    masked = f"2016/{truth.frames[0].name}"
    mask = np.full((300, 400), 255, np.uint8)
    mask[250:] = 0
    (tmp_path / "masks/2016").mkdir(parents=True)
    Image.fromarray(mask).save(tmp_path / f"masks/{masked}.png")
    run(read_captures(tmp_path / "first"), base, OPTIONS)
    old = read_scene(base)
    webp = old.image_path(old.frames[-1])  # which COLMAP does not read
    pixels = np.asarray(Image.open(webp))
    Image.fromarray(pixels).save(webp, format="WEBP", lossless=True)
    out = tmp_path / "grown"
    registered = run(read_captures(captures / "2023"), out, OPTIONS, into=old)
    assert registered.route == "frozen"
    new = read_scene(out)
    assert new.num_periods == 2
    frames = {f.name: f for f in new.frames}
    for frame in old.frames:
        same = frames[frame.name]
        assert same.cam_from_world.tobytes() == frame.cam_from_world.tobytes()
        assert same.camera == frame.camera
        assert (same.image_id, same.period, same.split) == (frame.image_id, 0, frame.split)
        if frame is not old.frames[-1]:
            assert new.image_path(same).read_bytes() == old.image_path(frame).read_bytes()
    assert (np.asarray(Image.open(new.image_path(same))) == pixels).all()
    assert list(old.masks) == list(new.masks) == [masked]
    assert new.masks[masked].read_bytes() == old.masks[masked].read_bytes()
    index = [f.name for f in old.frames].index(masked)
    seen = old.points.track_xy[old.points.track_frame == index]
    assert len(seen) > 10 and seen[:, 1].max() < 260  # undistorted since
    kept = np.isin(new.points.ids, old.points.ids)
    assert new.points.xyz[kept].tobytes() == old.points.xyz.tobytes()
    assert len(new.points) > len(old.points)
    assert (new.point_periods().sum(axis=1) == 2).sum() > 10
    assert sum(f.period == 1 for f in new.frames) >= 5
    degrees, share = errors(new, truth, 0)
    assert degrees < 1.0
    assert share < 0.02
    log = json.loads((out / "registration_log.json").read_text())
    remarks = [remark for stage in log["stages"] for remark in stage["remarks"]]
    (again,) = (r for r in remarks if r.startswith("2023/copy_of_2016.jpg"))
    assert again.endswith("are they the same photo?")
    assert f"note: {again}\n" in summary(registered, out, None)
    assert not [f for f in validate_scene(out).findings if f.severity == "error"]


def test_names_of_folders_that_are_not_utf_8() -> None:
    log = {"work": os.fsdecode(b"/tmp/\xff.work"), "label": "été"}
    text = log_text(log)
    assert json.loads(text.encode()) == log and "été" in text


def started(arguments: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", COMMAND, "register", *arguments, *SAME],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def check_finished(out: Path, uninterrupted: Path) -> set[str]:
    """The stages that were not done again; the model is that of an uninterrupted run."""
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        path = Path("sparse/0") / name
        assert (out / path).read_bytes() == (uninterrupted / path).read_bytes()
    stages = json.loads((out / "registration_log.json").read_text())["stages"]
    return {s["stage"] for s in stages if s["from_an_earlier_run"]}


@pytest.mark.slow
def test_a_killed_command_goes_on(
    joint: tuple[Path, Registered], captures: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    process = started([str(captures), str(out)])
    assert process.stderr is not None
    assert any(line.startswith("pairs") for line in process.stderr)
    process.kill()
    process.wait()
    assert not out.exists()
    again = started([str(captures), str(out)])
    assert again.wait() == 0, again.stderr and again.stderr.read()
    assert "features" in check_finished(out, joint[0])


@pytest.mark.slow
def test_a_command_killed_again_and_again_ends_as_if_nothing_had_been(
    joint: tuple[Path, Registered], captures: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    random = np.random.default_rng(0)
    kills = 0
    while not out.exists():  # a kill may also come between the result and the end
        process = started([str(captures), str(out)])
        try:
            # The time grows, or a stage that takes longer would never end.
            _, errors = process.communicate(timeout=random.uniform(0.3, 0.6) * 1.12**kills)
            assert process.returncode == 0, errors
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            kills += 1
    assert kills >= 3  # the first three come within two seconds, on any machine
    check_finished(out, joint[0])


def test_a_place_in_use_is_refused(captures: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SceneError, match="found one that is not empty"):
        run(read_captures(captures), tmp_path, OPTIONS)


def test_one_photo_is_refused(truth: Scene, tmp_path: Path) -> None:
    folder = tmp_path / "one"
    folder.mkdir()
    shutil.copyfile(truth.image_path(truth.frames[0]), folder / "a.jpg")
    with pytest.raises(RegistrationError, match="at least two photos, found 1"):
        run(read_captures(folder), tmp_path / "out", OPTIONS)


def test_photos_that_show_nothing_are_refused_and_work_is_kept(tmp_path: Path) -> None:
    folder = tmp_path / "noise"
    folder.mkdir()
    for i in range(3):
        pixels = np.random.default_rng(i).integers(0, 256, (120, 160, 3), np.uint8)
        Image.fromarray(pixels).save(folder / f"{i}.png")
    with pytest.raises(RegistrationError, match="found no pair of photos") as caught:
        run(read_captures(folder), tmp_path / "out", OPTIONS)
    assert caught.value.__notes__[0].startswith(f"{tmp_path / 'out.work'} was kept: ")
    assert (tmp_path / "out.work" / "stage-matches.json").is_file()
    assert not (tmp_path / "out").exists()
