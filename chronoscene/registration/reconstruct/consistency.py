"""Detection of images whose matches contradict their poses. Worker process only.

An incremental mapper registers an image by what it has seen so far. Where structure repeats (a row
of equal windows) it may confuse one place with another, and later images follow. The matches of
such a group with the other images then contradict its poses, except the few that misled the mapper.
Where few photos turn a corner, what comes behind it may get another scale. Pairs of images agree
with any; what three of them see does not.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.quality.rays import sampson_distance
from chronoscene.registration.reconstruct.models import image_pose

AGREEING_PIXELS = 4.0  # Distance from the epipolar line up to which a match agrees with the poses

POINT_PIXELS = 8.0
"""Distance of a match from the point that the other image of the pair sees, up to which they agree.
Points that are seen from one side are less exact than lines."""

MIN_SHARE = 0.7
"""Share of the matches of an image with trusted ones that must agree with its pose. It is 0.95 and
more among right poses, and 0.05 to 0.6 in a misplaced group."""

MIN_LINK = 0.5
"""Share of the matches across a part of a model that must agree with points. It is 0.9 and more in
right models of aerial photos, and was 0.24 where one side of a block had 0.6 times its size."""

MIN_PART = 3  # Images of a part
MIN_MATCHES = 30  # An image or a part with fewer is not judged
STARTS = 10  # Images from which the trusted set is grown, one at a time
MAX_MISPLACED = 0.4  # Share of the images beyond which it is not known which of them are wrong


Matches = Mapping[tuple[int, int], Ints]
"""Verified matches of all pairs of images, by image ids. [M, 2] each"""

Agreements = Mapping[tuple[int, int], tuple[int, int]]
"""Pair of image ids to matches that agree with the poses, and all that were judged."""


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


def point_agreements(model: pycolmap.Reconstruction, matches: Matches) -> Agreements:
    """Count the matches of each pair of posed images that agree with the points of the model.

    A match whose features are one point agrees. Else the other image must see the point of each of
    them where its match lies. Matches without points are not judged.
    """
    place = {int(point_id): k for k, point_id in enumerate(model.points3D)}
    xyz = np.array([p.xyz for p in model.points3D.values()]).reshape(-1, 3)
    points, features = {}, {}
    for i in model.reg_image_ids():
        seen = model.images[i].points2D
        points[i] = np.array([place[p.point3D_id] if p.has_point3D() else -1 for p in seen], int)
        features[i] = np.array([p.xy for p in seen]).reshape(-1, 2)
    found = {}
    for (a, b), pairs in matches.items():
        if a in points and b in points:
            of_a, of_b = points[a][pairs[:, 0]], points[b][pairs[:, 1]]
            same = (of_a == of_b) & (of_a >= 0)
            apart = [
                np.linalg.norm(
                    _projected(model, image_id, xyz[point[judged]]) - match[judged], axis=1
                )
                for image_id, point, match in (
                    (b, of_a, features[b][pairs[:, 1]]),
                    (a, of_b, features[a][pairs[:, 0]]),
                )
                for judged in [(point >= 0) & ~same]
            ]
            pixels = np.concatenate([np.zeros(same.sum()), *apart])
            found[a, b] = int((pixels < POINT_PIXELS).sum()), len(pixels)
    return found


def _projected(model: pycolmap.Reconstruction, image_id: int, xyz: Array) -> Array:
    """Pixels at which an image sees points; infinite behind it. [N, 2]"""
    image = model.images[image_id]
    pose = image_pose(image)
    local = xyz @ pose[:3, :3].T + pose[:3, 3]
    ahead = local[:, 2] > 0
    pixels = np.full((len(xyz), 2), np.inf)
    if ahead.any():
        pixels[ahead] = model.cameras[image.camera_id].img_from_cam(local[ahead])
    return pixels


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


def loose_parts(agreements: Agreements, images: Collection[int]) -> list[int]:
    """Images of parts that most matches with the rest of a model contradict.

    The pairs with most agreeing matches hold the model together as a tree. Each of its edges holds
    a part, and all matches across that part are counted. Of the parts that fewer than `MIN_LINK`
    of them hold, the one that most contradict is taken out, then that of the rest. The larger side
    of an edge counts as right.

    Args:
        agreements: From `point_agreements`.
        images: Ids of the posed images.

    Returns:
        Ids, sorted.
    """
    left, loose = sorted(images), set[int]()
    while part := loosest_part(agreements, left):
        loose |= part
        left = [i for i in left if i not in part]
    return sorted(loose)


def loosest_part(agreements: Agreements, ids: Sequence[int]) -> set[int]:
    """The part that most matches contradict; empty if all are held. See `loose_parts`."""
    if len(ids) < 2 * MIN_PART:
        return set()
    good, total = _matrices(agreements, ids)
    tree = minimum_spanning_tree(csr_array(np.where(total > 0, 1 / np.maximum(good, 0.1), 0)))
    order, above = breadth_first_order(tree, 0, directed=False)
    parts = np.eye(len(ids), dtype=bool)  # Of each image, what hangs on it and itself
    for k in order[:0:-1]:
        parts[above[k]] |= parts[k]
    parts = parts[order[1:]]
    parts ^= (2 * parts.sum(axis=1) > len(ids))[:, None]
    agreeing, judged = (((parts @ counts) * ~parts).sum(axis=1) for counts in (good, total))
    usable = (parts.sum(axis=1) >= MIN_PART) & (judged >= MIN_MATCHES)
    against = np.where(usable & (agreeing < MIN_LINK * judged), judged - agreeing, 0)
    if not against.any():
        return set()
    return {ids[int(i)] for i in np.flatnonzero(parts[against.argmax()])}


def share_across(agreements: Agreements, part: Collection[int]) -> float:
    """Share of the matches between a part and the rest that agree; 0 without any."""
    across = [n for (a, b), n in agreements.items() if (a in part) != (b in part)]
    return sum(n for n, _ in across) / max(sum(n for _, n in across), 1)


def _matrices(agreements: Agreements, ids: Sequence[int]) -> tuple[Ints, ...]:
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
