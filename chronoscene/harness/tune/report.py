"""Files of a search: the preset that was found, and a table of all trials."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chronoscene.harness.plan.resolve import ResolvedMethod
from chronoscene.io.staging import write_text_atomic
from chronoscene.io.tables import Table, csv_text
from chronoscene.io.wording import in_words
from chronoscene.methods import as_typed, build_config
from chronoscene.methods.preset_files import PresetFile, find_preset, preset_text
from chronoscene.methods.search_space import draw

if TYPE_CHECKING:
    from optuna.study import Study

PRESET_FILE = "preset.toml"
TRIALS_FILE = "trials.csv"


@dataclass(frozen=True, slots=True)
class TrialResult:
    """Result of a trial."""

    number: int
    psnr: float | None
    """Mean over scenes, and choices of validation views, of the macro mean over these views, in dB;
    None if it failed."""
    ssim: float | None
    """Mean of the same kind, which the search does not use; also None in trials that lack it."""
    seconds: float
    """Training clock, sum over all trainings."""
    checkpoint_bytes: int
    """Sum over all trainings."""
    options: dict[str, Any]
    """Value of each option of the search space."""
    failure: str
    """Reason, if it failed."""
    device: str
    commit: str


def read_results(study: Study, method: ResolvedMethod) -> list[TrialResult]:
    """Return the results of all trials that have ended, by number."""
    results = []
    for trial in study.trials:
        if not trial.state.is_finished():
            continue
        # A config of them might be refused.
        options = dataclasses.asdict(method.config) | draw(trial, method.spec, method.config)
        found = trial.user_attrs
        results.append(
            TrialResult(
                number=trial.number,
                psnr=trial.value,
                ssim=found.get("ssim"),
                seconds=found["seconds"],
                checkpoint_bytes=found["bytes"],
                options={name: options[name] for name in method.spec.search},
                failure=found["failure"],
                device=found["device"],
                commit=found["commit"],
            )
        )
    return results


def best_of(results: Sequence[TrialResult]) -> TrialResult | None:
    """Return the first of the trials with the highest score; None if all have failed."""
    scored = [result for result in results if result.psnr is not None]
    return max(scored, key=lambda result: result.psnr or 0.0, default=None)


def write_report(
    results: Sequence[TrialResult], method: ResolvedMethod, about: Mapping[str, Any], out: Path
) -> None:
    """Write the table of trials, and the preset if one has a score.

    Args:
        results: Of the trials so far.
        method: Method with the preset where the search starts.
        about: Settings of the search, for the preset.
        out: Folder of the search.
    """
    columns = [
        "trial",
        "psnr",
        "ssim",
        "seconds",
        "checkpoint_bytes",
        *method.spec.search,
        "failure",
    ]
    rows = [
        [
            *(result.number, result.psnr, result.ssim, result.seconds, result.checkpoint_bytes),
            *map(as_typed, result.options.values()),
            result.failure,
        ]
        for result in results
    ]
    write_text_atomic(out / TRIALS_FILE, csv_text(columns, rows))
    if (best := best_of(results)) is None:
        return
    spec = method.spec
    base = find_preset(method.settings.preset, spec).base
    start = dataclasses.asdict(build_config(spec, preset=base))
    found = dataclasses.asdict(method.config) | best.options
    if method.settings.iterations is not None:  # of the search, not of what was found
        found["iterations"] = method.preset["iterations"]
    file = PresetFile(
        method=spec.name,
        base=base,
        options={name: value for name, value in found.items() if value != start[name]},
        tuning={
            **{key: about[key] for key in ("scenes", "strategy", "seed", "iterations", "splits")},
            "trials": len(results),
            "failed": sum(result.psnr is None for result in results),
            "best_trial": best.number,
            "validation_psnr": best.psnr,
            **({} if best.ssim is None else {"validation_ssim": best.ssim}),
            "device": best.device,
            "commit": best.commit,
        },
    )
    write_text_atomic(out / PRESET_FILE, preset_text(file))


def trials_table(results: Sequence[TrialResult]) -> Table:
    """Tabulate trials, the best one marked."""
    best = best_of(results)
    options = list(results[0].options) if results else []
    return Table(
        heads=["trial", "PSNR", "SSIM", "seconds", "size", *options],
        rows=[
            [
                str(result.number),
                "failed" if result.psnr is None else f"{result.psnr:.3f}",
                "-" if result.ssim is None else f"{result.ssim:.3f}",
                f"{result.seconds:.1f}",
                in_words(result.checkpoint_bytes),
                *map(_short, result.options.values()),
            ]
            for result in results
        ],
        title="PSNR and SSIM on validation views; the first trial is the preset",
        ranks={(i, 1): 1 for i, result in enumerate(results) if result is best},
    )


def _short(value: Any) -> str:
    if isinstance(value, tuple):
        return f"({', '.join(map(_short, value))})"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
