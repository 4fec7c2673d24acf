"""Files of tie points and ground control that a person clicked.

Two forms are read. A CSV has a row for each click: point id, image, x, y, and for surveyed points
also their world coordinates, their role (control, or check) and the accuracy of the coordinates;
a row may lack the click where a point was surveyed, but is seen in no photo. OpenDroneMap's
``gcp_list.txt`` has a line with the projection, then ``geo_x geo_y geo_z im_x im_y image_name
[gcp_name]`` for each click; check points have names that start with ``CHK-``. Pixels are those of
the photo as stored, without its orientation tag applied; the corner of the image is (0, 0).
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np

from chronoscene.arrays import Array
from chronoscene.errors import SceneError
from chronoscene.formats.shared.grouping import natural_key
from chronoscene.geodesy import Georeference, ReferenceSystem, read_reference_system
from chronoscene.io.documents import filled_lines, read_text
from chronoscene.scene.splits import composed

COLUMNS = {
    "point": ("point", "point id", "point_id", "id", "name", "label"),
    "image": ("image", "image name", "image_name", "file", "photo"),
    "x": ("x", "im_x", "u", "col"),
    "y": ("y", "im_y", "v", "row"),
    "world x": ("world x", "world_x", "wx", "geo_x", "e", "east", "easting", "longitude", "lon"),
    "world y": ("world y", "world_y", "wy", "geo_y", "n", "north", "northing", "latitude", "lat"),
    "world z": ("world z", "world_z", "wz", "geo_z", "h", "up", "height", "altitude", "elevation"),
    "role": ("role",),
    "sigma x": ("sx", "sigma_x", "accuracy_x"),
    "sigma y": ("sy", "sigma_y", "accuracy_y"),
    "sigma z": ("sz", "sigma_z", "accuracy_z"),
}
"""Names of columns, in lower case; upper-case X, Y, Z are world coordinates, unless no other
column can be the pixels."""

WORLD = ("world x", "world y", "world z")
DEGREES = ("longitude", "lon", "latitude", "lat")  # Names of columns that are never in metres

_CRS = re.compile(r"#\s*(?:crs(?:\s*[:=]|\s)\s*(?=\S)|(?=EPSG:\d+$))(.+)", re.IGNORECASE)
_TODO_CSV = "write lines such as: corner1,2016/IMG_0001.jpg,812.5,334.0"
_TODO_SEPARATORS = "separate the fields by commas, and write decimals with a point"
_TODO_ODM = "write lines such as: 544256.7 5320919.9 5.0 3044.5 2622.0 IMG_0525.jpg gcp01"


Place = tuple[float, float, float]

Role = Literal["tie", "control", "check"]
"""``control`` places the model in the world, ``check`` takes no part in the estimation, and ``tie``
has no world coordinates."""

CHECK_PREFIX = "CHK-"  # Of the names of check points in OpenDroneMap's lists


@dataclass(frozen=True, slots=True)
class Click:
    """One point in one image."""

    image: str
    """Name of the image in the file."""
    x: float
    """Pixels."""
    y: float
    line: int
    """Line of the file, from 1."""


@dataclass(frozen=True, slots=True)
class TiePoint:
    """A point of the scene that a person found in images."""

    name: str
    clicks: tuple[Click, ...]
    world: Place | None
    """Surveyed coordinates, in the file's reference system."""
    role: Role
    sigma: Place | None = None
    """Stated standard deviations of ``world``, metres east, north and up."""


@dataclass(frozen=True, slots=True)
class TiePoints:
    """Content of a file of tie points."""

    path: Path
    points: tuple[TiePoint, ...]
    """Sorted by name."""
    crs: ReferenceSystem | None
    """Reference system of the world coordinates; None for that of the model."""

    @property
    def images(self) -> set[str]:
        """Images with clicks."""
        return {c.image for p in self.points for c in p.clicks}

    def names(self, role: Role) -> set[str]:
        """Names of the points of a role."""
        return {p.name for p in self.points if p.role == role}

    def sigmas(self) -> dict[str, Array]:
        """Stated standard deviations, metres east, north and up. Name -> [3]"""
        return {p.name: np.array(p.sigma) for p in self.points if p.sigma is not None}

    def located(self, frame: Georeference | None) -> dict[str, Array]:
        """Surveyed coordinates in a local frame; none if there is no frame. Name -> [3]

        Raises:
            SceneError: If points lie outside of the area of the reference system.
        """
        known = {p.name: p.world for p in self.points if p.world is not None}
        if self.crs is None or not known:
            return {name: np.array(xyz) for name, xyz in known.items()}
        if frame is None:
            return {}
        enu = self.crs.to_local(frame, np.array(list(known.values())))
        lost = [n for n, place in zip(known, enu, strict=True) if not np.isfinite(place).all()]
        if lost:
            raise SceneError(
                self.path,
                expected=f"world coordinates that lie within {self.crs.text}",
                found=f"{list(known[lost[0]])} of {lost[0]}",
                todo="check the reference system, and the order east, north, height",
            )
        return dict(zip(known, enu, strict=True))


def read_tie_points(
    path: Path, *, scale: float = 1.0, crs: ReferenceSystem | None = None
) -> TiePoints:
    """Read tie points or ground control from a CSV or from ODM's ``gcp_list.txt``.

    Args:
        path: The file.
        scale: Size of the photos in units of those that were clicked in.
        crs: Reference system, if the file names none.

    Raises:
        SceneError: If a line is wrong; the message names it.
    """
    filled = [(n, line.strip()) for n, line in filled_lines(read_text(Path(path)))]
    if not filled:
        raise SceneError(path, expected="tie points", found="an empty file", todo=_TODO_CSV)
    if re.match(r"(\+proj|EPSG:|WGS84)", filled[0][1], re.IGNORECASE):
        crs = _projection(path, filled[0][1])
        rows = _odm_rows(path, filled[1:])
    else:
        plain = ((n, line.rstrip(", ")) for n, line in filled)  # commas of a spreadsheet
        named = ((n, found[1]) for n, line in plain if (found := _CRS.fullmatch(line)))
        crs = next((read_reference_system(f"{path}:{n}", text) for n, text in named), crs)
        rows = _csv_rows(path, [(n, line) for n, line in filled if not line.startswith("#")], crs)
    scaled = (
        replace(r, click=replace(r.click, x=scale * r.click.x, y=scale * r.click.y)) for r in rows
    )
    return _assemble(path, scaled, crs)


@dataclass(frozen=True, slots=True)
class _Row:
    """One line of a file."""

    point: str
    click: Click
    """Without a name of an image if the line has no click."""
    world: Place | None
    role: Role | None
    sigma: Place | None = None


def _assemble(path: Path, rows: Iterable[_Row], crs: ReferenceSystem | None) -> TiePoints:
    """Group clicks by point; refuse two places, roles or accuracies of one point."""
    clicks: dict[str, dict[str, Click]] = {}
    worlds: dict[str, Place] = {}
    sigmas: dict[str, Place] = {}
    roles: dict[str, Role] = {}
    stated: dict[str, int] = {}
    moved: dict[str, int] = {}
    for row in rows:
        name, click, world, role = row.point, row.click, row.world, row.role
        mine = clicks.setdefault(name, {})
        if row.sigma is not None and sigmas.setdefault(name, row.sigma) != row.sigma:
            raise _wrong(
                path, click.line, f"the same accuracies of point {name!r} on all its lines",
                f"{row.sigma} after {sigmas[name]}", "correct one of them",
            )  # fmt: skip
        if click.image in mine:
            raise _second_click(path, name, click, mine[click.image].line)
        if click.image:
            mine[click.image] = click
        if world is not None and worlds.setdefault(name, world) != world:
            moved.setdefault(name, click.line)
        if role is not None and roles.setdefault(name, role) != role:
            raise _wrong(
                path, click.line, f"the same role of point {name!r} on all its lines",
                f"{role} after {roles[name]}", "correct one of them",
            )  # fmt: skip
        if role is not None:
            stated.setdefault(name, click.line)
    for name, line in stated.items():
        if name not in worlds:
            raise _wrong(
                path, line, f"world coordinates of the {roles[name]} point {name!r}", "none",
                "add them, or leave the role empty",
            )  # fmt: skip
    if moved:
        named = ", ".join(f"{name} (line {line})" for name, line in moved.items())
        raise _wrong(
            path, min(moved.values()), "the same world coordinates on all lines of a point",
            f"other ones for {named}", "correct them, or give the points two names",
        )  # fmt: skip
    points = tuple(
        TiePoint(
            name,
            tuple(mine.values()),
            worlds.get(name),
            roles.get(name, "control" if name in worlds else "tie"),
            sigmas.get(name),
        )
        for name, mine in sorted(clicks.items(), key=lambda item: natural_key(item[0]))
    )
    if not points:
        raise SceneError(path, expected="tie points", found="no clicks", todo=_TODO_CSV)
    return TiePoints(Path(path), points, crs)


def _csv_rows(
    path: Path, lines: Sequence[tuple[int, str]], crs: ReferenceSystem | None
) -> Iterator[_Row]:
    cells = [(n, [c.strip() for c in next(csv.reader([line]))]) for n, line in lines]
    order = _header(path, *cells[0]) if cells else None
    if order is None:
        order, width = {name: i for i, name in enumerate(COLUMNS)}, len(COLUMNS)
    else:
        _check_world(path, order, *cells[0], [row for _, row in cells[1:]])
        if crs is None or crs.is_projected:
            _check_metres(path, order, *cells[0], "none" if crs is None else crs.text)
        width, cells = len(cells[0][1]), cells[1:]
    for number, row in cells:
        if any(row[width:]):
            raise _wrong(
                path, number, f"{width} fields", f"{len(row)}",
                _TODO_SEPARATORS,
            )  # fmt: skip
        if len(row) <= max(order[name] for name in ("point", "image", "x", "y")):
            found = f"{len(row)} fields"
            todo = _todo(row)
            raise _wrong(path, number, "point id, image, x, y", found, todo)
        point, image = row[order["point"]], row[order["image"]]
        cell = {name: row[i] for name, i in order.items() if i < len(row)}
        world = _three(path, number, cell, "world", "world coordinates")
        unseen = world is not None and not any(cell[k] for k in ("image", "x", "y"))
        if not point or not (image or unseen):
            raise _wrong(path, number, "a point id and an image", f"{row[:4]}", _TODO_CSV)
        xy = [0.0 if unseen else _number(path, number, cell[name], name) for name in ("x", "y")]
        sigma = _three(path, number, cell, "sigma", "accuracies")
        if sigma is not None and min(sigma) <= 0:
            raise _wrong(
                path, number, "accuracies above 0, in metres", f"{sigma}", "leave unknown ones out"
            )
        role = _role(path, number, cell.get("role", ""))
        yield _Row(point, Click(image, xy[0], xy[1], line=number), world, role, sigma)


def _three(
    path: Path, number: int, cell: Mapping[str, str], prefix: str, what: str
) -> Place | None:
    """Numbers in three columns; None if all of them are empty."""
    texts = [cell[f"{prefix} {axis}"] for axis in "xyz" if cell.get(f"{prefix} {axis}")]
    if not texts:
        return None
    if len(texts) != 3:
        raise _wrong(path, number, f"three {what}, or none", f"{len(texts)}", _TODO_CSV)
    x, y, z = (_number(path, number, text, f"one of the {what}") for text in texts)
    return x, y, z


def _role(path: Path, number: int, text: str) -> Role | None:
    """Role in a field; None if it is empty."""
    known: dict[str, Role | None] = {"": None, "control": "control", "check": "check"}
    if text.lower() not in known:
        raise _wrong(path, number, "the role control or check", repr(text[:40]), "correct the line")
    return known[text.lower()]


def _header(path: Path, number: int, row: Sequence[str]) -> dict[str, int] | None:
    """Column of each field by name; None if the first line is data."""
    if len(row) > 3 and all(_is_number(text) or not text for text in row[2:4]):
        return None
    order: dict[str, int] = {}
    others = {name.lower() for name in row if name not in ("X", "Y", "Z")}
    has_pixels = not others.isdisjoint((*COLUMNS["x"], *COLUMNS["y"]))
    world = dict(zip("XYZ", WORLD, strict=True))
    for i, name in enumerate(row):
        if name in world and has_pixels:
            order[world[name]] = i
            continue
        for key, names in COLUMNS.items():
            if name.lower() not in names:
                continue
            if order.setdefault(key, i) != i and key not in ("point", "image"):
                raise _wrong(
                    path, number, f"one column of the {key} of a point",
                    f"{row[order[key]]} and {name}", "rename the one that does not count",
                )  # fmt: skip
    missing = [key for key in ("point", "image", "x", "y") if key not in order]
    if missing:
        raise _wrong(
            path, number, "a header with point, image, x, y, or a line of data",
            f"no {', '.join(missing)} in {','.join(row)[:80]!r}",
            _todo(row),
        )  # fmt: skip
    return order


def _check_world(
    path: Path, order: Mapping[str, int], number: int, head: Sequence[str], rows: list[list[str]]
) -> None:
    """Refuse columns that may be world coordinates under names that are not known."""
    others = [
        name
        for i, name in enumerate(head)
        if i not in order.values()
        and any(_is_number(cell) for row in rows for cell in row[i : i + 1])
    ]
    if len(others) >= len(WORLD) and order.keys().isdisjoint(WORLD):
        raise _wrong(
            path, number, "E, N, h, or another known name of each column of world coordinates",
            f"columns of numbers that are not known: {', '.join(others)}", "rename or remove them",
        )  # fmt: skip


def _check_metres(
    path: Path, order: Mapping[str, int], number: int, head: Sequence[str], found: str
) -> None:
    """Refuse longitudes and latitudes, which would count as metres."""
    used = [head[order[key]] for key in WORLD if key in order]
    names = [name for name in used if name.lower() in DEGREES]
    if names:
        raise _wrong(
            path, number, f"a reference system in degrees for {' and '.join(names)}", found,
            "write above the header: # crs: EPSG:4326; if they are metres, call the columns E, N",
        )  # fmt: skip


def _odm_rows(path: Path, lines: Sequence[tuple[int, str]]) -> Iterator[_Row]:
    for number, line in lines:
        if line.startswith("#"):
            continue
        fields = line.split("\t") if line.count("\t") >= 5 else line.split()
        fields = [f.strip() for f in fields]
        if len(fields) < 6:
            raise _wrong(
                path, number, "geo_x geo_y geo_z im_x im_y image_name [gcp_name]",
                f"{len(fields)} fields", _TODO_ODM,
            )  # fmt: skip
        names = ("geo_x", "geo_y", "geo_z", "im_x", "im_y")
        x, y, z, u, v = (
            _number(path, number, f, n) for f, n in zip(fields[:5], names, strict=True)
        )
        # Without a name, a point is known by where it is.
        point = fields[6] if len(fields) > 6 and fields[6] else f"{fields[0]} {fields[1]}"
        role: Role = "check" if point.startswith(CHECK_PREFIX) else "control"
        yield _Row(point, Click(fields[5], u, v, line=number), (x, y, z), role)


def _projection(path: Path, line: str) -> ReferenceSystem:
    """Read the first line of ``gcp_list.txt``: PROJ, EPSG, or ``WGS84 UTM 32N``."""
    text = "EPSG:4326" if line.upper() == "WGS84" else line
    if utm := re.fullmatch(r"WGS84\s+UTM\s+(\d{1,2})\s*([NS])", line, re.IGNORECASE):
        zone = int(utm[1])
        if 1 <= zone <= 60:
            text = f"EPSG:{(32600 if utm[2].upper() == 'N' else 32700) + zone}"
    return read_reference_system(f"{path}:1", text)


def by_photo(tie_points: TiePoints, sizes: Mapping[str, tuple[int, int] | None]) -> TiePoints:
    """Give clicks the full names of their photos; a name that fits none stays.

    An image may be named by its whole path or by the end of it, where that is unique, and as it
    was before registration, which replaces blanks and converts some photos to PNG.

    Args:
        tie_points: From `read_tie_points`.
        sizes: Width and height of all photos by name, because one that gets no pose may be the one
            that is meant; None for those that cannot be read.

    Raises:
        SceneError: If a name fits several photos, no click fits any at all, one lies outside of its
            photo, or a point has two in one photo.
    """
    names = list(sizes)
    fits: dict[str, list[str]] = {}
    for click in (c for p in tie_points.points for c in p.clicks):
        if click.image not in fits:
            fits[click.image] = _names_of(click.image, names)
        if len(ends := fits[click.image]) > 1:
            raise _wrong(
                tie_points.path, click.line, "the name of one image",
                f"{click.image!r}, which fits {ends[0]} and {ends[1]}",
                "write the name with its folder, as in the scene",
            )  # fmt: skip
    if fits and not any(fits.values()):
        first = next(c for p in tie_points.points for c in p.clicks)
        raise _wrong(
            tie_points.path, first.line, f"names of photos, such as {names[0]}", first.image,
            "correct the names",
        )  # fmt: skip
    full = {image: ends[0] for image, ends in fits.items() if ends}
    points = []
    for point in tie_points.points:
        clicks = [replace(c, image=full.get(c.image, c.image)) for c in point.clicks]
        lines: dict[str, int] = {}
        for click in clicks:
            if lines.setdefault(click.image, click.line) != click.line:
                raise _second_click(tie_points.path, point.name, click, lines[click.image])
            size = sizes.get(click.image)
            if size and not (0 <= click.x <= size[0] and 0 <= click.y <= size[1]):
                raise _wrong(
                    tie_points.path, click.line,
                    f"a pixel of {click.image} ({size[0]} x {size[1]})",
                    f"{click.x:g}, {click.y:g}",
                    "correct the line; if it was clicked in photos of another size, give the "
                    "ratio (--tie-scale)",
                )  # fmt: skip
        points.append(replace(point, clicks=tuple(clicks)))
    return replace(tie_points, points=tuple(points))


def _names_of(image: str, names: Sequence[str]) -> list[str]:
    """Names that an image may mean: as it is written, or as `place_photos` renames a photo.

    Where another photo had the name without blanks, the renamed one has a number, so that a name
    with blanks may mean either.
    """
    written = PurePosixPath(image.replace("\\", "/")).as_posix()
    plain = re.sub(r"\s", "_", written)
    if found := _ending(written, names):
        return found
    if found := _ending(plain, names):
        numbered = PurePosixPath(plain).with_stem(f"{PurePosixPath(plain).stem}_2")
        return found + (_ending(str(numbered), names) if plain != written else [])
    if found := _ending(f"{plain}.png", names):
        return found
    # For `mark`, photos have the names of before registration.
    return [n for n in names if _ending(plain, [new := re.sub(r"\s", "_", n), f"{new}.png"])]


def _ending(name: str, names: Sequence[str]) -> list[str]:
    """Return the name itself, if it is there, or those of which it is the end."""
    if name in names:
        return [name]
    plain = composed(name)
    whole = [n for n in names if composed(n) == plain]
    return whole or [n for n in names if composed(n).endswith(f"/{plain}")]


def _todo(row: Sequence[str]) -> str:
    """Return advice on a line with too few fields."""
    return _TODO_SEPARATORS if re.search(r"[;\t]", "".join(row)) else _TODO_CSV


def _second_click(path: Path, point: str, click: Click, first: int) -> SceneError:
    return _wrong(
        path, click.line, f"one click of point {point!r} in {click.image}",
        f"another one on line {first}", "remove one of the two lines",
    )  # fmt: skip


def _number(path: Path, line: int, text: str, what: str) -> float:
    if not _is_number(text):
        todo = "write decimals with a point" if "," in text else "correct the line"
        raise _wrong(path, line, f"a number for {what}", repr(text[:40]), todo)
    return float(text)


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def _wrong(path: Path, line: int, expected: str, found: str, todo: str) -> SceneError:
    return SceneError(f"{path}:{line}", expected=expected, found=found, todo=todo)
