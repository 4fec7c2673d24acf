"""What can be repaired in a model without knowing more than it says."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from chronoscene.colmap.arrays import RawImages, RawPoints
from chronoscene.io.wording import counted
from chronoscene.validation.checks.observations import observe
from chronoscene.validation.checks.reprojection import good_poses
from chronoscene.validation.rules.poses import UNIT_TOLERANCE

LEAST_KEPT = 0.5
"""Share of the points that must have two observations; else points without tracks are what the
model is made of (a laser scan, say) and stay."""


class Repair(NamedTuple):
    """One thing that was corrected."""

    code: str
    """Of the rule that had spoken."""
    text: str


def repair_model(images: RawImages, points: RawPoints) -> tuple[RawImages, RawPoints, list[Repair]]:
    """A model without the faults that have one possible correction, and what was done."""
    repairs: list[Repair] = []
    before = points
    images = _unit_quaternions(images, repairs)
    points = _without_broken_observations(images, points, repairs)
    keep = np.asarray(np.isfinite(points.xyz).all(axis=1))
    if not keep.all():
        gone = counted(int(np.count_nonzero(~keep)), "point")
        repairs.append(Repair("CS502", f"{gone} without finite coordinates removed"))
        points = points.select(keep)
    long = np.diff(points.track_start) >= 2
    if not long.all() and np.count_nonzero(long) >= LEAST_KEPT * len(points):
        gone = counted(int(np.count_nonzero(~long)), "point")
        repairs.append(Repair("CS503", f"{gone} with fewer than two observations removed"))
        points = points.select(long)
    return _without_points(images, before, points), points, repairs


def _unit_quaternions(images: RawImages, repairs: list[Repair]) -> RawImages:
    good = good_poses(images)
    norm = np.where(good, np.linalg.norm(images.quaternions, axis=1), 1.0)
    if number := int(np.count_nonzero(np.abs(norm - 1) > UNIT_TOLERANCE)):
        repairs.append(Repair("CS122", f"{counted(number, 'quaternion')} brought to length 1"))
        return replace(images, quaternions=images.quaternions / norm[:, None])
    return images


def _without_broken_observations(
    images: RawImages, points: RawPoints, repairs: list[Repair]
) -> RawPoints:
    if len(np.unique(images.ids)) < len(images):
        return points  # of two images with one id, one has lost its observations to the other
    seen = observe(images, points)
    finite = np.asarray(np.isfinite(images.keypoint_xy).all(axis=1))
    exists = seen.valid
    sound = exists.copy()
    sound[exists] = finite[seen.keypoint[exists]]
    for code, bad, what in (
        ("CS504", ~exists, "of images or keypoints that do not exist"),
        ("CS510", exists & ~sound, "at positions that are not finite"),
    ):
        if number := int(np.count_nonzero(bad)):
            repairs.append(Repair(code, f"{counted(number, 'observation')} {what} removed"))
    if sound.all():
        return points
    lengths = np.bincount(seen.point[sound], minlength=len(points))
    return replace(
        points,
        track_start=np.concatenate([[0], np.cumsum(lengths)]),
        track_image=points.track_image[sound],
        track_keypoint=points.track_keypoint[sound],
    )


def _without_points(images: RawImages, before: RawPoints, after: RawPoints) -> RawImages:
    """Keypoints of what was removed belong to no point; other disagreement stays as it is."""
    gone = np.setdiff1d(before.ids, after.ids)
    broken = ~np.isfinite(images.keypoint_xy).all(axis=1)
    cleared = np.isin(images.keypoint_point, gone) | (broken & (images.keypoint_point >= 0))
    if not cleared.any():
        return images
    return replace(images, keypoint_point=np.where(cleared, -1, images.keypoint_point))
