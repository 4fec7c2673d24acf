"""Detection of images whose matches contradict their poses. Worker process only.

An incremental mapper registers an image by what it has seen so far. Where structure repeats (a row
of equal windows) it may confuse one place with another, and later images follow. The matches of
such a group with the other images then contradict its poses, except the few that misled the mapper.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from chronoscene.arrays import Ints, Mask
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.quality.rays import sampson_distance
from chronoscene.registration.reconstruct.models import image_pose

AGREEING_PIXELS = 4.0  # Distance from the epipolar line up to which a match agrees with the poses

MIN_SHARE = 0.7
"""Share of the matches of an image with trusted ones that must agree with its pose. It is 0.95 and
more among right poses, and 0.05 to 0.6 in a misplaced group."""

MIN_MATCHES = 30  # An image with fewer is not judged
STARTS = 10  # Images from which the trusted set is grown, one at a time
MAX_MISPLACED = 0.4  # Share of the images beyond which it is not known which of them are wrong


Matches = Mapping[tuple[int, int], Ints]
"""Verified matches of all pairs of images, by image ids. [M, 2] each"""

Agreements = Mapping[tuple[int, int], tuple[int, int]]
"""Pair of image ids to matches that agree with the poses, and all matches."""


def pair_agreements(model: pycolmap.Reconstruction, matches: Matches) -> Agreements:
    """Count the matches of each pair of posed images that lie near their epipolar lines."""
    found = agreeing_matches(model, matches)
    return {pair: (int(agreeing.sum()), len(agreeing)) for pair, agreeing in found.items()}


def agreeing_matches(
    model: pycolmap.Reconstruction, matches: Matches
) -> dict[tuple[int, int], Mask]:
    """Find the matches of each pair of posed images that lie near their epipolar lines. [M]"""
    posed = {int(i): model.images[i] for i in model.reg_image_ids()}
    rays, poses, focals = {}, {}, {}
    for i, image in posed.items():
        camera = model.cameras[image.camera_id]
        xy = np.array([p.xy for p in image.points2D]).reshape(-1, 2)
        rays[i] = camera.cam_from_img(xy)
        poses[i] = image_pose(image)
        focals[i] = float(camera.mean_focal_length())
    found = {}
    for (a, b), pairs in matches.items():
        if a in posed and b in posed:
            relative = poses[b] @ np.linalg.inv(poses[a])
            focal = (focals[a] + focals[b]) / 2
            uv = rays[a][pairs[:, 0]], rays[b][pairs[:, 1]]
            pixels = sampson_distance(relative, *uv, focal, focal)
            # Images from one place have no epipolar geometry that a match could contradict.
            agreeing = pixels < AGREEING_PIXELS if relative[:3, 3].any() else np.isnan(pixels)
            found[a, b] = agreeing
    return found


def agreement(agreements: Agreements, images: Collection[int]) -> float:
    """Share of all matches among some images that agree; 0 without matches."""
    mine = [n for (a, b), n in agreements.items() if a in images and b in images]
    return sum(n for n, _ in mine) / max(sum(n for _, n in mine), 1)


def misplaced(
    agreements: Agreements, images: Collection[int], trusted: Collection[int] = ()
) -> list[int]:
    """Images whose matches with the others contradict their poses.

    The trusted set grows from one image, always by the one with most agreeing matches in it;
    images of which too few matches agree stay out. This finds a group that agrees with itself
    alone, which a test of one image at a time would not. Of several starts, the one with most
    agreeing matches counts, so that a single misleading pair does no harm.

    Args:
        agreements: From `pair_agreements`.
        images: Ids of the posed images.
        trusted: Ids that are right by definition.

    Returns:
        Ids, sorted; none if there are so many that the others may be wrong instead.
    """
    ids = sorted(images)
    good, total = _matrices(agreements, ids)
    certain = np.isin(ids, list(trusted))
    if certain.any():
        starts = [certain]
    else:
        best = np.argsort(-good.sum(axis=1), kind="stable")[:STARTS]
        starts = [np.arange(len(ids)) == i for i in best]
    grown = [_grown(good, total, start) for start in starts]
    inside = max(grown, key=lambda group: int(group @ (2 * good - total) @ group))
    wrong = ~inside & (total @ inside >= MIN_MATCHES)
    if wrong.sum() > MAX_MISPLACED * len(ids):
        return []
    return [ids[i] for i in np.flatnonzero(wrong)]


def _grown(good: Ints, total: Ints, start: Mask) -> Mask:
    """Grow the set of trusted images from a start. [N]"""
    inside = start.copy()
    agreeing, known = good @ inside, total @ inside
    while True:
        ready = ~inside & (known > 0) & (agreeing >= MIN_SHARE * known)
        if not ready.any():
            return inside
        new = int(np.argmax(np.where(ready, agreeing, -1)))
        inside[new] = True
        agreeing, known = agreeing + good[new], known + total[new]


def _matrices(agreements: Agreements, ids: list[int]) -> tuple[Ints, ...]:
    """Agreeing and all matches of pairs of images. [N, N] each"""
    position = {image_id: i for i, image_id in enumerate(ids)}
    counts = np.zeros((2, len(ids), len(ids)), np.int64)
    for (a, b), found in agreements.items():
        if a in position and b in position:
            i, j = position[a], position[b]
            counts[:, i, j] = counts[:, j, i] = found
    return counts[0], counts[1]


def deregister_misplaced(
    model: pycolmap.Reconstruction,
    matches: Matches,
    remarks: list[str],
    trusted: Sequence[int] = (),
) -> int:
    """Deregister images whose matches contradict their poses; how many there were.

    Args:
        model: Changed in place.
        matches: Of all images.
        remarks: Added to.
        trusted: Ids of images that are right by definition.
    """
    wrong = misplaced(pair_agreements(model, matches), model.reg_image_ids(), trusted)
    if wrong:
        names = ", ".join(sorted(str(model.images[i].name) for i in wrong))
        remarks.append(
            f"{names}: deregistered, because matches with other photos contradict the pose"
        )
    for image_id in wrong:
        model.deregister_frame(model.images[image_id].frame_id)
    return len(wrong)
