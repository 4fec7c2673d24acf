"""Ground truth of views beyond their photos: where they change, other periods, and depth.

In the folder of the truth, ``change/a/x__p2.png`` says where ``images/a/x.jpg`` differs from what
the same camera would see at period 2, ``cross_rgb/a/x__p2.jpg`` shows what it would see, and
``cross_depth/a/x__p2.npz`` and ``depth/a/x.npz`` hold the depth of both.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from chronoscene.errors import ImageError
from chronoscene.images.decoding import image_size, load_grey, load_rgb
from chronoscene.images.disk_cache import UNREADABLE
from chronoscene.images.masks import resize_mask
from chronoscene.images.store import evaluation_size

UNCHANGED, APPEARANCE, GEOMETRY = 0, 127, 255
"""Pixel values of change masks. In those of users, any other value is a change of geometry."""

Kind = Literal["change", "cross_rgb", "cross_depth", "depth"]
SUFFIXES: dict[Kind, str] = {
    "change": ".png",
    "cross_rgb": ".jpg",
    "cross_depth": ".npz",
    "depth": ".npz",
}


def truth_place(kind: Kind, view: str, other: int | None = None) -> str:
    """Return the path of a file below the folder of the truth.

    Args:
        kind: Content of the file.
        view: Name of the frame.
        other: The period it shows, or compares the view with; None for that of the photo.
    """
    period = "" if other is None else f"__p{other}"
    return f"{kind}/{PurePosixPath(view).with_suffix('')}{period}{SUFFIXES[kind]}"


def check_distinct(truth: Path, views: Iterable[str]) -> None:
    """Refuse views whose files of the truth have one name, if there is a truth.

    Args:
        truth: Its folder.
        views: Names of frames.

    Raises:
        ImageError: If two differ in their extension only.
    """
    known: dict[str, str] = {}
    for view in views if truth.is_dir() else ():
        other = known.setdefault(truth_place("depth", view), view)
        if other != view:
            raise ImageError(
                truth,
                expected="views whose names differ without their extension",
                found=f"{other} and {view}, which share their files here",
                todo="rename one of the two images in the scene",
            )


def load_changes(path: Path, size: tuple[int, int], max_width: int) -> NDArray[np.uint8]:
    """Read a change mask at the size of the evaluation. [H, W]

    A pixel of a resized mask is unchanged if all pixels are that its colour is made of, and shows a
    change of appearance if none of them shows one of geometry.

    Args:
        path: The file, of the size of the photo or of the evaluation.
        size: Width and height of the evaluation.
        max_width: By which the photos were resized.

    Raises:
        ImageError: If it is missing, damaged, not of one channel or of another size.
    """
    stored = image_size(path)
    if evaluation_size(*stored, max_width) != size:
        raise ImageError(
            path,
            expected=f"the size of its photo, which is evaluated at {size[0]} x {size[1]}",
            found=f"{stored[0]} x {stored[1]}",
            todo="make the mask again at the size of the photo",
        )
    values = load_grey(path, stored)
    same = resize_mask(values == UNCHANGED, size)
    painted = resize_mask((values == UNCHANGED) | (values == APPEARANCE), size)
    return np.where(same, UNCHANGED, np.where(painted, APPEARANCE, GEOMETRY)).astype(np.uint8)


def changed_at_all(
    folder: Path, view: str, others: Iterable[int], size: tuple[int, int], max_width: int
) -> NDArray[np.bool_] | None:
    """Read where a view differs from at least one other period; None without a mask. [H, W]

    Args:
        folder: Of the truth.
        view: Name of the frame.
        others: All periods but its own.
        size: Width and height of the evaluation.
        max_width: By which the photos were resized.

    Raises:
        ImageError: As for `load_changes`, and if there is a mask for some of the periods only.
    """
    paths = [folder / truth_place("change", view, period) for period in others]
    if not any(path.is_file() for path in paths):
        return None
    masks = [load_changes(path, size, max_width) != UNCHANGED for path in paths]
    return np.asarray(np.logical_or.reduce(masks))


def load_other(
    folder: Path, view: str, period: int, size: tuple[int, int]
) -> NDArray[np.uint8] | None:
    """Read the view of a camera at another period; None if that is not known.

    Arguments as for `changed_at_all`, errors as for `load_rgb`. [H, W, 3]
    """
    path = folder / truth_place("cross_rgb", view, period)
    return load_rgb(path, size=size) if path.is_file() else None


def load_depth(folder: Path, view: str, other: int | None) -> NDArray[np.floating] | None:
    """Read the depth of a view at another period, or at its own; None if unknown. [H, W]

    Raises:
        ImageError: If the file is damaged.
    """
    path = folder / truth_place("depth" if other is None else "cross_depth", view, other)
    if not path.is_file():
        return None
    try:
        with np.load(path) as arrays:  # refuses pickles
            return np.asarray(arrays["depth"], np.float64)
    except (*UNREADABLE, TypeError) as error:
        raise ImageError(
            path,
            expected="an array named depth in NumPy's npz format",
            found=str(error) or type(error).__name__,
            todo="write the file again with numpy.savez",
        ) from error
