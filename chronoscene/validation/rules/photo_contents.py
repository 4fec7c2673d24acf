"""CS231: whether the photos are those that the model was made from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from chronoscene.io.wording import counted, quote, shown
from chronoscene.validation.checks.photo_consistency import Sight, sights
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene

LEAST, USUAL = 0.35, 0.5
"""Correlations of brightness between points and pixels: below the first a photo is another one, if
at least a quarter of the photos of the scene are beyond the second. Measured over photos and
renders, also of different seasons and at dusk: 0.44 to 0.98 for the right photo, of a scene 0.72
and more in the median; 0.5 and less for a wrong one, 0.1 in the median."""

TRIED = 12
"""Images whose photo is looked for among all photos where hardly any photo is right."""

OF_USUAL = 0.4
"""And it must be below this share of the median of its period: where all is rebuilt and registered
by little, points have the colours of another period. Measured: a median of 0.51, the least 0.23."""

MOST_WRONG = 0.5
"""Share of the photos of a period beyond which all of them are at fault."""

TURNS = {
    "turned by 180 degrees": np.s_[::-1, ::-1],
    "mirrored": np.s_[:, ::-1],
    "upside down": np.s_[::-1, :],
}
"""In words, what makes a turned photo right."""

Greys = Mapping[str, NDArray[np.uint8]]


@rule(
    "CS231",
    "image-other-photo",
    "warning",
    what="A photo does not show the points that it should see: it is another one, or it was turned "
    "after the model was made (needs `--decode`).",
    remedy="look at the photo; copy the one that the model was made from",
    bad="`a.jpg` and `b.jpg` with each other's names; a photo turned by 180 degrees",
    needs=("observations", "pixels"),
)
def image_other_photo(scene: RawScene) -> Iterator[Hit]:
    assert scene.images is not None and scene.pixels is not None
    greys = {n: p.grey for n, p in scene.pixels.items() if p.grey is not None}
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
    wrong = {name: sight for name, (value, sight) in fits.items() if value < LEAST}
    whole = _whole_periods(scene, list(fits), set(wrong))
    yield from whole.values()
    suspects = {name: greys[name] for name in wrong}
    usual = _usual(scene, {name: value for name, (value, _) in fits.items()})
    for name, sight in wrong.items():
        period = (scene.periods or {}).get(name, -1)
        if period not in whole and fits[name][0] < OF_USUAL * usual[period]:
            right, also = _what_fits(sight, name, suspects)
            found = f"colours that do not fit (correlation {fits[name][0]:.2f}{right})"
            yield Hit(f"images/{name}", "a photo of the points that it sees", found, also=also)


def _usual(scene: RawScene, values: Mapping[str, float]) -> dict[int, float]:
    """Median correlation of the images of each period, -1 for those of none."""
    by_period: dict[int, list[float]] = {}
    for name, value in values.items():
        by_period.setdefault((scene.periods or {}).get(name, -1), []).append(value)
    return {period: float(np.nanmedian(group)) for period, group in by_period.items()}


def _exchanged(fits: Mapping[str, tuple[float, Sight]], greys: Greys) -> Iterator[Hit]:
    """Whether the photos of all images are there, under each other's names."""
    wrong = [name for name, (value, _) in fits.items() if value < LEAST]
    tried = wrong[:: len(wrong) // TRIED + 1]
    better = {name: _what_fits(fits[name][1], name, greys) for name in tried}
    found = {name: what for name, what in better.items() if what[0]}
    if len(found) > MOST_WRONG * len(tried):
        name, (right, also) = next(iter(found.items()))
        text = f"others in {counted(len(wrong), 'image')} of {len(fits)}: in {quote(name)}{right}"
        expected = "photos of the points that they see"
        yield Hit("images", expected, text, count=len(wrong), also=(name, *also))


def _whole_periods(scene: RawScene, looked_at: list[str], wrong: set[str]) -> dict[int, Hit]:
    """One hit for each period of which most photos are wrong."""
    hits = {}
    for period in scene.period_ids:
        mine = [n for n in looked_at if (scene.periods or {}).get(n) == period]
        bad = [n for n in mine if n in wrong]
        if len(bad) > max(1, MOST_WRONG * len(mine)):
            found = f"others in {counted(len(bad), 'image')} of {len(mine)}: {shown(bad)}"
            expected = "photos of the points that they see"
            hits[period] = Hit(f"period {period}", expected, found, count=len(bad))
    return hits


def _what_fits(sight: Sight, name: str, suspects: Greys) -> tuple[str, tuple[str, ...]]:
    """In words, what would fit instead, and the name of the photo where it is another one."""
    for words, turn in TURNS.items():
        if sight.correlation(suspects[name][turn]) >= USUAL:
            return f"; it fits {words}", ()
    others = {n: sight.correlation(grey) for n, grey in suspects.items() if n != name}
    best = max(others, key=lambda n: others[n], default=None)
    if best is None or not others[best] >= USUAL:
        return "", ()
    return f"; {quote(best)} fits", (best,)
