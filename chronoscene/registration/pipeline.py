"""From captures to a registered scene: the stages, in order, each of which is done once."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from chronoscene.errors import ConfigError, SceneError
from chronoscene.geometry import camera_centre
from chronoscene.images import image_size
from chronoscene.registration import assembly, output, prepare
from chronoscene.registration.cameras import camera_groups
from chronoscene.registration.captures import Capture, Captures
from chronoscene.registration.errors import RegistrationError
from chronoscene.registration.georeference import Georeference, Positions, from_crs, locate
from chronoscene.registration.inspection import Inspection, inspect_registration
from chronoscene.registration.kept_bits import copy_poses, pose_bytes
from chronoscene.registration.model import Registered, Route
from chronoscene.registration.pairs import EXHAUSTIVE_LIMIT
from chronoscene.registration.stages import Stages, fingerprint, work_folder
from chronoscene.registration.tie_alignment import TieAlignment
from chronoscene.registration.tie_points import read_tie_points
from chronoscene.registration.tying import tie
from chronoscene.registration.worker import Report, run_step
from chronoscene.scene import Frame, Scene
from chronoscene.threads import available_threads

SCHEMA_VERSION = 1

LEAST_CROSS_PAIRS = 3
LEAST_CROSS_MATCHES = 100
"""Verified pairs of images, and matches in them, with which two periods count as connected."""

LEAST_SHARE = 0.6
"""Share of the photos of each period that the joint route must place; else periods are also tried
one by one."""

SAME_PLACE = 0.01
"""Share of the usual distance between neighbours; nobody stands so exactly where he stood."""

Inspected = Callable[[Inspection], None]
"""Called with the certificate and the verdict."""


@dataclass(frozen=True, slots=True)
class Options:
    """How to register."""

    route: Route | None = None
    """None to choose: joint where periods are connected by matches, else separate."""
    work: Path | None = None
    """Folder for what is kept between runs; None for ``<out>.work``."""
    overwrite: bool = False
    """Whether an earlier registration at the place of the output may be replaced."""
    max_image_size: int = 1600
    """Pixels; larger photos are scaled down for finding features."""
    max_features: int = 4096
    """Of each photo."""
    exhaustive_limit: int = EXHAUSTIVE_LIMIT
    """Number of photos up to which all pairs are matched."""
    held_out: float = 0.1
    """Share of the tracks across periods that take no part in estimation."""
    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP's camera model for the photos."""
    threads: int | None = None
    """None for one per processor. With 1, results are the same to the last bit in every run."""
    seed: int = 0
    """Of the draw of held-out tracks."""
    tie_points: Path | None = None
    """File of tie points or ground control."""
    tie_scale: float = 1.0
    """Size of the photos here over that of those which were clicked in."""
    page: bool = False
    """Whether to write the page for people beside the scene."""


def run(
    captures: Captures,
    out: Path,
    options: Options | None = None,
    *,
    report: Report | None = None,
    inspected: Inspected | None = None,
) -> Registered:
    """Register all periods and write a scene.

    Raises:
        RegistrationError: If no model comes out; what was computed is kept in the work folder.
        SceneError: If ``out`` is in use.
    """
    options = options or Options()
    return _Run(captures, None, Path(out), options, report, inspected).run()


def run_into(
    scene: Scene,
    captures: Captures,
    out: Path,
    options: Options | None = None,
    *,
    report: Report | None = None,
    inspected: Inspected | None = None,
) -> Registered:
    """Add the captures to a scene as one new period, and write a new scene; the old poses stay.

    Raises:
        RegistrationError: If none of the photos can be placed, or the scene has distortion.
        SceneError: If ``out`` is in use.
    """
    options = options or Options()
    return _Run(captures, scene, Path(out), options, report, inspected).run()


@dataclass
class _Run:
    """One run. The stages hand each other what JSON holds, and files of the work folder."""

    captures: Captures
    scene: Scene | None
    """The scene that gets a new period."""
    out: Path
    options: Options
    report: Report | None
    inspected: Inspected | None

    def run(self) -> Registered:
        output.check_free(self.out, overwrite=self.options.overwrite)
        default = self.out.with_name(f"{self.out.name}.work")
        self.work = (self.options.work or default).resolve()
        with work_folder(self.work):
            self.stages = Stages(self.work)
            self._prepare()
            features = self._features()
            self._matches()
            held = self._hold_out()
            registered = self._estimate(features, held)
            registered, ties = self._tie(registered)
            self._write(registered, ties)
        return registered

    def _tie(self, registered: Registered) -> tuple[Registered, TieAlignment | None]:
        """Heed the tie points, if there are any."""
        if self.options.tie_points is None:
            return registered, None
        if self.scene is not None:
            raise ConfigError(
                "--tie-points",
                expected="a registration of all periods",
                found="--into, which moves nothing that is there",
                todo="leave one of the two out",
            )
        points = read_tie_points(self.options.tie_points, scale=self.options.tie_scale)

        def refine(arguments: Mapping[str, Any]) -> Registered:
            return self._refined(registered, arguments)

        result = tie(registered, points, refine)
        self.stages.remark("tie points", *result.remarks)
        return result.model, result

    def _refined(self, registered: Registered, arguments: Mapping[str, Any]) -> Registered:
        """A registration adjusted anew after its periods were moved."""

        def refine() -> tuple[Any, list[str]]:
            found = self._step("refine", {**self._places("refined"), **arguments})
            return found, [*found["remarks"], _numbers(found["model"])]

        result = self.stages.run("refined", arguments, refine)
        parts = self._parts(registered.route, result)
        again = assembly.assemble(self.work / "model-refined", self.work / "held_out.npz", parts)
        lost = set(registered.names) - set(again.names)
        reason = "lost when the model was adjusted by tie points"
        return replace(
            again,
            unregistered=dict(registered.unregistered) | dict.fromkeys(lost, reason),
            unregistered_periods=dict(registered.unregistered_periods)
            | {n: self.periods[n] for n in lost},
        )

    def _prepare(self) -> None:
        """Photos, their names and periods, and what they say about where they were."""
        remarks = list(self.captures.remarks)
        remarks += [f"{name}: {reason}" for name, _, reason in self.captures.refused]
        self.stages.remark("captures", *remarks)
        unique = prepare.drop_copies(
            self.captures.images, prepare.content_digests(self.captures.images)
        )
        self.refused = (*self.captures.refused, *unique.refused)
        self._check_enough(unique.captures)
        self.photos = self.work / "photos"
        source = self._as_new_period(unique.captures) if self.scene else unique.captures
        inputs = [
            [c.name, str(c.path.resolve()), unique.digests[o.name]]
            for c, o in zip(source, unique.captures, strict=True)
        ]
        inputs += [[f.name, str(self.scene.image_path(f))] for f in self._old_frames()]  # type: ignore[union-attr]
        names = self.stages.run("photos", inputs, lambda: self._place(source, unique.remarks))
        self.images = prepare.renamed(source, names)
        self.periods = {c.name: c.period for c in self.images}
        self.periods |= {f.name: f.period for f in self._old_frames()}
        self.positions, self.georeference = self._locate()

    def _check_enough(self, captures: Sequence[Capture]) -> None:
        if len(captures) < 2 and self.scene is None:
            raise RegistrationError(
                self.captures.root,
                expected="at least two photos",
                found=f"{len(captures)} that can be used",
                todo="add photos that overlap",
            )
        present = {c.period for c in captures}
        for i, period in enumerate(self.captures.periods):
            if i not in present:
                self.stages.remark("captures", f"period {period.label} has no photo left")

    def _as_new_period(self, captures: Sequence[Capture]) -> tuple[Capture, ...]:
        """All captures as the one period after those of the scene, under names it does not have."""
        assert self.scene is not None
        taken = {f.name for f in self.scene.frames}
        label = self._new_label
        new = []
        for capture in captures:
            name = capture.name if "/" in capture.name else f"{label}/{capture.name}"
            while name in taken:
                name = f"new/{name}"
            taken.add(name)
            new.append(replace(capture, name=name, period=self.scene.num_periods))
        return tuple(new)

    def _old_frames(self) -> tuple[Frame, ...]:
        return self.scene.frames if self.scene else ()

    def _place(
        self, captures: Sequence[Capture], remarks: Sequence[str]
    ) -> tuple[list[str], list[str]]:
        shutil.rmtree(self.photos, ignore_errors=True)
        names, told = prepare.place_photos(captures, self.photos)
        for frame in self._old_frames():
            assert self.scene is not None
            _check_pinhole(self.scene, frame)
            prepare.link(self.scene.image_path(frame), self.photos / frame.name)
        return names, [*remarks, *told]

    def _locate(self) -> tuple[Positions, Georeference | None]:
        frame = None
        if self.scene is not None and self.scene.world.unit == "metre":
            frame = from_crs(self.scene.world.crs)
        positions = locate(self.images, frame)
        self.stages.remark("positions", *positions.remarks)
        return positions, positions.georeference if self.scene is None else frame

    def _step(self, step: str, arguments: Mapping[str, Any]) -> Any:
        return run_step(step, arguments, log=self.work / "log.txt", report=self.report)

    @property
    def _threads(self) -> int:
        return self.options.threads or available_threads()

    def _features(self) -> dict[str, Any]:
        groups = camera_groups(self.images, self.options.camera_model)
        if self.scene is not None:
            groups = _scene_groups(self.scene) + groups
        settings = {
            "groups": groups,
            "max_image_size": self.options.max_image_size,
            "max_features": self.options.max_features,
        }
        database = self._database("features", settings)
        arguments = settings | {
            "database": str(database),
            "photos": str(self.photos),
            "threads": self._threads,
        }

        def extract() -> tuple[Any, list[str]]:
            found = self._step("features", arguments)
            total = sum(found["keypoints"].values())
            known = sum(found["focal_known"].values())
            remark = (
                f"{total} features in {len(found['keypoints'])} photos, {len(groups)} cameras, "
                f"{known} with a focal length from EXIF or the scene"
            )
            return found, [remark]

        return dict(self.stages.run("features", settings, extract))

    def _database(self, name: str, settings: Any) -> Path:
        """The database of the features; a new one where other photos or settings made it."""
        self.database = self.work / f"{name}.db"
        mark = self.work / f"{name}.key"
        key = fingerprint(self.stages.previous, settings)
        if not mark.exists() or mark.read_text() != key:
            for suffix in ("", "-wal", "-shm"):
                Path(f"{self.database}{suffix}").unlink(missing_ok=True)
            mark.write_text(key)
        return self.database

    def _matches(self) -> None:
        listing = self.work / "pairs.txt"
        centres = self._centres()
        taken = {c.name: c.taken.isoformat() for c in self.images if c.taken is not None}
        listed = [
            {
                "name": name,
                "period": self.periods[name],
                "enu": centres.get(name),
                "taken": taken.get(name),
            }
            for name in sorted(self.periods)
        ]
        settings = {"images": listed, "exhaustive_limit": self.options.exhaustive_limit}

        def choose() -> tuple[Any, list[str]]:
            arguments = settings | {"database": str(self.database), "out": str(listing)}
            found = self._step("pairs", arguments)
            kinds = ", ".join(f"{n} {kind}" for kind, n in found["kinds"].items())
            told = f"{found['pairs']} pairs ({kinds}), {found['across_periods']} across periods"
            return found, [told]

        self.stages.run("pairs", settings, choose)

        def match() -> tuple[Any, list[str]]:
            arguments = {
                "database": str(self.database),
                "pairs": str(listing),
                "scratch": str(self.work),
                "threads": self._threads,
            }
            found = self._step("matches", arguments)
            pairs, verified, inliers = (found[k] for k in ("pairs", "verified", "inliers"))
            return found, [f"{verified} of {pairs} pairs verified, {inliers} matches"]

        self.stages.run("matches", None, match)

    def _centres(self) -> dict[str, list[float]]:
        """Where images were taken, in one frame, for choosing pairs."""
        known = {f.name: camera_centre(f.cam_from_world).tolist() for f in self._old_frames()}
        if self.scene is None or self.georeference is not None:
            known |= self._priors()["enu"]
        return known

    def _hold_out(self) -> dict[str, Any]:
        settings = {
            "periods": self.periods,
            "share": self.options.held_out,
            "seed": self.options.seed,
        }

        def hold_out() -> tuple[Any, list[str]]:
            arguments = settings | {
                "database": str(self.database),
                "out": str(self.work / "mapping.db"),
                "held_out": str(self.work / "held_out.npz"),
            }
            found = self._step("holdout", arguments)
            told = [
                f"{found['held_out']} of {found['tracks_of_several_periods']} tracks of several "
                "periods held out"
            ]
            for key, count in found["verified_pairs_across"].items():
                told.append(
                    f"periods {key}: {count} verified pairs, {found['matches_across'][key]} matches"
                )
            return found, told

        return dict(self.stages.run("holdout", settings, hold_out))

    def _estimate(self, features: Mapping[str, Any], held: Mapping[str, Any]) -> Registered:
        """The route, or the better of two."""
        route = self._route(held)
        result = self._run_route(route)
        registered = self._assemble(route, result, features, held)
        if route == "joint" and self.options.route is None and len(self._labels) > 1:
            shares = self._shares(registered)
            if min(shares) < LEAST_SHARE:
                worst = int(np.argmin(shares))
                self.stages.remark(
                    "route",
                    f"the joint model has {shares[worst]:.0%} of the photos of period {worst}: "
                    "periods are tried one by one too",
                )
                other = self._separate_or_none(features, held)
                if other is not None and min(self._shares(other)) > min(shares):
                    registered = other
        if self.scene is not None:
            self.stages.remark("route", *same_places(registered, self.scene.num_periods))
        counts = output.registered_counts(registered, self._totals())
        told = [f"period {c['label']}: {c['registered']} of {c['photos']} photos" for c in counts]
        self.stages.remark("result", f"route {registered.route}", *told)
        return registered

    def _separate_or_none(
        self, features: Mapping[str, Any], held: Mapping[str, Any]
    ) -> Registered | None:
        try:
            return self._assemble("separate", self._run_route("separate"), features, held)
        except RegistrationError as error:
            self.stages.remark("route", f"periods one by one: {error}")
            return None

    def _route(self, held: Mapping[str, Any]) -> Route:
        if self.scene is not None:
            return "frozen"
        if self.options.route is not None:
            self.stages.remark("route", f"{self.options.route}: asked for")
            return self.options.route
        connected = connected_periods(held, len(self._labels))
        if connected:
            self.stages.remark("route", "joint: matches connect all periods")
            return "joint"
        self.stages.remark("route", "separate: matches do not connect all periods")
        return "separate"

    def _run_route(self, route: Route) -> dict[str, Any]:
        settings: dict[str, Any] = {"periods": self.periods, "route": route}
        if route == "frozen":
            frames = self._old_frames()
            settings["poses"] = {f.name: f.cam_from_world[:3].tolist() for f in frames}
        else:
            settings["priors"] = self._priors() if self.georeference else None
            settings["keep_unplaced"] = self.options.tie_points is not None

        def estimate() -> tuple[Any, list[str]]:
            found = self._step(route, settings | self._places(route))
            shutil.rmtree(self.work / f"scratch-{route}", ignore_errors=True)
            return found, [*found["remarks"], _numbers(found["model"])]

        before = self.stages.previous
        result = dict(self.stages.run(route, settings, estimate))
        self.stages.previous = before  # two routes may start from the same matches
        return result

    def _places(self, name: str) -> dict[str, Any]:
        """Where a step that estimates finds and leaves things."""
        return {
            "database": str(self.work / "mapping.db"),
            "photos": str(self.photos),
            "out": str(self.work / f"model-{name}"),
            "scratch": str(self.work / f"scratch-{name}"),
            "threads": self._threads,
        }

    def _priors(self) -> dict[str, Any]:
        """Positions that are believed, by name."""
        rows = [
            (capture.name, enu.tolist(), sigma.tolist())
            for capture, enu, sigma, good in zip(
                self.images,
                self.positions.enu,
                self.positions.sigma,
                self.positions.believed,
                strict=True,
            )
            if good
        ]
        return {"enu": {n: e for n, e, _ in rows}, "sigma": {n: s for n, _, s in rows}}

    @property
    def _labels(self) -> tuple[str, ...]:
        if self.scene is None:
            return tuple(p.label for p in self.captures.periods)
        return (*(p.label for p in self.scene.periods), self._new_period[0])

    @property
    def _new_period(self) -> tuple[str, str | None]:
        """Label and date of the period that is added: those of the captures if all agree."""
        days = sorted(c.taken.date().isoformat() for c in self.images if c.taken is not None)
        same = days and days[0] == days[-1]
        return self._new_label, days[0] if same else (days[0][:4] if days else None)

    @property
    def _new_label(self) -> str:
        periods = self.captures.periods
        return periods[0].label if len(periods) == 1 else self.captures.root.name

    @property
    def _dates(self) -> tuple[str | None, ...]:
        if self.scene is None:
            return tuple(p.date for p in self.captures.periods)
        return (*(p.date for p in self.scene.periods), self._new_period[1])

    def _assemble(
        self,
        route: Route,
        result: Mapping[str, Any],
        features: Mapping[str, Any],
        held: Mapping[str, Any],
    ) -> Registered:
        parts = self._parts(route, result)
        folder = self.work / f"model-{route}"
        registered = assembly.assemble(folder, self.work / "held_out.npz", parts)
        lost = assembly.reasons(
            self.periods,
            set(registered.names),
            features["keypoints"],
            held["partners"],
            result["left"],
        )
        return replace(
            registered,
            unregistered=lost | dict(parts.unregistered),
            unregistered_periods={n: self.periods[n] for n in lost}
            | dict(parts.unregistered_periods),
        )

    def _parts(self, route: Route, result: Mapping[str, Any]) -> assembly.Assembly:
        """What a `Registered` has besides the model."""
        georeferenced = result["is_georeferenced"] or self.scene is not None
        last = len(self._labels) - 1
        refused = {n: reason for n, _, reason in self.refused}
        refused_periods = {n: last if self.scene else p for n, p, _ in self.refused}
        return assembly.Assembly(
            periods=self.periods,
            labels=self._labels,
            dates=self._dates,
            positions=assembly.position_map(self.images, self.positions),
            positions_used=frozenset(result["positions_used"]),
            georeference=self.georeference if georeferenced else None,
            unregistered=refused,
            unregistered_periods=refused_periods,
            route=route,
            images_root=self.photos,
            frozen={f.name: f for f in self._old_frames()},
        )

    def _totals(self) -> list[int]:
        """Photos of each period that could be used."""
        counts = [0] * len(self._labels)
        for period in self.periods.values():
            counts[period] += 1
        return counts

    def _shares(self, registered: Registered) -> list[float]:
        totals = self._totals()
        return [
            float((registered.periods == i).sum()) / total
            for i, total in enumerate(totals)
            if total
        ]

    def _write(self, registered: Registered, ties: TieAlignment | None) -> None:
        """The scene, checked and moved to its place in one go."""
        staged = self.work / "scene"
        scene = output.as_scene(registered, self.out.name)
        if self.scene is not None:
            scene = output.add_period(self.scene, registered, self.out.name)

        def progress(done: int, total: int) -> None:
            if self.report is not None:
                self.report("images", done, total)

        counts = output.write_scene(scene, staged, progress=progress)
        if self.scene is not None:
            kept = copy_poses(pose_bytes(self.scene.root / "sparse/0"), staged / "sparse/0")
            self.stages.remark("scene", f"poses of {kept} images copied bit by bit")
        told = ", ".join(f"{v} {k.replace('_', ' ')}" for k, v in counts.items())
        self.stages.remark("scene", told)
        points = None
        if ties is not None and not ties.replaced:  # else they are points of the model already
            assert self.options.tie_points is not None
            points = read_tie_points(self.options.tie_points, scale=self.options.tie_scale)
        found = inspect_registration(
            registered,
            staged,
            page=self.options.page,
            ties=ties,
            tie_points=points,
            title=f"Registration of {self.out.resolve().name}",
        )
        self.stages.remark("verdict", f"{found.verdict.level}: {found.verdict.text}")
        if self.inspected is not None:
            self.inspected(found)
        output.write_extras(staged, registered, self._log(registered))
        output.check_free(self.out, overwrite=self.options.overwrite)
        output.publish(staged, self.out)

    def _log(self, registered: Registered) -> dict[str, Any]:
        return {
            "schema_version": SCHEMA_VERSION,
            "captures": str(self.captures.root),
            "into": None if self.scene is None else str(self.scene.root),
            "work": str(self.work),
            "options": {
                k: str(v) if isinstance(v, Path) else v
                for k in self.options.__slots__
                if (v := getattr(self.options, k)) is not None
            },
            "route": registered.route,
            "unit": registered.unit,
            "periods": output.registered_counts(registered, self._totals()),
            "unregistered": [
                {"image": n, "period": registered.unregistered_periods[n], "reason": reason}
                for n, reason in sorted(registered.unregistered.items())
            ],
            "stages": self.stages.log,
        }


def _numbers(model: Mapping[str, Any]) -> str:
    return ", ".join(f"{value} {key.replace('_', ' ')}" for key, value in model.items())


def same_places(registered: Registered, new_period: int) -> list[str]:
    """New images with the pose of an old one: probably the same photo, undistorted since."""
    new = np.flatnonzero(registered.periods == new_period)
    old = np.flatnonzero(registered.periods != new_period)
    centres = camera_centre(registered.cam_from_world)
    if len(old) < 2:
        return []
    spacing = float(np.median(cKDTree(centres[old]).query(centres[old], k=2)[0][:, 1]))
    distance, nearest = cKDTree(centres[old]).query(centres[new])
    return [
        f"{registered.names[i]} was taken from the very place of {registered.names[old[j]]}: is it "
        "the same photo?"
        for i, j, d in zip(new.tolist(), nearest.tolist(), distance.tolist(), strict=True)
        if d < SAME_PLACE * spacing
    ]


def connected_periods(held: Mapping[str, Any], count: int) -> bool:
    """Whether matches connect all periods, each with enough of them."""
    group = list(range(count))
    for key, pairs in held["verified_pairs_across"].items():
        a, b = (int(part) for part in key.split("-"))
        if pairs >= LEAST_CROSS_PAIRS and held["matches_across"][key] >= LEAST_CROSS_MATCHES:
            old, new = group[b], group[a]
            group = [new if g == old else g for g in group]
    return len(set(group)) == 1


def _check_pinhole(scene: Scene, frame: Frame) -> None:
    """Refuse a scene whose cameras would have to change."""
    camera = frame.camera
    size = image_size(scene.image_path(frame))
    if not camera.is_pinhole or size != (camera.width, camera.height):
        raise SceneError(
            scene.image_path(frame),
            expected="an image of the size of its camera, without distortion",
            found=f"{camera.model} {camera.width} x {camera.height}, file {size[0]} x {size[1]}",
            todo="write the scene with chronoscene undistort first",
        )


def _scene_groups(scene: Scene) -> list[dict[str, Any]]:
    """The cameras of a scene with their images, as they are."""
    by_camera: dict[int, list[Frame]] = {}
    for frame in scene.frames:
        by_camera.setdefault(frame.camera.camera_id, []).append(frame)
    return [
        {
            "names": sorted(f.name for f in frames),
            "model": frames[0].camera.model,
            "params": list(frames[0].camera.params),
        }
        for frames in by_camera.values()
    ]
