"""Additions to exported training sets for programs that do not read them as they are.

A function gets the folder of the training set, that of the output, and the config, and returns what
the program does with the scene that the user must know.
"""

from __future__ import annotations

import json
import shlex
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from baselines.external import CLNeRFConfig, FourDGaussiansConfig
from chronoscene.errors import ProgramError
from chronoscene.formats import read_scene
from chronoscene.methods import ProgramConfig
from chronoscene.scene import Frame, Scene
from chronoscene.scene.geometry import camera_centre

OFF_CENTRE = 0.5  # Pixels of the principal point from the centre that are reported

SAME_FOCAL = 1e-3  # Relative difference of focal lengths that is reported

EPOCH = 1000  # Steps of an epoch of CLNeRF

PUBLISHED_ITERATIONS = "40_000"
"""Iterations, and the ends of schedules, as the config file of ChronoGS writes them."""


def splatfacto(data: Path, output: Path, config: ProgramConfig) -> list[str]:
    """Write nothing; refuse scenes on which ``ns-render`` would fail after the training.

    It names images by what follows the folder that all test views have in common.
    """
    if len(read_scene(data, format="nerfstudio").select(split="test")) == 1:
        raise ProgramError(
            "ns-render",
            expected="at least two test views",
            found="one, which it cannot name",
            todo="hold out more (chronoscene split SCENE --scene-out NEW), and use NEW",
        )
    return []


def chronogs(data: Path, output: Path, config: ProgramConfig) -> list[str]:
    """``config.yaml`` with another number of iterations; growth ends at half of it."""
    file = Path(config.source, "config/chronogs.yaml")
    text = _read(file)
    if PUBLISHED_ITERATIONS not in text:
        raise ProgramError(
            file,
            expected=f"a config with {PUBLISHED_ITERATIONS} iterations",
            found="another one",
            todo="use the version of the program that docs/guides/other-programs.md names",
        )
    text = text.replace(PUBLISHED_ITERATIONS, str(config.iterations))
    text = text.replace("update_until: 20000", f"update_until: {config.iterations // 2}")
    (output / "config.yaml").write_text(text, encoding="utf-8")
    return _ignored(read_scene(data, format="chronoscene"))


def four_d_gaussians(data: Path, output: Path, config: FourDGaussiansConfig) -> list[str]:
    """The layout of Nerfies beside that of nerfstudio, and a config with the iterations.

    It is the one layout in which the loader takes the time of an image and the list of test images
    from files: with COLMAP models, every image has its own time, and every eighth is a test image.
    The folder for images of half size, which is the one it reads, holds those of full size: fields
    of view come from the sizes in the camera files.
    """
    scene = read_scene(data, format="nerfstudio")
    if len(sizes := {frame.camera.size for frame in scene.frames}) > 1:
        raise ProgramError(
            data,
            expected="images of one size, as the program takes the field of view from the first",
            found=", ".join(f"{width} x {height}" for width, height in sorted(sizes)),
            todo="use another program, or images of one camera",
        )
    stems = {frame.name: Path(frame.name).stem for frame in scene.frames}
    tests = [stems[frame.name] for frame in scene.select(split="test")]
    # Times are divided by the largest of them.
    times = {f.name: f.period if scene.num_periods > 1 else 1 for f in scene.frames}
    _write(data / "scene.json", {"scale": 1.0, "center": [0.0, 0.0, 0.0], "near": 0.0, "far": 1.0})
    _write(
        data / "dataset.json",
        {
            "ids": list(stems.values()),
            "train_ids": [stem for stem in stems.values() if stem not in tests],
            "val_ids": tests,
        },
    )
    metadata = {
        stems[n]: {"warp_id": t, "appearance_id": t, "camera_id": 0} for n, t in times.items()
    }
    _write(data / "metadata.json", metadata)
    (data / "camera").mkdir()
    (data / "rgb/2x").mkdir(parents=True)
    for frame in scene.frames:
        stem = stems[frame.name]
        _write(data / f"camera/{stem}.json", _nerfies_camera(frame))
        (data / f"rgb/2x/{stem}.png").hardlink_to(scene.image_path(frame))
    _write_cloud(data / "points3D_downsample2.ply", scene.points.xyz, scene.points.rgb)
    base = Path(config.source, config.arguments).absolute()
    _read(base)
    # Pictures of the training, which the options for own scenes ask for, take time and a font that
    # is sought in the working folder.
    (output / "config.py").write_text(
        f"_base_ = [{str(base)!r}]\nOptimizationParams = dict(iterations={config.iterations})\n"
        "ModelParams = dict(render_process=False)\n",
        encoding="utf-8",
    )
    ratios = [f.camera.K[1, 1] / f.camera.K[0, 0] - 1 for f in scene.frames]
    worst = max(ratios, key=abs)
    one = f"has one focal length per image, here {worst:+.1%} off in y"
    return [*_ignored(scene), *([one] if abs(worst) > SAME_FOCAL else [])]


def clnerf(data: Path, output: Path, config: CLNeRFConfig) -> list[str]:
    """A script that trains one period after the other, as those of the program do.

    The last period ends with images of the test views. Each one writes its weights under the same
    name, and the last are kept.
    """
    if config.iterations % EPOCH:
        raise ProgramError(
            "iterations",
            expected=f"a multiple of {EPOCH}, the steps of an epoch",
            found=str(config.iterations),
            todo="choose another number with --iterations",
        )
    script = Path(config.source, "train_ngpgv2_CLNerf.py").absolute()
    _read(script)
    periods, epochs = read_scene(data, format="wat").num_periods, config.iterations // EPOCH
    options = {
        "root_dir": data,
        "dataset_name": "colmap_ngpa_CLNerf",
        "exp_name": "run",
        "num_epochs": epochs,
        "batch_size": 8192,
        "lr": 1e-2,
        "rep_size": 10,
        "task_number": periods,
        "dim_a": 48,
        "scale": config.scale,
        "downsample": 1.0,
        "vocab_size": periods,
    }
    words = ["python", script, *chain(*((f"--{key}", value) for key, value in options.items()))]
    command = f"{shlex.join(map(str, words))} --task_curr $task"
    weights = f"ckpts/NGPGv2_CL/colmap_ngpa_CLNerf/run/epoch={epochs - 1}.ckpt"
    lines = ["set -e", f"for task in {' '.join(map(str, range(periods)))}; do"]
    lines += [f"  {command}", f"  mv {weights} model.ckpt", "done"]
    (output / "train.sh").write_text("\n".join([*lines, ""]), encoding="utf-8")
    each = f"trains {config.iterations} iterations for each of {periods} periods"
    return [f"{each}, one after the other", "has the images of test views in its training time"]


def _nerfies_camera(frame: Frame) -> dict[str, Any]:
    """A camera as Nerfies stores it: rotation from the world, centre, one focal length."""
    K = frame.camera.K
    return {
        "orientation": frame.cam_from_world[:3, :3].tolist(),
        "position": camera_centre(frame.cam_from_world).tolist(),
        "focal_length": K[0, 0].item(),
        "principal_point": K[:2, 2].tolist(),
        "skew": 0.0,
        "pixel_aspect_ratio": (K[1, 1] / K[0, 0]).item(),
        "radial_distortion": [0.0, 0.0, 0.0],
        "tangential_distortion": [0.0, 0.0],
        "image_size": list(frame.camera.size),
    }


def _write_cloud(path: Path, xyz: NDArray[np.float64], rgb: NDArray[np.uint8]) -> None:
    """A point cloud with normals, which the loader of 3DGS wants and nobody uses."""
    names = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    vertices = np.zeros(len(xyz), [(name, "u1" if i > 5 else "f4") for i, name in enumerate(names)])
    for i in range(3):
        vertices[names[i]], vertices[names[6 + i]] = xyz[:, i], rgb[:, i]
    PlyData([PlyElement.describe(vertices, "vertex")]).write(path)


def _ignored(scene: Scene) -> list[str]:
    """Describe what programs that derive from 3DGS ignore of the cameras."""
    offsets = [
        float(np.abs(f.camera.K[:2, 2] - np.divide(f.camera.size, 2)).max()) for f in scene.frames
    ]
    if max(offsets) <= OFF_CENTRE:
        return []
    return [
        f"ignores principal points, here up to {max(offsets):.1f} pixels off the centre: "
        "chronoscene undistort --center moves them there"
    ]


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ProgramError(
            path,
            expected="a file of the program",
            found=error.strerror or "an error",
            todo="name the folder of its source code with --set source=FOLDER",
        ) from error


def _write(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
