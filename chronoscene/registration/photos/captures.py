"""The photos of each period, with their metadata.

Three forms are read: a folder with one folder for each period, one folder of photos (periods are
proposed from their dates), and a CSV table of image and period.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from pathlib import Path, PurePosixPath

from PIL import features

from chronoscene.errors import SceneError
from chronoscene.formats.shared.grouping import natural_key, read_table
from chronoscene.formats.shared.json_values import is_iso_date
from chronoscene.images.decoding import HEIF_SUFFIXES, HEIF_TODO, reads_heif
from chronoscene.images.exif import read_exif, taken_at
from chronoscene.images.masks import MASKS, mask_place
from chronoscene.io.wording import counted, printable
from chronoscene.kernels.runtime import available_threads
from chronoscene.registration.photos.photo import Capture, open_photo
from chronoscene.scene.grouping import grouped
from chronoscene.scene.splits import IMAGE_SUFFIXES, composed

PERIOD_GAP_DAYS = 14  # In one folder of photos, a gap of so many days begins a new period

OTHERS = (
    *(*HEIF_SUFFIXES, ".avif", ".jxl", ".dng"),
    *(".jfif", ".jp2", ".jpe", ".mpo"),
    *(".arw", ".cr2", ".cr3", ".nef", ".orf", ".raf", ".rw2"),
)
"""Extensions of photos that are left out if the same photo is there in another form, or if they
cannot be read."""

VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".mts")


@dataclass(frozen=True, slots=True)
class CapturePeriod:
    """A group of photos of one date."""

    label: str
    date: str | None
    """ISO date of its photos, as far as they share it and state it."""


@dataclass(frozen=True, slots=True)
class Captures:
    """All photos that were found."""

    root: Path
    images: tuple[Capture, ...]
    """Sorted by name."""
    periods: tuple[CapturePeriod, ...]
    refused: tuple[tuple[str, int, str], ...]
    """Path below the root, period, and reason of each photo that cannot be used."""
    remarks: tuple[str, ...]
    misdated: tuple[str, ...] = ()
    """Periods with photos that were taken at another time by their metadata, in words."""
    left_out: tuple[str, ...] = ()
    """Photos of which no period is known, in words."""
    unused: tuple[str, ...] = ()
    """GPS positions and masks that are not used, in words."""
    undisputed: frozenset[Path] = frozenset()
    """Files of the photos whose own dates may date their period."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Everything to be said about what is missing or doubtful, for the end of a command."""
        return (*self.left_out, *self.misdated, *self.unused)


@dataclass(frozen=True, slots=True)
class _Listed:
    """A file and the label of its period."""

    path: Path
    name: str
    label: str
    row: str = ""
    """File name and line of the table that names it; empty without a table."""


def find_captures(path: Path, table: Path | None) -> tuple[Path, Path | None]:
    """Find the folder of photos and the table of periods; arguments as in `read_captures`."""
    if path.is_dir():
        return path, table
    if table is None and path.suffix.lower() == ".csv" and path.is_file():
        return path.parent, path
    raise _nothing(path, "another file" if path.exists() else "nothing there", "check the path")


def photos_of(folder: Path, table: Path | None) -> list[Path]:
    """List the photos of a folder, or those of a table that are there, sorted.

    Raises:
        SceneError: If the table is wrong.
    """
    if table is None:
        return photos_in(folder)
    return sorted(item.path for item in _from_table(folder, table) if item.path.is_file())


def photo_folders(path: Path, table: Path | None) -> list[Path]:
    """Return the folders of the user into which nothing may be written.

    For a table in place of a folder, these are the folders of its photos, not all that lies beside
    it. Arguments and errors as in `read_captures`.
    """
    folder, found = find_captures(path, table)
    if path.is_dir():
        return [folder]
    tops = (photo.relative_to(folder).parts[:-1][:1] for photo in photos_of(folder, found))
    return [folder.joinpath(*top) for top in dict.fromkeys(tops)]


def read_captures(path: Path, *, table: Path | None = None) -> Captures:
    """Find the photographs of all periods.

    Args:
        path: Folder with a folder for each period, or with photos; or a CSV table.
        table: CSV with the columns ``image`` and ``period``; image paths are relative to ``path``.

    Raises:
        SceneError: If there are no photos, or the table is wrong.
    """
    path, table = find_captures(Path(path), table)
    reads_heif()  # for dates, too
    if table is not None:
        return _assemble(path, _from_table(path, table))
    photos = photos_in(path)
    files = sorted(_files_in(path))
    unread = [*_unread(path, files, photos), *_broken_links(path, files)]
    groups, left_out = _period_folders(path, photos)
    if groups:
        return _assemble(path, groups, left_out=[*left_out, *unread])
    groups, proposed, left_out = _by_date(path, photos)
    return _assemble(path, groups, proposed, [*left_out, *unread])


def photos_in(folder: Path) -> list[Path]:
    """List image files below a folder, sorted, without hidden files and folders; links count.

    Phones write HEIC, and AVIF is alike: these are listed if they can be read, and if the same
    photo is not there in another form. Files in ``masks/`` are masks if there are other photos.
    """
    files = [p for p in _files_in(folder) if p.is_file()]
    photos = [p for p in files if p.suffix.lower() in IMAGE_SUFFIXES]
    known = {p.with_suffix("") for p in photos}
    others = [p for p in files if _is_read(p.suffix.lower()) and p.with_suffix("") not in known]
    found = sorted([*photos, *others], key=lambda p: p.relative_to(folder).as_posix())
    return [p for p in found if folder / MASKS not in p.parents] or found


def _is_read(suffix: str) -> bool:
    """Return True for a file of `OTHERS` that can be read."""
    if suffix == ".avif":
        return bool(features.check("avif"))
    return suffix in HEIF_SUFFIXES and reads_heif()


def _files_in(folder: Path, above: tuple[Path, ...] = ()) -> Iterator[Path]:
    """Yield the files below a folder, and broken links.

    Args:
        folder: Where to look.
        above: Folders around it, to which links may lead.
    """
    real = folder.resolve()
    if real in above or not real.is_dir():
        return
    for path in folder.iterdir():
        if path.name.startswith("."):
            continue
        if path.is_dir():
            yield from _files_in(path, (*above, real))
        elif path.is_file() or path.is_symlink():
            yield path


def _unread(root: Path, files: Iterable[Path], photos: Sequence[Path]) -> list[str]:
    """Name photos in formats that are not read; nothing if there are none."""
    known = {p.with_suffix("") for p in photos}
    others = (p for p in files if p.with_suffix("") not in known)
    found = [p for p in others if p.suffix.lower() in OTHERS]
    if not found:
        return []
    suffixes = sorted({p.suffix.lower() for p in found})
    with_package = not reads_heif() and not set(HEIF_SUFFIXES).isdisjoint(suffixes)
    return [
        f"{counted(len(found), 'photo')} in formats that are not read ({', '.join(suffixes)}), "
        f"such as {printable(str(found[0].relative_to(root)))}; they are left out; "
        + (HEIF_TODO if with_package else "convert them to JPEG")
    ]


def _broken_links(root: Path, files: Iterable[Path]) -> list[str]:
    """Name links to photos that are not there; nothing if there are none."""
    found = [p for p in files if p.suffix.lower() in IMAGE_SUFFIXES and not p.is_file()]
    if not found:
        return []
    return [
        f"{counted(len(found), 'link')} to photos that are missing, such as "
        f"{printable(str(found[0].relative_to(root)))}; they are left out; copy the photos, or "
        "connect their disk"
    ]


def _period_folders(root: Path, photos: Sequence[Path]) -> tuple[list[_Listed], list[str]]:
    """List photos by subfolder, and say which lie beside these.

    None are listed with only one subfolder, or if more photos lie beside the subfolders than in
    them: those are no periods.
    """
    beside = [p for p in photos if p.parent == root]
    inside = [p for p in photos if p.parent != root]
    tops = {p.relative_to(root).parts[0] for p in inside}
    if len(tops) < 2 or len(beside) > len(inside):
        return [], []
    listed = [
        _Listed(p, p.relative_to(root).as_posix(), p.relative_to(root).parts[0]) for p in inside
    ]
    return listed, _left_out(beside, "lie beside the folders of the periods")


def _only_folder(root: Path, photos: Sequence[Path]) -> str | None:
    """Return the name of the subfolder that has all photos; None if there is none."""
    tops = {p.relative_to(root).parts[0] for p in photos}
    return tops.pop() if len(tops) == 1 and photos[0].parent != root else None


def _left_out(photos: Sequence[Path], why: str) -> list[str]:
    """Name photos without a period; nothing if there are none."""
    if not photos:
        return []
    names = ", ".join(printable(p.name) for p in photos[:3])
    names += ", ..." if len(photos) > 3 else ""
    return [
        f"photos that {why}, so their period is unknown: {len(photos)} ({names}); they are left "
        "out; move them to the folder of their period, or give a table of images and periods "
        "(--table)"
    ]


def _from_table(root: Path, table: Path) -> list[_Listed]:
    """Read rows ``image, period`` of a CSV, in any order of columns."""
    listed: dict[str, _Listed] = {}
    for place, name, label in read_table(table, ("image", "file", "name")):
        found = _in_root(root, name)
        if not label or found is None:
            raise SceneError(
                place,
                expected="an image below the folder of the captures, and its period",
                found=f"{name!r}, {label!r}",
                todo="correct the line; paths are relative to the folder of the captures",
            )
        name, file = found  # ./a.jpg and a.jpg are one photo
        if name in listed and listed[name].label != label:
            raise SceneError(
                place,
                expected=f"one period of {name!r}",
                found=f"{listed[name].label!r} and {label!r}",
                todo="keep one of the two lines",
            )
        listed[name] = _Listed(file, name, label, Path(place).name)
    return list(listed.values())


def _in_root(root: Path, name: str) -> tuple[str, Path] | None:
    """Find the name and file of a table entry in the folder or its ``images/``.

    Returns:
        None if it is outside. A missing file counts as one of the folder itself.
    """
    slashes = PurePosixPath(name.replace("\\", "/"))  # tables of Windows
    if slashes.is_absolute() or ".." in slashes.parts or not slashes.parts:
        return None
    for pure in (PurePosixPath(name), slashes):
        for folder in (root, root / "images"):
            path = _respelt(folder, pure)
            if path.exists():
                return path.relative_to(folder).as_posix(), path
    return slashes.as_posix(), root / slashes


def _respelt(folder: Path, name: PurePosixPath) -> Path:
    """Return the path of a file whose accented letters may be in another form (`composed`)."""
    for part in name.parts:
        path = folder / part
        if not part.isascii() and not path.exists() and folder.is_dir():
            same = (p for p in folder.iterdir() if composed(p.name) == composed(part))
            path = next(same, path)
        folder = path
    return folder


def _by_date(root: Path, photos: list[Path]) -> tuple[list[_Listed], list[str], list[str]]:
    """Split photos of one folder into periods, at gaps of `PERIOD_GAP_DAYS` between dates.

    Returns:
        Photos with their periods, remarks, and what is said about photos without a period.
    """
    times = {p: taken_at(p, read_exif(p)) for p in photos}
    dated = sorted((t, p) for p, t in times.items() if t is not None)
    undated = [p for p in photos if times[p] is None]
    groups: list[list[tuple[datetime, Path]]] = []
    for item in dated:
        if not groups or (item[0] - groups[-1][-1][0]).days >= PERIOD_GAP_DAYS:
            groups.append([])
        groups[-1].append(item)
    if len(groups) < 2 and undated:
        remark = f"{len(undated)} of {len(photos)} photos have no date: all are one period"
        label = _only_folder(root, photos) or root.name
        return [_Listed(p, p.relative_to(root).as_posix(), label) for p in photos], [remark], []
    listed = []
    for group in groups:
        label = group[0][0].date().isoformat()
        listed += [_Listed(p, p.relative_to(root).as_posix(), label) for _, p in group]
    labels = ", ".join(f"{g[0][0].date()} ({counted(len(g), 'photo')})" for g in groups)
    remark = f"periods proposed from the dates of the photos: {labels}"
    return listed, [remark], _left_out(undated, "have no date")


def _assemble(
    root: Path,
    listed: Sequence[_Listed],
    proposed: Sequence[str] | None = None,
    left_out: Sequence[str] = (),
) -> Captures:
    """Open all photos.

    Args:
        root: Folder of the captures.
        listed: Files with the labels of their periods.
        proposed: Remarks on periods that were proposed from dates; None for given periods, whose
            photos may contradict them.
        left_out: What is said about photos without a period.
    """
    if not listed:
        videos = [p for p in _files_in(root) if p.suffix.lower() in VIDEOS]
        if videos and not left_out:
            name = videos[0].relative_to(root)
            todo = f"take frames from them, two a second: ffmpeg -i {name} -r 2 -q:v 2 %04d.jpg"
            raise _nothing(root, f"{counted(len(videos), 'video')}, and no image files", todo)
        raise _nothing(root, left_out[0] if left_out else "no image files")
    _check_names(root, [item.name for item in listed])
    order = _ordered_labels(listed)
    images, refused = [], []
    numbers = [order.index(item.label) for item in listed]
    with ThreadPoolExecutor(available_threads()) as pool:
        paths, names = [item.path for item in listed], [item.name for item in listed]
        opened = list(pool.map(open_photo, paths, names, numbers))
    for item, period, capture in zip(listed, numbers, opened, strict=True):
        if isinstance(capture, str):
            reason = f"{item.row}: {capture}" if item.row else capture
            refused.append((item.name, period, reason))
        else:
            images.append(capture)
    if not images:
        raise _nothing(root, f"{len(refused)} files, none usable ({refused[0][2]})")
    images.sort(key=lambda c: c.name)
    dated = [
        [(c.name, c.taken.date()) for c in images if c.period == i and c.taken is not None]
        for i in range(len(order))
    ]
    none: list[_Dated] = [[] for _ in order]
    wrong = _contradictions(order, dated) if proposed is None else none
    periods = tuple(
        CapturePeriod(label, period_date(label, {day for _, day in set(mine) - set(others)}))
        for label, mine, others in zip(order, dated, wrong, strict=True)
    )
    shown = ", ".join(f"{i} = {p.label} ({p.date or 'no date'})" for i, p in enumerate(periods))
    misdated = tuple(
        f"period {label}: {len(others)} of {len(mine)} photos have another date (EXIF, or file "
        f"name), such as {others[0][0]}: {others[0][1]}; move them to their period, or ignore this "
        "if the clock of the camera was wrong"
        for label, mine, others in zip(order, dated, wrong, strict=True)
        if others
    )
    unused = (*_unplaced(images), *_unmasked(root, images))
    remarks = (*(proposed or ()), f"periods: {shown}", *left_out, *misdated, *unused)
    disputed = {name for others in wrong for name, _ in others}
    return Captures(
        root,
        tuple(images),
        periods,
        tuple(refused),
        remarks,
        misdated,
        left_out=tuple(left_out),
        unused=unused,
        undisputed=frozenset(c.path for c in images if c.name not in disputed),
    )


def _unplaced(images: Sequence[Capture]) -> tuple[str, ...]:
    """Name photos whose GPS position is not used; nothing if there are none."""
    reasons = (
        (
            [c.name for c in images if c.exif.no_hemisphere],
            "without N or S, or without E or W; it is not used; write what is missing with "
            "exiftool (GPSLatitudeRef, GPSLongitudeRef)",
        ),
        (
            [c.name for c in images if c.exif.is_void],
            "that the receiver marked as void (GPSStatus V); it is not used; if it is right, "
            "delete the mark (exiftool -GPSStatus=)",
        ),
    )
    return tuple(
        f"{len(found)} of {len(images)} photos, such as {found[0]}, have a GPS position {reason}"
        for found, reason in reasons
        if found
    )


def _unmasked(root: Path, images: Sequence[Capture]) -> tuple[str, ...]:
    """Name a folder of masks of which no photo has one; nothing if there is none."""
    folders = [
        folder for parent in (root, root.absolute().parent) if (folder := parent / MASKS).is_dir()
    ]
    if not folders or any(c.mask for c in images):
        return ()
    name = images[0].name
    return (f"no mask in {folders[0]} is used: that of {name} would be {mask_place(name)}",)


_Dated = list[tuple[str, date]]  # Names of photos, and when they were taken


def _contradictions(labels: Sequence[str], dated: Sequence[_Dated]) -> list[_Dated]:
    """Find the photos of each period whose dates contradict it.

    A photo does so if it was taken more than `PERIOD_GAP_DAYS` from its period and within another
    one. Where the label of its period is a date, either is enough.
    """
    named = [_named_span(label) for label in labels]
    spans = [n or _usual_span([d for _, d in mine]) for n, mine in zip(named, dated, strict=True)]

    def contradicts(day: date, period: int) -> bool:
        away = _days_from(day, spans[period])
        elsewhere = any(s is not None and _days_from(day, s) == 0 for s in spans)
        if named[period] is None:
            return away > PERIOD_GAP_DAYS and elsewhere
        return away > PERIOD_GAP_DAYS or (away > 0 and elsewhere)

    return [[photo for photo in mine if contradicts(photo[1], i)] for i, mine in enumerate(dated)]


def _named_span(label: str) -> tuple[date, date] | None:
    """First and last day of the year, month or day that a label begins with."""
    found = re.match(r"((?:19|20)\d\d)(?:[-_.]?(\d\d))?(?:[-_.]?(\d\d))?(?=$|[-_. ])", label)
    if found is None:
        return None
    year, month, day = (int(part) if part else None for part in found.groups())
    assert year is not None
    try:
        first = date(year, month or 1, day or 1)
    except ValueError:
        return None
    if day:
        return first, first
    after = date(year + (month or 12) // 12, (month or 12) % 12 + 1, 1)
    return first, after - timedelta(days=1)


def _usual_span(days: Sequence[date]) -> tuple[date, date] | None:
    """First and last day without the first and the last quarter; None if there are no days."""
    ordered = sorted(days)
    cut = len(ordered) // 4
    return (ordered[cut], ordered[-1 - cut]) if ordered else None


def _days_from(day: date, span: tuple[date, date] | None) -> int:
    """Days between a day and a span; 0 inside, or if there is none."""
    if span is None:
        return 0
    return max(0, (span[0] - day).days, (day - span[1]).days)


def _ordered_labels(listed: Iterable[_Listed]) -> list[str]:
    """Sort labels by the dates of their photos if all have one, else in natural order."""
    by_label = grouped((item.label, item.path) for item in listed)
    first: dict[str, datetime] = {}
    for label, paths in by_label.items():
        times = [t for p in paths if (t := taken_at(p, read_exif(p))) is not None]
        if times:
            first[label] = sorted(times)[len(times) // 2]
    if len(first) == len(by_label):
        return sorted(by_label, key=lambda label: (first[label], label))
    return sorted(by_label, key=natural_key)


def period_date(label: str, dates: Iterable[date]) -> str | None:
    """Find the day, month or year that all photos of a period share; the median year if none."""
    days = sorted(dates)
    if not days:
        return label if is_iso_date(label) else None
    first, last = days[0], days[-1]
    if first == last:
        return first.isoformat()
    if (first.year, first.month) == (last.year, last.month):
        return first.isoformat()[:7]
    return str(first.year) if first.year == last.year else str(days[len(days) // 2].year)


def _check_names(root: Path, names: Iterable[str]) -> None:
    """Refuse names that a line of split.txt cannot represent."""
    for name in names:
        expected = ""
        if name != name.strip() or re.search(r"[\r\n]", name):
            expected = "image names without line breaks and without leading or trailing blanks"
        elif re.search(r"[\ud800-\udfff]", name):  # how Python shows bytes that are no text
            expected = "image names in UTF-8"
        if expected:
            raise SceneError(root, expected=expected, found=repr(name), todo="rename the image")


def _nothing(path: Path, found: str, todo: str = "copy the photos there") -> SceneError:
    return SceneError(
        path,
        expected="a folder of photos, or a CSV table of images and their periods",
        found=found,
        todo=todo,
    )
