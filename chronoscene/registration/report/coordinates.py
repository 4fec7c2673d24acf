"""Cameras and points of a scene, and the control of a registration, in a reference system.

The scene itself stays in its local frame: it is small enough for float32, and its shapes are not
distorted by a map projection. Here every position is converted by itself, in float64.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, get_args

import numpy as np

from chronoscene.arrays import Array
from chronoscene.formats.shared.ply import write_vertices
from chronoscene.geodesy import Georeference, HeightKind, ReferenceSystem, from_crs
from chronoscene.io.documents import read_json_document
from chronoscene.io.laz import write_laz
from chronoscene.io.staging import replacing, write_text_atomic
from chronoscene.io.tables import csv_text
from chronoscene.registration.ties.residuals import PointResidual
from chronoscene.scene import Points, Scene
from chronoscene.scene.geometry import camera_centre

GEOREFERENCE = "georeference.json"
CAMERAS = "cameras.csv"
POINTS = "points.ply"
POINTS_LAZ = "points.laz"
CONTROL = "control.csv"

DECIMALS = 4
"""Decimals of coordinates in metres: a tenth of a millimetre."""


def local_frame(scene: Scene) -> Georeference | None:
    """Read the local frame of a scene that was registered, with its kind of heights.

    None for a world in another frame, or with an offset from this one.

    Raises:
        SceneError: If its ``georeference.json`` is damaged.
    """
    world, path = scene.world, scene.root / GEOREFERENCE
    frame = from_crs(world.crs) if world.unit == "metre" and not any(world.offset) else None
    if frame is None or not path.is_file():
        return frame
    kind = read_json_document(path).get("height_kind")
    return replace(frame, height_kind=kind) if kind in get_args(HeightKind) else frame


def write_coordinates(
    folder: Path, scene: Scene, frame: Georeference | None, output: ReferenceSystem | None
) -> None:
    """Write ``georeference.json`` and, in a reference system, tables of cameras and points.

    These are ``cameras.csv``, ``points.ply`` and, where laspy is installed, ``points.laz``.

    Args:
        folder: An existing folder.
        scene: Points that are not finite are left out.
        frame: Its local frame; nothing is written if it is unknown.
        output: Projected reference system.
    """
    if frame is None:
        return
    record = asdict(frame) | {"crs": frame.crs}
    if output is not None:
        points = scene.points.select(scene.points.finite)
        record["output"] = _linear(scene.frame_poses, points.xyz, frame, output)
        _write_cameras(folder / CAMERAS, scene, frame, output)
        _write_points(folder / POINTS, points, frame, output)
    write_text_atomic(folder / GEOREFERENCE, json.dumps(record, indent=1) + "\n")


def coordinate_files() -> tuple[str, ...]:
    """Return the names of the files that `write_coordinates` writes in a reference system."""
    laz = (POINTS_LAZ,) if find_spec("laspy") is not None else ()
    return (GEOREFERENCE, CAMERAS, POINTS, *laz)


def _linear(
    poses: Array, points: Array, frame: Georeference, output: ReferenceSystem
) -> dict[str, Any]:
    """Linear approximation of the reference system around the middle of the cameras.

    Coordinates are ``offset + matrix @ world``, up to ``largest_error`` metres at any camera or
    point of the model.
    """
    centres = camera_centre(poses)
    middle = np.median(centres, axis=0)[None]
    matrix = output.derivative(frame, middle)[0]
    offset = (output.from_local(frame, middle) - middle @ matrix.T)[0]
    places = np.concatenate([centres, points])
    error = output.from_local(frame, places) - places @ matrix.T - offset
    return {
        "crs": output.text,
        "offset": offset.tolist(),
        "matrix": matrix.tolist(),
        "largest_error": output.unit * float(np.linalg.norm(error, axis=1).max()),
    }


def _write_cameras(path: Path, scene: Scene, frame: Georeference, output: ReferenceSystem) -> None:
    centres = camera_centre(scene.frame_poses)
    places = output.from_local(frame, centres)
    axes = output.derivative(frame, centres)
    angles = omega_phi_kappa(scene.frame_poses[:, :3, :3], axes)
    rows = (
        (f.name, scene.periods[f.period].label, *_metres(place), *(f"{a:.6f}" for a in angle))
        for f, place, angle in zip(scene.frames, places, angles, strict=True)
    )
    head = ("image", "period", "E", "N", "h", "omega", "phi", "kappa")
    write_text_atomic(path, csv_text(head, rows))


def omega_phi_kappa(rotations: Array, axes: Array) -> Array:
    """Photogrammetric angles of cameras, in degrees.

    Rx(omega) Ry(phi) Rz(kappa) rotates the axes of the image (x right, y up, z backwards) to east,
    north and up of the reference system. All are 0 for a photo straight down with its top north.

    Args:
        rotations: Of ``cam_from_world``. [N, 3, 3]
        axes: Derivative of the coordinates by those of the world, at each camera. [N, 3, 3]

    Returns:
        [N, 3]
    """
    from scipy.spatial.transform import Rotation

    u, _, vt = np.linalg.svd(axes)  # without scale and shear
    turned = u @ vt @ np.swapaxes(rotations, 1, 2) @ np.diag([1.0, -1.0, -1.0])
    return np.asarray(Rotation.from_matrix(turned).as_euler("XYZ", degrees=True), np.float64)


def _write_points(path: Path, points: Points, frame: Georeference, output: ReferenceSystem) -> None:
    """Write coordinates of 64 bits: those of 32 bits are exact to half a metre only."""
    places = output.from_local(frame, points.xyz)
    with replacing(path) as partial:
        write_vertices(partial, places, points.rgb, comments=(f"crs {output.text}",))
    if find_spec("laspy") is not None and len(places):
        with replacing(path.with_name(POINTS_LAZ)) as partial:
            write_laz(partial, places, points.rgb, output.text, step=0.1**DECIMALS)


def write_control(path: Path, points: Sequence[PointResidual]) -> None:
    """Write the errors of all surveyed points."""
    head = (
        "point", "role", "used", "clicks", "periods", "E", "N", "h", "error_E", "error_N",
        "error_h", "click_consistency_px", "note",
    )  # fmt: skip
    rows = (
        (
            r.name, r.role, int(r.used), r.clicks, " ".join(r.periods),
            *(_metres(r.surveyed) if r.surveyed else [""] * 3),
            *(_metres(r.error) if r.error else [""] * 3),
            "" if r.click_consistency is None else f"{r.click_consistency:.3f}", r.note,
        )
        for r in points
        if r.role != "tie"
    )  # fmt: skip
    write_text_atomic(path, csv_text(head, rows))


def _metres(values: Iterable[float]) -> list[str]:
    return [f"{round(value, DECIMALS) + 0.0:.{DECIMALS}f}" for value in values]  # no -0.0000
