"""CS231: photos that are not those that the model was made from, judged by their colours.

A point of the model has the mean colour of the pixels that see it. In the right photo, the
brightness of the pixels correlates with that of the points; in another or a rotated photo, it does
not.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.io.wording import quote, shown
from chronoscene.scene.grouping import grouped
from chronoscene.validation import rule
from chronoscene.validation.folder.pixels import Pixels
from chronoscene.validation.folder.scene_folder import RawScene
from chronoscene.validation.rule import Hit

Greys = Mapping[str, NDArray[np.uint8]]

MIN_CORRELATION, USUAL = 0.35, 0.5
"""Correlations of brightness between points and pixels: below the first, a photo is a different
one, if at least a quarter of the photos of the scene are above the second. Measured over photos and
renders, also of different seasons and at dusk: 0.44 to 0.98 for the right photo, with a median over
a scene of 0.72 and more; 0.5 and less for a wrong one, with a median of 0.1."""

MAX_TRIED = 12  # Images whose photo is looked for among all photos if hardly any photo fits

OF_USUAL = 0.4
"""A wrong photo is also below this share of the median of its period: where everything was rebuilt
and little registered, points have the colours of another period. Measured: a median of 0.51, a
minimum of 0.23."""

MAX_WRONG = 0.5  # Share of the photos of a period beyond which the whole period is reported
MIN_OBSERVATIONS = 30  # Observations of an image from which their correlation is meaningful
LUMA = (0.299, 0.587, 0.114)  # Weights of red, green and blue in brightness (ITU-R BT.601)


@rule.warning(
    "CS231",
    bad="`a.jpg` and `b.jpg` with each other's names; a photo rotated by 180 degrees",
    remedy="look at the photo; copy the one that the model was made from",
    needs=("observations",),
)
def image_other_photo(scene: RawScene, pixels: dict[str, Pixels]) -> Iterator[Hit]:
    """A photo does not show the points that it should see: it is a different photo, or it was
    rotated after the model was made (needs `--decode`)."""
    assert scene.images is not None
    greys = {n: p.grey for n, p in pixels.items() if p.grey is not None}
    names = scene.images.names
    fits = {
        names[sight.image]: (sight.correlation(greys[names[sight.image]]), sight)
        for sight in sights(scene)
        if names[sight.image] in greys
    }
    known = [value for value, _ in fits.values() if not np.isnan(value)]
    if not known or np.percentile(known, 75) < USUAL:
        yield from _exchanged(fits, greys)  # or points without colours of their own
        return
    wrong = {name: sight for name, (value, sight) in fits.items() if value < MIN_CORRELATION}
    whole = _whole_periods(scene, list(fits), set(wrong))
    yield from whole.values()
    suspects = {name: greys[name] for name in wrong}
    periods = scene.periods or {}
    values = grouped((periods.get(name, -1), value) for name, (value, _) in fits.items())
    for name, sight in wrong.items():
        period, value = periods.get(name, -1), fits[name][0]
        if period in whole or value >= OF_USUAL * np.nanmedian(values[period]):
            continue
        right, also = _what_fits(sight, name, suspects)
        if right or value + _chance(value, len(sight.brightness)) < MIN_CORRELATION:
            found = f"colours that do not fit (correlation {value:.2f}{right})"
            yield Hit(f"images/{name}", "a photo of the points that it sees", found, also=also)


def _chance(correlation: float, count: int) -> float:
    """Amount by which a correlation of ``count`` pairs may be too low by chance (one-sided 95 %).

    Source: Fisher, "On the probable error of a coefficient of correlation", 1921.
    """
    z = np.arctanh(np.clip(correlation, -0.999, 0.999)) + 1.645 / np.sqrt(count - 3)
    return float(np.tanh(z) - correlation)


def _exchanged(fits: Mapping[str, tuple[float, Sight]], greys: Greys) -> Iterator[Hit]:
    """A hit if most photos are there, but under each other's names."""
    wrong = [name for name, (value, _) in fits.items() if value < MIN_CORRELATION]
    tried = wrong[:: len(wrong) // MAX_TRIED + 1]
    better = {name: _what_fits(fits[name][1], name, greys) for name in tried}
    found = {name: what for name, what in better.items() if what[0]}
    if len(found) > MAX_WRONG * len(tried):
        name, (right, also) = next(iter(found.items()))
        text = f"others in {len(wrong)} of {len(fits)} images: in {quote(name)}{right}"
        expected = "photos of the points that they see"
        yield Hit("images", expected, text, count=len(wrong), also=(name, *also))


def _whole_periods(scene: RawScene, looked_at: list[str], wrong: set[str]) -> dict[int, Hit]:
    """One hit for each period of which most photos are wrong."""
    hits = {}
    for period in scene.period_ids:
        mine = [n for n in looked_at if (scene.periods or {}).get(n) == period]
        bad = [n for n in mine if n in wrong]
        if len(bad) > max(1, MAX_WRONG * len(mine)):
            found = f"others in {len(bad)} of {len(mine)} images: {shown(bad)}"
            expected = "photos of the points that they see"
            hits[period] = Hit(f"period {period}", expected, found, count=len(bad))
    return hits


def _what_fits(sight: Sight, name: str, suspects: Greys) -> tuple[str, tuple[str, ...]]:
    """Describe the photo that would fit instead; return its name, too, if it is another one."""
    if sight.correlation(suspects[name][::-1, ::-1]) >= USUAL:
        return "; it fits rotated by 180 degrees", ()
    others = {n: sight.correlation(grey) for n, grey in suspects.items() if n != name}
    best = max(others, key=lambda n: others[n], default=None)
    if best is not None and others[best] >= USUAL:
        return f"; {quote(best)} fits", (best,)
    return "", ()


class Sight(NamedTuple):
    """Brightness that an image should show at its m observations."""

    image: int
    """Index into the images."""
    place: Array
    """Position in the image, from 0 to 1 along width and height. [m, 2]"""
    brightness: Array
    """Brightness of the points. [m]"""

    def correlation(self, grey: NDArray[np.uint8]) -> float:
        """Correlation of the brightness of points and a photo [H, W]; NaN if one is constant."""
        size = np.array(grey.shape[::-1])
        x, y = np.clip((self.place * size).astype(np.int64), 0, size - 1).T
        pixels = grey[y, x].astype(np.float64)
        a, b = pixels - pixels.mean(), self.brightness - self.brightness.mean()
        length = float(np.linalg.norm(a) * np.linalg.norm(b))
        return float(a @ b) / length if length > 0 else float("nan")


def sights(scene: RawScene) -> list[Sight]:
    """Sights of the images with enough observations inside them."""
    images, points, seen = scene.images, scene.points, scene.observations
    if images is None or points is None or seen is None:
        return []
    brightness = points.rgb.astype(np.float64) @ np.array(LUMA)
    found = []
    for image, rows in seen.by_image(images):
        camera = scene.usable_cameras.get(int(images.camera_ids[image]))
        if camera is None:
            continue
        place = images.keypoint_xy[seen.keypoint[rows]] / [camera.width, camera.height]
        inside = ((place >= 0) & (place <= 1)).all(axis=1)
        if np.count_nonzero(inside) >= MIN_OBSERVATIONS:
            found.append(Sight(image, place[inside], brightness[seen.point[rows[inside]]]))
    return found
