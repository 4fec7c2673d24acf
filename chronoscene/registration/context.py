"""Options of a registration, and the work folder that all of its stages share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from chronoscene.io.processes import Report
from chronoscene.kernels.runtime import available_threads
from chronoscene.registration.result import Route
from chronoscene.registration.work_folder import Stages, run_task

Calibration = Literal["auto", "per-period", "shared"]

CALIBRATIONS: tuple[Calibration, ...] = get_args(Calibration)

EXHAUSTIVE_LIMIT = 60  # Images; at most 1,770 pairs


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a registration."""

    route: Route | None = None
    """None to choose: joint if matches connect the periods, else separate."""
    work: Path | None = None
    """Folder for intermediate results, kept between runs; None for ``<out>.work``."""
    overwrite: bool = False
    """True to replace an earlier registration at the output path."""
    max_image_size: int = 1600
    """Pixels; larger photos are downscaled for feature extraction."""
    max_features: int = 5000
    """Features kept of each photo."""
    exhaustive_limit: int = EXHAUSTIVE_LIMIT
    """Number of photos up to which all pairs are matched."""
    held_out: float = 0.1
    """Share of the tracks across periods that take no part in the estimation."""
    cameras: Path | None = None
    """File of known calibrations; see `photos.known_cameras`."""
    camera_model: str = "auto"
    """COLMAP's camera model for the photos; ``auto`` for one that their number determines."""
    calibration: Calibration = "auto"
    """Sharing of calibrations between periods that used the same camera."""
    threads: int | None = None
    """None for one per processor. With 1, every run gives bit-identical results."""
    seed: int = 0
    """Seed of the draw of held-out tracks."""
    features: str | None = None
    """File of features, or an installed extractor, instead of SIFT."""
    matches: str | None = None
    """File of matches between these features, or an installed matcher."""
    tie_points: Path | None = None
    """File of tie points or ground control."""
    tie_scale: float = 1.0
    """Size of these photos divided by that of the photos that were clicked in."""
    crs: str | None = None
    """Projected reference system of coordinates in the output, and of tie points whose file names
    none; None for that of the tie points."""
    page: bool = False
    """True to write ``registration.html``."""

    def work_folder(self, out: Path) -> Path:
        """Folder of the intermediate results of a scene."""
        return (self.work or Path(f"{out.resolve()}.work")).resolve()

    def record(self) -> dict[str, Any]:
        """Options that are set, for the log; paths hold wherever a later command starts."""
        values = {name: getattr(self, name) for name in self.__slots__}
        return {
            name: str(value.absolute()) if isinstance(value, Path) else value
            for name, value in values.items()
            if value is not None
        }


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """One run in its work folder."""

    work: Path
    stages: Stages
    options: Options
    report: Report | None
    lock: int
    """File descriptor that keeps others out of the work folder."""

    @property
    def threads(self) -> int:
        return self.options.threads or available_threads()

    @property
    def photos(self) -> Path:
        """Folder of the prepared photos."""
        return self.work / "photos"

    @property
    def database(self) -> Path:
        """Features and all matches."""
        return self.work / "features.db"

    @property
    def mapping_database(self) -> Path:
        """Database without held-out matches."""
        return self.work / "mapping.db"

    @property
    def held_out(self) -> Path:
        return self.work / "held_out.npz"

    def run_task(self, task: str, arguments: Mapping[str, Any]) -> Any:
        """Run a task in a process of its own; see `run_task`."""
        log = self.work / "log.txt"
        return run_task(task, arguments, log=log, report=self.report, inherited=(self.lock,))

    def places(self, name: str) -> dict[str, Any]:
        """Paths and threads of a task that estimates a model."""
        return {
            "database": str(self.mapping_database),
            "photos": str(self.photos),
            "out": str(self.work / f"model-{name}"),
            "scratch": str(self.work / f"scratch-{name}"),
            "threads": self.threads,
        }
