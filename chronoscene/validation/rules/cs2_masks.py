"""CS24: masks, which say what counts of an image."""

from __future__ import annotations

from collections.abc import Iterator

from chronoscene.images.masks import MASKS, MODES, mask_name, mask_place
from chronoscene.io.wording import counted, quote, shown
from chronoscene.validation import rule
from chronoscene.validation.folder.names import Spellings
from chronoscene.validation.folder.pixels import Header
from chronoscene.validation.folder.scene_folder import RawScene
from chronoscene.validation.rule import Hit


@rule.error(
    "CS241",
    bad="a mask in RGB; a mask of zero bytes",
    remedy="save the mask as a grey PNG: 0 where the image is ignored, anything else elsewhere",
)
def mask_unreadable(scene: RawScene, mask_headers: dict[str, Header]) -> Iterator[Hit]:
    """A mask cannot be read, or is no image of one channel with 8 bits."""
    peaks = scene.mask_peaks or {}
    for name, header in mask_headers.items():
        if header.problem is not None:
            yield Hit(mask_place(name), "an image", header.problem)
        elif header.mode not in MODES:
            yield Hit(mask_place(name), "one channel of 8 bits", f"pixels of mode {header.mode}")
        elif header.truncated or peaks.get(name, 0) is None:
            yield Hit(mask_place(name), "an image that can be decoded", "a damaged one")


@rule.error(
    "CS242",
    bad="a photo of 4000 x 3000 and its mask of 1000 x 750",
    remedy="make the mask from the image file that is in images/",
)
def mask_size(readable: dict[str, Header], mask_headers: dict[str, Header]) -> Iterator[Hit]:
    """A mask has another size than its image."""
    for name, header in mask_headers.items():
        if header.problem is None and name in readable and header.size != readable[name].size:
            width, height = readable[name].size
            found = f"{header.size[0]} x {header.size[1]}"
            yield Hit(mask_place(name), f"{width} x {height} as images/{name}", found)


@rule.warning(
    "CS243",
    bad="`masks/x.png` for `images/x.jpg`, whose mask is `masks/x.jpg.png`",
    remedy="name the mask after its image, with the extension of the image and then .png",
)
def mask_without_image(scene: RawScene, names: list[str]) -> Iterator[Hit]:
    """A file in `masks/` is not the mask of an image, so it is not used."""
    images = {*names, *scene.files}
    others = Spellings(images - scene.mask_headers.keys())
    for file in scene.mask_files:
        if file.removesuffix(".png") in images and file.endswith(".png"):
            continue
        near = others.find(file) or others.find(file.removesuffix(".png"))
        hint = f"; the mask of {quote(near)} would be {quote(mask_name(near))}" if near else ""
        yield Hit(f"{MASKS}/{file}", "the mask of an image", f"no image of this name{hint}")


@rule.warning(
    "CS244",
    bad="a mask that was saved with the values 0 and 1 swapped",
    remedy="invert the mask if that is meant: 0 is ignored; otherwise remove the image",
)
def mask_ignores_everything(mask_peaks: dict[str, int | None]) -> Iterator[Hit]:
    """A mask ignores its whole image: nothing can be trained on it or tested (needs `--decode`)."""
    for name, largest in mask_peaks.items():
        if largest == 0:
            yield Hit(mask_place(name), "pixels that count", "none")


@rule.warning(
    "CS245",
    bad="masks of 40 out of 50 photos of a period, for example where the masking stopped",
    remedy="add the masks that are missing, if something is to be ignored in these images",
)
def masks_missing(periods: dict[str, int], mask_headers: dict[str, Header]) -> Iterator[Hit]:
    """Some images of a period have a mask, and others have none, so all of them counts."""
    for period in sorted({periods[name] for name in mask_headers if name in periods}):
        images = [name for name, of in periods.items() if of == period]
        without = [name for name in images if name not in mask_headers]
        if without:
            expected = f"a mask of each of the {len(images)} images of period {period}"
            found = f"none of {counted(len(without), 'image')}: {shown(without)}"
            yield Hit(MASKS, expected, found, count=len(without))
