"""A scene to look around in: one HTML file that needs nothing else, with a switch per period."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.figures import canvas
from chronoscene.figures.cloud import Cloud, cloud_of, shown_box
from chronoscene.io.pages import render_page
from chronoscene.io.staging import write_text_atomic
from chronoscene.scene import Scene

MAX_POINTS = 300_000
"""In a page, so that it opens at once and turns smoothly: of more, a random choice, the same for
equal scenes. The page says how many there are."""
ELEVATION = np.deg2rad(35.0)  # Of the first view above the plane of the scene


def write_page(scene: Scene, path: Path) -> None:
    """Write the page of a scene, an HTML file."""
    write_text_atomic(path, page_of(cloud_of(scene), scene.points.rgb))


def page_of(cloud: Cloud, rgb: NDArray[np.uint8]) -> str:
    """Make the page of points with colours ``rgb``. [P, 3]"""
    data = json.dumps(_page_data(cloud, rgb), ensure_ascii=False)
    # No text can end the script: JSON has "<" inside of strings only.
    page = render_page("viewer/page", title=cloud.name, data=Markup(data.replace("<", "\\u003c")))
    return page + "\n"


def _page_data(cloud: Cloud, rgb: NDArray[np.uint8]) -> dict[str, Any]:
    """Collect the data of the script. Coordinates are relative to the middle of the scene."""
    group, colors = cloud.groups()
    labels = [*cloud.labels, canvas.UNSEEN][: len(colors)]
    good = np.flatnonzero(np.isfinite(cloud.xyz).all(axis=1))
    shown = np.random.default_rng(0).permutation(good)[:MAX_POINTS]
    # By period, in random order within: any first part of a period stands for all of it.
    shown = shown[np.argsort(group[shown], kind="stable")]
    box = shown_box(cloud, cameras=False)
    middle = (box.low + box.high) / 2
    members = group[good], group[shown], cloud.camera_period
    numbers = np.transpose([np.bincount(each, minlength=len(colors)) for each in members])
    periods = zip(labels, colors, numbers.tolist(), strict=True)
    return {
        "name": cloud.name,
        "unit": "m" if cloud.unit == "metre" else "",
        "half": (box.edges / 2).tolist(),
        "home": home_view(cloud, middle).tolist(),
        "dates": len(cloud.labels),
        "periods": [
            {"label": label, "color": color, "points": points, "shown": part, "cameras": cameras}
            for label, color, (points, part, cameras) in periods
        ],
        "points": len(good),
        "left_out": len(cloud.xyz) - len(good),
        "xyz": _base64((cloud.xyz[shown] - middle).astype("<f4")),
        "rgb": _base64(rgb[shown]),
        "centres": _base64((cloud.centres - middle).astype("<f4")),
        "directions": _base64(cloud.directions.astype("<f4")),
        "camera_period": cloud.camera_period.tolist(),
    }


def _base64(array: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def home_view(cloud: Cloud, middle: Array) -> Array:
    """Find the axes of the first view, right, up and towards the viewer: from above. [3, 3]

    Models need not know what is up. It is taken as the direction in which the points spread
    least, towards the cameras: right for anything that stands on the ground.
    """
    up = np.array([0.0, 0.0, 1.0])
    box = shown_box(cloud, cameras=False)
    inside = ((cloud.xyz >= box.low) & (cloud.xyz <= box.high)).all(axis=1)
    if inside.sum() > 2:
        _, axes = np.linalg.eigh(np.cov(cloud.xyz[inside].T))
        above = (np.median(cloud.centres, axis=0) - middle) @ axes[:, 0] >= 0
        up = axes[:, 0] if above else -axes[:, 0]
    # Where the cameras look to, or what is on top in their images if they look straight down.
    choices = [cloud.directions.mean(axis=0), cloud.tops.mean(axis=0)]
    flat = [choice - (choice @ up) * up for choice in choices]
    ahead = max(flat, key=lambda v: float(v @ v))
    if np.linalg.norm(ahead) < 0.1:  # cameras turned in all directions
        ahead = np.eye(3)[np.argmin(np.abs(up))]
        ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    back = np.sin(ELEVATION) * up - np.cos(ELEVATION) * ahead
    right = np.cross(ahead, up)
    return np.stack([right, np.cross(back, right), back])
