"""Entries as they stand on the board: scored again from their predictions, or claimed.

Nothing that comes with an entry says that it is verified: whoever builds the site has the scenes,
freezes their test photos for the occasion, and scores the predictions against these.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from chronoscene.errors import ChronoSceneError
from chronoscene.formats import DetectedFormat, detect
from chronoscene.harness.files.ground_truth import freeze_ground_truth, ground_truth_folder
from chronoscene.harness.files.protocols import PROTOCOLS
from chronoscene.harness.files.provenance import scene_hash
from chronoscene.harness.files.records import RunRecord
from chronoscene.harness.files.source import read_bench_scene
from chronoscene.io.processes import Report
from chronoscene.metrics.registry import Scorers, make_scorers
from chronoscene.scene import Scene
from chronoscene.scene.splits import split_hash
from leaderboard.entries import MeasuredEntry, entry_files, predictions_folder, read_entry, refused
from leaderboard.registry import title_of
from leaderboard.verification import score_again

NOT_ASKED = "its scene was not named by --verify"
NO_IMAGES = "no predictions beside it"
NO_METHOD = "its method is not registered"
NO_ENTRY = (
    "no entry is of this scene as it is read here; where bench had other --period-by or "
    "--dataset-format, give these, or name the scene that chronoscene convert makes with them"
)
"""Notice on a scene that was named in vain."""

_Hashes = tuple[str, str]  # Of a scene and of its split


@dataclass(frozen=True, slots=True)
class Standing:
    """An entry on the board."""

    entry: MeasuredEntry
    records: tuple[RunRecord, ...]
    """Its runs, with the title that the board gives their method. If the entry is verified, they
    have the values that were computed here, and no others."""
    claimed: str
    """Reason why it is not verified; empty if it is."""


@dataclass(slots=True)
class Board:
    """Everything that a folder of entries holds."""

    standings: list[Standing] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)
    """Messages on entries that are left out."""


def read_board(
    folder: Path,
    scenes: Iterable[Path] = (),
    *,
    format: str | None = None,
    period_by: str | None = None,
    progress: Report | None = None,
) -> Board:
    """Read all entries below a folder, and score again those of some scenes.

    Entries that cannot be true, or whose values are not those of their predictions, are left out.
    Of two on the same runs, the verified one counts, else the first.

    Args:
        folder: Folder of entries.
        scenes: Folders of scenes with the test photos to score against.
        format: Argument of `read_scene` for all of them, as the next one.
        period_by: Rule by which their images are grouped into periods.
        progress: Told how many entries are done.

    Raises:
        SceneError: If a scene cannot be read.
        ConfigError: If a scene does not take the rule.
    """
    board = Board()
    found: dict[tuple[object, ...], tuple[Path, Standing]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        given = [(path, detect(path, format=format, period_by=period_by)) for path in scenes]
        truths = _Truths(given, Path(temporary))
        files = entry_files(folder)
        for number, path in enumerate(files):
            if progress is not None:
                progress("check entries", number, len(files))
            try:
                standing = _stand(path, read_entry(path), truths)
            except ChronoSceneError as error:
                board.notices.append(f"left out: {error}")
                continue
            first, known = found.setdefault(standing.entry.key, (path, standing))
            if known is standing:
                continue
            if known.claimed and not standing.claimed:
                found[standing.entry.key] = path, standing
                first, path = path, first
            twice = refused(path, f"an entry of the same runs as {first}")
            board.notices.append(f"left out: {twice}")
        board.notices += [f"{path}: {NO_ENTRY}" for path in truths.idle]
    board.standings = [standing for _, standing in found.values()]
    return board


def _stand(path: Path, entry: MeasuredEntry, truths: _Truths) -> Standing:
    """Score an entry again if possible; errors if its predictions are not what it says."""
    run = entry.runs[0].record
    title = title_of(run.method, run.preset)
    age = " of older code" if entry.outdated else ""
    labels = run.period_labels
    records = [part.record.model_copy(update={"rows": part.rows}) for part in entry.runs]
    claimed = NOT_ASKED
    if (scene := truths.scene_of(path, run)) is not None:
        labels = {str(period.id): period.label for period in scene.periods}
        if labels.keys() != run.period_labels.keys():
            raise refused(path, f"other periods than the {len(labels)} of the scene")
        folders = [predictions_folder(path, record.seed) for record in records]
        claimed = "" if all(folder.exists() for folder in folders) else NO_IMAGES
        if not claimed:
            truth = truths.freeze(scene, run)
            scorers = truths.scorers(entry)
            parts = zip(entry.runs, folders, strict=True)
            records = [score_again(path, *part, truth, scorers) for part in parts]
    if title is None:
        title, claimed = f"{run.method}, not registered", claimed or NO_METHOD
    update = {"title": title + age, "period_labels": labels}
    return Standing(entry, tuple(r.model_copy(update=update) for r in records), claimed)


class _Truths:
    """Scenes that entries are verified with, and their frozen test photos."""

    def __init__(self, given: Iterable[tuple[Path, DetectedFormat]], folder: Path) -> None:
        self._folder = folder
        self._given = dict(given)
        self._scenes: dict[int, dict[_Hashes, tuple[DetectedFormat, Scene]]] = {}
        self._hashes: dict[Path, set[_Hashes]] = {path: set() for path in self._given}
        self._used: set[_Hashes] = set()
        self._scorers: dict[frozenset[str], Scorers] = {}
        self._read(shrink=1)

    def _read(self, shrink: int) -> dict[_Hashes, tuple[DetectedFormat, Scene]]:
        """Read all scenes as bench does, once for each divisor of the size of their images."""
        if shrink not in self._scenes:
            scenes = {}
            for path, found in self._given.items():
                scene = read_bench_scene(found, validation=False, shrink=shrink)
                hashes = scene_hash(scene), split_hash(scene)
                scenes[hashes] = found, scene
                self._hashes[path].add(hashes)
            self._scenes[shrink] = scenes
        return self._scenes[shrink]

    def scene_of(self, entry: Path, run: RunRecord) -> Scene | None:
        """Return the scene of a run as bench had it; errors if its protocol is for no such one."""
        hashes = run.scene_hash, run.split_hash
        protocol = PROTOCOLS.get(run.protocol)
        known = self._read(protocol.shrink if protocol else 1).get(hashes)
        if known is None:
            return None
        self._used.add(hashes)
        found, scene = known
        if protocol is not None and found.name != protocol.format:
            wrong = f"protocol {run.protocol}, which is for scenes in the format {protocol.format}"
            raise refused(entry, f"{wrong}, and {found.path} in {found.name}")
        return scene

    @property
    def idle(self) -> list[Path]:
        """Folders of scenes that no entry is of."""
        return [path for path, hashes in self._hashes.items() if not hashes & self._used]

    def freeze(self, scene: Scene, run: RunRecord) -> Path:
        """Write the test photos of a scene at the width of a run, unless they are there."""
        place = self._folder / f"{run.scene_hash}-{run.max_width}"
        freeze_ground_truth(place, scene, run.scene_hash, run.max_width)
        return ground_truth_folder(place, scene.name)

    def scorers(self, entry: MeasuredEntry) -> Scorers:
        """Return the metrics that the runs of an entry have."""
        names = frozenset(name for run in entry.runs for view in run.views for name in view.values)
        if names not in self._scorers:
            self._scorers[names] = make_scorers(names)
        return self._scorers[names]
