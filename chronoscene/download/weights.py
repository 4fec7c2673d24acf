"""The two files that LPIPS needs, into the folder where `chronoscene.metrics` looks for them."""

from __future__ import annotations

from pathlib import Path

from chronoscene.download.transfer import RemoteFile, fetch
from chronoscene.io.processes import Report
from chronoscene.metrics.lpips_weights import BACKBONE_FILE, HEADS_FILE, hub_cache

LPIPS_WEIGHTS = (
    RemoteFile(
        BACKBONE_FILE,
        f"https://download.pytorch.org/models/{BACKBONE_FILE}",
        553_433_881,
        "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
    ),
    RemoteFile(
        HEADS_FILE,
        "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/"
        "082bb24f84c091ea94de2867d34c4544f68e0963/lpips/weights/v0.1/vgg.pth",
        7_289,
        "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
    ),
)
"""Torchvision writes the first eight digits of the SHA-256 of its file into the name; the heads are
those of the repository of LPIPS at this commit, where git knows them as 47e943cf."""


def fetch_lpips_weights(folder: Path | None, *, report: Report) -> Path:
    """Download what is not there yet, and compare it with its checksums.

    Args:
        folder: Where to put the files; None for torch's cache of weights.
        report: As for `fetch`.

    Returns:
        The folder.

    Raises:
        DownloadError: If a host does not answer, or a file is damaged.
    """
    folder = folder or hub_cache()
    fetch(LPIPS_WEIGHTS, folder, report=report)
    return folder
