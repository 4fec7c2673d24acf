"""List of the files of a dataset on the Hugging Face hub."""

from __future__ import annotations

import os

from chronoscene import __version__
from chronoscene.download.transfer import RemoteFile, answering
from chronoscene.errors import DownloadError
from chronoscene.io.staging import leads_out
from chronoscene.io.wording import shown


def list_files(repo: str) -> tuple[str, list[RemoteFile]]:
    """Commit of the newest version of a dataset, and all of its files.

    ``HF_ENDPOINT`` names another host than huggingface.co, such as a mirror.

    Raises:
        DownloadError: If the host does not answer, or has no such dataset.
    """
    from huggingface_hub import HfApi, RepoFile, hf_hub_url

    endpoint = os.environ.get("HF_ENDPOINT") or None
    api = HfApi(endpoint=endpoint, library_name="chronoscene", library_version=__version__)
    with answering(f"{api.endpoint}/datasets/{repo}"):
        commit = api.dataset_info(repo).sha or "main"
        tree = api.list_repo_tree(repo, repo_type="dataset", revision=commit, recursive=True)
        entries = [entry for entry in tree if isinstance(entry, RepoFile)]
    if outside := [entry.path for entry in entries if leads_out(entry.path)]:
        raise DownloadError(
            f"{api.endpoint}/datasets/{repo}",
            expected="files in the folder of the dataset",
            found=shown(outside),
            todo="use another HF_ENDPOINT",
        )
    files = [
        RemoteFile(
            entry.path,
            hf_hub_url(
                repo, entry.path, repo_type="dataset", revision=commit, endpoint=api.endpoint
            ),
            entry.size,
            entry.lfs.sha256 if entry.lfs else entry.blob_id,
        )
        for entry in entries
    ]
    return commit, files


def request_headers() -> dict[str, str]:
    """Headers of requests to the hub, with the token of a person who has logged in."""
    from huggingface_hub.utils import build_hf_headers

    return build_hf_headers(library_name="chronoscene", library_version=__version__)
