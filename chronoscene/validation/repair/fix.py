"""A corrected copy of a scene. The scene itself is only read; unchanged files become hard links."""

from __future__ import annotations

import json
import os
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path

from chronoscene.colmap.raw_model import FORMS, MODEL_FILES, RawModel
from chronoscene.colmap.write import write_raw_model
from chronoscene.errors import ConfigError, SceneError
from chronoscene.formats.chronoscene import MODEL, PERIODS, SPLIT, TEST, WORLD
from chronoscene.images.exif import set_upright
from chronoscene.images.masks import MASKS, mask_name, mask_place
from chronoscene.io.documents import read_json_document
from chronoscene.io.staging import check_outside, staged_folder, write_text_atomic
from chronoscene.io.wording import counted, shown
from chronoscene.scene.grouping import grouped
from chronoscene.scene.splits import parse_test_text
from chronoscene.validation.folder.names import spelling
from chronoscene.validation.folder.pixels import read_headers
from chronoscene.validation.folder.scene_folder import RawScene, TextFile, read_text_file
from chronoscene.validation.repair import contents
from chronoscene.validation.repair.contents import Repair
from chronoscene.validation.rules.cs1_cameras import rig_pose_differs
from chronoscene.validation.rules.cs2_image_files import images_of_other_shape
from chronoscene.validation.rules.cs3_split import SPLIT_ELSEWHERE, TEST_ELSEWHERE
from chronoscene.validation.run import ReadOptions, is_project, other_format, quiet_numbers


def fix_scene(root: Path, out: Path) -> list[Repair]:
    """Write a corrected copy; the folder appears complete or not at all.

    Args:
        root: The scene, as `check_fixable` allows it.
        out: Folder that does not exist yet, or is empty, and is not inside the scene.

    Returns:
        The corrections.

    Raises:
        ConfigError: If ``out`` is inside the scene.
        SceneError: If ``out`` is in use or cannot be written.
    """
    check_outside(out, [root], option="--fix")
    with staged_folder(out) as staged, quiet_numbers():
        return _Fix(RawScene(root), staged).run()


def check_fixable(root: Path, options: ReadOptions) -> None:
    """Refuse a scene in another format than ours and that of a COLMAP project.

    Raises:
        ConfigError: If it is one.
    """
    detected = other_format(root, options)
    if detected is not None and not is_project(detected):
        raise ConfigError(
            f"--fix of {root}",
            expected="a scene in the ChronoScene format, or a COLMAP project",
            found=f"one in {detected.name}",
            todo="convert it with chronoscene convert, then correct the result",
        )


class _Fix:
    """One scene on its way into a folder."""

    def __init__(self, scene: RawScene, out: Path) -> None:
        self._scene = scene
        self._out = out
        self._repairs: list[Repair] = []
        self._written: set[str] = set()
        """Files that must not be copied: they were written, moved or left out."""
        self._renamed: dict[str, str] = {}
        """Files of images that got another name, by that name."""

    def run(self) -> list[Repair]:
        self._model()
        names = self._scene.names if self._scene.images is not None else None
        self._split(names)
        self._test(names)
        self._misspelt_images()
        self._misspelt_masks()
        self._orientation_tags()
        self._copy_rest()
        return self._repairs

    def _model(self) -> None:
        """Write the model into ``sparse/0/`` if anything in it is corrected."""
        model, place = self._scene.model, self._scene.model_place
        if model is None or place is None or model.damages or self._scene.model_images != "images":
            return
        if model.cameras is None or model.images is None or model.points is None:
            return
        if not _is_binary(model) and any(rig_pose_differs(self._scene, model, model.images)):
            return  # without rigs and frames, the images would have other poses
        images, points, repairs = contents.repair_model(model.images, model.points)
        repairs += _form_repairs(model, place)
        if not repairs:
            return
        folder = self._out / MODEL
        folder.mkdir(parents=True, exist_ok=True)
        try:
            write_raw_model(folder, model.cameras, images, points)
        except (struct.error, OverflowError, ValueError):
            for stem in MODEL_FILES:  # a number out of range, which has its own rule
                (folder / f"{stem}.bin").unlink(missing_ok=True)
            return
        self._repairs += repairs
        below = f"{place}/" if place else ""
        self._written |= {f"{below}{stem}{form}" for stem in MODEL_FILES for form in FORMS}
        self._written |= {f"{MODEL}/{stem}.bin" for stem in MODEL_FILES}
        if below != f"{MODEL}/" or set(model.files.values()) & {f"{s}.txt" for s in MODEL_FILES}:
            self._move_rigs(model, below)

    def _move_rigs(self, model: RawModel, below: str) -> None:
        """Rigs and frames move with a binary model; those of a text model would not be read."""
        for stem in ("rigs", "frames"):
            for form in FORMS:
                self._written.add(f"{below}{stem}{form}")
            source = model.folder / f"{stem}.bin"
            if _is_binary(model) and source.is_file():
                _link(source, self._out / MODEL / f"{stem}.bin")

    def _split(self, names: list[str] | None) -> None:
        text = self._find_text(SPLIT, SPLIT_ELSEWHERE, "CS301")
        if text is None or names is None:
            return
        plain, repairs = contents.plain_table(text.text, names)
        assert self._scene.images is not None
        others = sorted(set(self._scene.images.names) - set(names))
        better, new_ids, more = contents.repair_split(
            text.data, plain, names, self._labelled(), others
        )
        repairs += more
        if not self._write(SPLIT, better):
            return
        self._repairs += repairs
        if any(old != new for old, new in new_ids.items()) and self._labelled() is not None:
            items = read_json_document(self._scene.root / PERIODS, list)
            items = [{**item, "id": new_ids[item["id"]]} for item in items]
            self._write(PERIODS, json.dumps(items, indent=1, ensure_ascii=False) + "\n")

    def _labelled(self) -> list[int] | None:
        """Ids in the file of labels; none if it is damaged, which has its own rule."""
        place = self._scene.root / PERIODS
        if not os.path.lexists(place):
            return None
        try:
            ids = [item["id"] for item in read_json_document(place, list)]
        except (SceneError, TypeError, KeyError):
            return []
        return ids if all(type(i) is int for i in ids) and ids == sorted(ids) else []

    def _test(self, names: list[str] | None) -> None:
        text = self._find_text(TEST, TEST_ELSEWHERE, "CS322")
        if text is None or names is None:
            return
        entries = parse_test_text(text.text)
        lines, repairs = contents.repair_test(names, entries)
        plain = "\n".join(entry.name for entry in entries)
        if text.data.removesuffix(b"\n") != plain.encode():
            what = "test.txt saved as UTF-8 with Unix line endings, without needless blanks"
            repairs.append(Repair("", what))
        if self._write(TEST, "".join(f"{line}\n" for line in lines)):
            self._repairs += repairs

    def _find_text(self, right: str, elsewhere: tuple[str, ...], code: str) -> TextFile | None:
        """The text file at the right place, else at the only wrong place that has one."""
        root = self._scene.root
        if os.path.lexists(root / right):
            return read_text_file(root / right)
        found = [place for place in elsewhere if (root / place).is_file()]
        text = read_text_file(root / found[0]) if len(found) == 1 else None
        if text is not None and self._write(right, text.text):
            self._written.add(found[0])
            self._repairs.append(Repair(code, f"{found[0]} moved to {right}"))
        return text

    def _misspelt_images(self) -> None:
        """Rename files whose name differs from that in the model only by its `spelling`."""
        registered, present = set(self._scene.names), set(self._scene.present)
        by_spelling = grouped((spelling(file), file) for file in self._scene.files)
        for name in sorted(registered - present):
            files = by_spelling.get(spelling(name), [])
            if len(files) == 1 and files[0] not in registered and self._inside(files[0]):
                self._written.add(f"images/{files[0]}")
                _link(self._scene.image_path(files[0]), self._out / "images" / name)
                mask = mask_place(files[0])
                if (self._scene.root / mask).is_file():
                    self._written.add(mask)
                    _link(self._scene.root / mask, self._out / mask_place(name))
                self._renamed[name] = files[0]
        if names := list(self._renamed):
            what = f"{counted(len(names), 'image')} renamed as in the model: {shown(names)}"
            self._repairs.append(Repair("CS201", what))

    def _misspelt_masks(self) -> None:
        """Rename masks whose name differs from that of an image only by its `spelling`."""
        top, images = self._scene.root.resolve(), {*self._scene.present, *self._renamed}
        by_spelling = grouped((spelling(file), file) for file in self._scene.mask_files)
        renamed = []
        for name in sorted(images):
            files = by_spelling.get(spelling(mask_name(name)), [])
            if len(files) != 1 or files[0].removesuffix(".png") in images:
                continue
            source, target = self._scene.root / MASKS / files[0], self._out / mask_place(name)
            if not os.path.lexists(target) and _leads_into(source, top):
                self._written.add(f"{MASKS}/{files[0]}")
                _link(source, target)
                renamed.append(mask_name(name))
        if renamed:
            what = f"{counted(len(renamed), 'mask')} renamed after the image: {shown(renamed)}"
            self._repairs.append(Repair("CS243", what))

    def _orientation_tags(self) -> None:
        """Reset tags that rotate images in viewers: the poses refer to the pixels as stored."""
        moved = read_headers(self._scene.root / "images", list(self._renamed.values()))
        headers = self._scene.headers | {new: moved[old] for new, old in self._renamed.items()}
        turned = {n for n, h in headers.items() if h.problem is None and h.orientation > 1}
        done = set()
        for name in sorted(turned - images_of_other_shape(self._scene, headers)) if turned else ():
            file = self._renamed.get(name, name)
            source = self._scene.image_path(file)
            upright = set_upright(source.read_bytes()) if self._inside(file) else None
            if upright is not None:
                target = self._out / "images" / name
                target.parent.mkdir(parents=True, exist_ok=True)
                target.unlink(missing_ok=True)  # a renamed file is a link to the original
                target.write_bytes(upright)
                self._written.add(f"images/{name}")
                done.add(name)
        if done:
            names = shown(sorted(done))
            what = f"orientation tag of {counted(len(done), 'image')} set to upright: {names}"
            # The rule does not see files of other names.
            code = "CS207" if done - self._renamed.keys() else ""
            self._repairs.append(Repair(code, what))

    def _inside(self, name: str) -> bool:
        images = (self._scene.root / "images").resolve()
        return _leads_into(images / name, images)

    def _copy_rest(self) -> None:
        """Copy everything else unchanged, except links that lead out of the scene.

        Images and masks elsewhere are linked again; of other parts, the model and the texts are
        copied from there.
        """
        top = self._scene.root.resolve()
        linked, parts = 0, self._parts()
        for place in parts:
            source, target = self._scene.root / place, self._out / place
            if _leads_into(source, top) or not place.startswith(("images/", MASKS)):
                _link(source, target)
            else:
                target.parent.mkdir(parents=True, exist_ok=True)
                target.symlink_to(source.resolve())
                linked += 1
        if linked:
            self._repairs.append(Repair("", f"{counted(linked, 'image')} linked from elsewhere"))
        left_out = []
        for path, place in _files(top):
            if place in self._written:
                continue
            if _leads_into(path, top):
                if path.is_file():
                    _link(path, self._out / place)
            elif not any(part == place or part.startswith(f"{place}/") for part in parts):
                left_out.append(place)
        if left_out:
            links = counted(len(left_out), "link")
            what = f"{links} leading out of the scene left out: {shown(left_out)}"
            self._repairs.append(Repair("", what))

    def _parts(self) -> list[str]:
        """List the files of the scene that are not written yet, also those behind links."""
        names = [f"images/{name}" for name in self._scene.present]
        names += [mask_place(name) for name in self._scene.present]
        below = f"{self._scene.model_place}/" if self._scene.model_place else ""
        stems = (*MODEL_FILES, "rigs", "frames")
        model = [f"{below}{stem}{form}" for stem in stems for form in FORMS]
        return [
            place
            for place in (*names, *model, SPLIT, TEST, PERIODS, WORLD)
            if place not in self._written
            and not os.path.lexists(self._out / place)
            and (self._scene.root / place).is_file()
        ]

    def _write(self, place: str, text: str) -> bool:
        """Write a text file, unless it has names that are not text, which have their own rule."""
        (self._out / place).parent.mkdir(parents=True, exist_ok=True)
        try:
            write_text_atomic(self._out / place, text)
        except UnicodeEncodeError:
            return False
        self._written.add(place)
        return True


def _is_binary(model: RawModel) -> bool:
    """Return True if rigs and frames are read in binary form."""
    return model.files.get("cameras", "").endswith(".bin")


def _form_repairs(model: RawModel, place: str) -> list[Repair]:
    """Corrections of the place and the form of the files."""
    repairs = []
    forms = {file[-4:] for file in model.files.values()}
    if place != MODEL:
        repairs.append(Repair("CS002", f"model moved from {place or 'the top'} to {MODEL}"))
    if len(forms) > 1:
        repairs.append(Repair("CS102", "model of mixed forms written as binary"))
    elif forms == {".txt"}:
        repairs.append(Repair("", "text model written as binary"))
    elif any((model.folder / f"{stem}.txt").is_file() for stem in MODEL_FILES):
        repairs.append(Repair("CS104", "text beside the binary model left out"))
    return repairs


def _files(top: Path) -> Iterator[tuple[Path, str]]:
    """Files below a folder, and their names relative to it; linked folders are not followed."""
    for folder, folders, files in os.walk(top):
        for name in sorted(files) + [n for n in folders if os.path.islink(os.path.join(folder, n))]:
            path = Path(folder) / name
            yield path, path.relative_to(top).as_posix()


def _leads_into(path: Path, top: Path) -> bool:
    """Return True if a path is in a folder when links are followed, also for links in a circle."""
    return Path(os.path.realpath(path)).is_relative_to(top)


def _link(source: Path, target: Path) -> None:
    """A hard link, or a copy if the file system has none."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if os.path.lexists(target):
        return  # never into a file that may be a link to the original
    try:
        os.link(source.resolve(), target)
    except OSError:
        shutil.copyfile(source, target)
