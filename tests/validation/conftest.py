"""A small good scene, copied for each test, and the means to break it."""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from chronoscene.colmap.model import read_reconstruction
from chronoscene.scene.geometry import look_at, quaternion_from_rotation, rotation_from_quaternion
from chronoscene.validation.rule import SceneReport
from chronoscene.validation.run import validate_scene

PERIODS = {f"{'ab'[period]}{i:03d}.png": period for period in (0, 1) for i in range(9)}
"""Image name to period."""

TESTS = ("a003.png", "a007.png", "a008.png", "b003.png", "b007.png", "b008.png")
"""Three of each period, and six to train on, so that rules on small numbers say nothing."""

WIDTH, HEIGHT = 64, 48
POINTS = 40

Change = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""World-to-camera rotation and translation to others."""

USUAL = frozenset({"CS507"})
"""Remarks on the good scene itself."""


class SceneFolder:
    """A scene to break: lines of its text files are edited, then it is validated."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def path(self, place: str) -> Path:
        return self.root / place

    def lines(self, place: str) -> list[str]:
        return self.path(place).read_text().splitlines()

    def write(self, place: str, text: str | bytes | Iterable[str]) -> None:
        self.path(place).parent.mkdir(parents=True, exist_ok=True)
        if isinstance(text, bytes):
            self.path(place).write_bytes(text)
        elif isinstance(text, str):
            self.path(place).write_text(text)
        else:
            self.path(place).write_text("".join(f"{line}\n" for line in text))

    def replace(self, place: str, old: str, new: str, *, count: int = -1) -> None:
        """Replace text in a file; it must be there."""
        text = self.path(place).read_text()
        assert old in text, f"{old!r} not in {place}"
        self.path(place).write_text(text.replace(old, new, count))

    def edit_fields(self, place: str, row: int, fields: dict[int, str]) -> None:
        """Replace fields of a line by their index."""
        lines = self.lines(place)
        words = lines[row].split()
        for i, text in fields.items():
            words[i] = text
        lines[row] = " ".join(words)
        self.write(place, lines)

    def set_track(self, row, track):
        """Replace the track of a point, in the points and in the images."""
        words = self.lines("sparse/0/points3D.txt")[row].split()
        point_id = words[0]
        old = {(int(i), int(k)) for i, k in zip(words[8::2], words[9::2], strict=True)}
        lines = self.lines("sparse/0/points3D.txt")
        lines[row] = " ".join(words[:8] + [f"{i} {k}" for i, k in track])
        self.write("sparse/0/points3D.txt", lines)
        images = self.lines("sparse/0/images.txt")
        for image_id, keypoint in old - set(track):
            keypoints = images[2 * image_id - 1].split()
            assert keypoints[3 * keypoint + 2] == point_id
            keypoints[3 * keypoint + 2] = "-1"
            images[2 * image_id - 1] = " ".join(keypoints)
        self.write("sparse/0/images.txt", images)

    def keep_images(self, rows, kept):
        """Let the points of some rows be seen by some images (ids) only."""
        for row in rows:
            self.set_track(row, [(i, row) for i in kept])

    def change_poses(self, change: Change, rows: Iterable[int]) -> None:
        """Apply a function of rotation and translation to the poses of some images."""
        lines = self.lines("sparse/0/images.txt")
        for row in rows:
            words = lines[2 * row].split()
            rotation = rotation_from_quaternion([float(w) for w in words[1:5]])
            rotation, translation = change(rotation, np.array([float(w) for w in words[5:8]]))
            pose = [*quaternion_from_rotation(rotation), *translation]
            lines[2 * row] = " ".join([words[0], *(f"{x:.17g}" for x in pose), *words[8:]])
        self.write("sparse/0/images.txt", lines)

    def save(self, name: str, image: Image.Image, *, as_name: str | None = None, **options) -> None:
        """Give an image other content, and perhaps another name everywhere."""
        self.path(f"images/{name}").unlink()
        image.save(self.path(f"images/{as_name or name}"), **options)
        if as_name is not None:
            for place in ("sparse/0/images.txt", "sparse/split.txt"):
                self.replace(place, name, as_name)

    def to_binary(self, *, classic: bool = True) -> None:
        """Turn the text model into a binary one, with the three classic files or all five."""
        folder = self.path("sparse/0")
        reconstruction = read_reconstruction(folder)
        for stem in ("cameras", "images", "points3D"):
            (folder / f"{stem}.txt").unlink()
        reconstruction.write_binary(str(folder))
        if classic:
            (folder / "rigs.bin").unlink()
            (folder / "frames.bin").unlink()

    def validate(self, *, decode: bool = False) -> SceneReport:
        return validate_scene(self.root, decode=decode)

    def expect(
        self,
        code: str,
        *,
        place: str = "",
        found: str = "",
        also: Iterable[str] = (),
        decode: bool = False,
        times: int = 1,
    ) -> SceneReport:
        """The rule speaks ``times`` times, once with this place and finding; no other rule does."""
        report = self.validate(decode=decode)
        spoken = [f for f in report.findings if f.code == code]
        listed = "\n".join(f"{f.code} {f}" for f in report.findings)
        assert any(place in f.place and found in f.found for f in spoken), listed
        assert len(spoken) == times, listed
        assert {f.code for f in report.findings} - USUAL - {code} == set(also), listed
        return report


def good_scene(root: Path) -> None:
    """Cameras on an arc around points, exact observations, a text model."""
    rng = np.random.default_rng(5)
    xyz = rng.uniform(-0.8, 0.8, (POINTS, 3))
    K = np.array([[50.0, 0, WIDTH / 2], [0, 50.0, HEIGHT / 2], [0, 0, 1]])
    (root / "sparse/0").mkdir(parents=True)
    (root / "images").mkdir()
    images = []
    for i, name in enumerate(PERIODS):
        angle, distance = np.deg2rad(20 * i), 4.0 + 0.1 * i
        centre = distance * np.array([np.cos(angle), 0.2, np.sin(angle)])
        pose = look_at(centre, np.zeros(3), up=np.array([0.0, 1.0, 0.0]))
        rotation, translation = pose[:3, :3], pose[:3, 3]
        uvw = (xyz @ rotation.T + translation) @ K.T
        xy = uvw[:, :2] / uvw[:, 2:]
        q = quaternion_from_rotation(rotation)
        images.append(f"{i + 1} {numbers(q)} {numbers(translation)} 1 {name}")
        images.append(" ".join(f"{numbers(p)} {j + 1}" for j, p in enumerate(xy)))
        pixels = rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
        Image.fromarray(pixels).save(root / "images" / name)
    track = [" ".join(f"{i + 1} {j}" for i in range(len(PERIODS))) for j in range(POINTS)]
    points = [f"{j + 1} {numbers(xyz[j])} 10 20 30 0.5 {track[j]}" for j in range(POINTS)]
    texts = {
        "sparse/0/cameras.txt": [f"1 PINHOLE {WIDTH} {HEIGHT} 50 50 {WIDTH / 2} {HEIGHT / 2}"],
        "sparse/0/images.txt": images,
        "sparse/0/points3D.txt": points,
        "sparse/split.txt": [f"{name} {period}" for name, period in PERIODS.items()],
        "sparse/0/test.txt": list(TESTS),
    }
    for place, lines in texts.items():
        (root / place).write_text("".join(f"{line}\n" for line in lines))


def numbers(values: Iterable[float]) -> str:
    return " ".join(f"{float(x):.17g}" for x in values)


@pytest.fixture(scope="session")
def good_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("good") / "scene"
    good_scene(root)
    return root


@pytest.fixture
def scene(good_folder: Path, tmp_path: Path) -> SceneFolder:
    """A copy of the good scene, to be broken."""
    return SceneFolder(shutil.copytree(good_folder, tmp_path / "scene"))


@pytest.fixture
def make_scene(make_scene_folder: Callable[..., Path]) -> Callable[..., SceneFolder]:
    """Factory of scenes of other sizes, made by COLMAP's generator."""
    return lambda *args, **options: SceneFolder(make_scene_folder(*args, **options))
