"""``chronoscene download``: public datasets, and the weights of LPIPS."""

from __future__ import annotations

from pathlib import Path
from shlex import quote

import click

from chronoscene.cli.options import PATH, refuse_options
from chronoscene.cli.output import check_place, emit
from chronoscene.cli.progress import progress_bar
from chronoscene.download.catalogue import DATASETS, Dataset
from chronoscene.download.datasets import download_scenes
from chronoscene.download.weights import LPIPS_WEIGHTS, fetch_lpips_weights
from chronoscene.errors import ConfigError, DownloadError
from chronoscene.io.tables import Table, plain_text
from chronoscene.metrics.lpips_weights import ENVIRONMENT

WEIGHTS = "lpips-weights"
BY_HAND = 1  # Exit status when a host lets only people download


@click.command("download")
@click.argument("name", required=False, type=click.Choice([*DATASETS, WEIGHTS]))
@click.argument("scenes", nargs=-1)
@click.option(
    "--out",
    type=PATH,
    help="Folder for the scenes.  [default: data/NAME, for weights torch's cache]",
)
def command(name: str | None, scenes: tuple[str, ...], out: Path | None) -> None:
    """Download the scenes of a public dataset.

    Without SCENES, all scenes are downloaded; without NAME, the data sets are listed. The same
    command continues an interrupted download. All files are compared with the checksums of their
    host. Environment variables of huggingface_hub, such as HF_ENDPOINT and HF_TOKEN, are used.
    """
    if name is None:
        refuse_options(["out"], "without NAME")
        emit(plain_text(_table()))
    elif name == WEIGHTS:
        _download_weights(scenes, out)
    elif DATASETS[name].repo:
        _download_dataset(DATASETS[name], scenes, out or Path("data") / name)
    else:
        dataset = DATASETS[name]
        refuse_options(["scenes", "out"], f"with {name}, which only people can download")
        emit(f"{dataset.title} is on {dataset.host}. By hand: {dataset.by_hand}\n")
        emit(_after(dataset, Path(name)))
        click.get_current_context().exit(BY_HAND)


def _table() -> Table:
    rows = [
        (name, dataset.title, dataset.host, dataset.licence, dataset.format)
        for name, dataset in DATASETS.items()
    ]
    rows.append((WEIGHTS, "VGG16 and the heads of LPIPS", "PyTorch, GitHub", "BSD", ""))
    heads = ["name", "dataset", "host", "licence", "format"]
    return Table(heads, rows, labels=len(heads), title="What can be downloaded")


def _download_dataset(dataset: Dataset, scenes: tuple[str, ...], out: Path) -> None:
    check_place("--out", out)
    try:
        with progress_bar(f"list {dataset.page}") as bar:
            download_scenes(dataset, out, scenes, report=bar, log=click.echo)
    except DownloadError:
        click.echo(f"by hand: {dataset.by_hand}", err=True)
        raise
    emit(_after(dataset, out))


def _after(dataset: Dataset, folder: Path) -> str:
    return (
        f"licence: {dataset.licence} ({dataset.page})\n"
        f"cite: {dataset.citation}\n"
        f"next: chronoscene validate {quote(str(folder))}\n"
    )


def _download_weights(scenes: tuple[str, ...], out: Path | None) -> None:
    if scenes:
        raise ConfigError(
            WEIGHTS, expected="no scenes", found=" ".join(scenes), todo="leave them out"
        )
    try:
        with progress_bar() as bar:
            folder = fetch_lpips_weights(out, report=bar)
    except DownloadError:
        urls = " and ".join(file.url for file in LPIPS_WEIGHTS)
        click.echo(f"by hand: save {urls} in a folder and set {ENVIRONMENT} to it", err=True)
        raise
    emit(f"LPIPS weights are in {folder}\n")
    if out is not None:
        emit(f"next: give {out} as --lpips-weights, or set {ENVIRONMENT} to it\n")
