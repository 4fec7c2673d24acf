"""The public datasets of multi-period scenes: where each is, its licence, and what reads it.

Source: the READMEs of ZhongtaoWang/ChronoGS, IntelLabs/CLNeRF, zju3dv/NeuSC and
jan-ackermann/cl-splats, and the page of WAT on the Hugging Face hub.
"""

from __future__ import annotations

from dataclasses import dataclass

HUB = "https://huggingface.co/datasets/"


@dataclass(frozen=True, slots=True)
class Dataset:
    """A dataset as its authors publish it."""

    title: str
    page: str
    """Page on which its authors describe it."""
    host: str
    licence: str
    format: str
    """Format of its scenes, as ``--dataset-format`` names it."""
    citation: str
    by_hand: str
    """Way to get it without this command, to follow on "by hand:"."""
    repo: str = ""
    """``owner/name`` of a dataset on the Hugging Face hub; empty if it is elsewhere."""
    scene_file: str = ""
    """Regular expression of a path that every scene has, below the folder of the scene."""
    left_out: tuple[str, ...] = ()
    """Endings of files that are no part of a scene."""


DATASETS = {
    "chronoscene": Dataset(
        title="ChronoScene",
        page=f"{HUB}wangzhongtao/ChronoScene",
        host="Hugging Face",
        licence="Apache-2.0",
        format="chronoscene",
        citation="Wang et al., ChronoGS: Disentangling Invariants and Changes in Multi-Period "
        "Scenes, 2025, arXiv:2511.18794",
        by_hand="ChronoScene.zip from "
        "https://disk.pku.edu.cn/link/AA13F383F5CD6B462D8C7B745D4576133D or "
        "https://pan.baidu.com/s/1PLDmMzUFP_5QIStMMiz7xw (code sfpj)",
        repo="wangzhongtao/ChronoScene",
        scene_file=r"sparse/split\.txt",
    ),
    "wat": Dataset(
        title="World Across Time (CLNeRF)",
        page=f"{HUB}IntelLabs/WAT-WorldAcrossTime",
        host="Hugging Face",
        licence="CC BY-NC 4.0, conditions to accept",
        format="wat",
        citation="Cai and Müller, CLNeRF: Continual Learning Meets NeRF, ICCV 2023",
        by_hand=f"accept the conditions on {HUB}IntelLabs/WAT-WorldAcrossTime and take the files",
        repo="IntelLabs/WAT-WorldAcrossTime",
        scene_file=r"sparse/0/images\.(bin|txt)",
    ),
    "cl-splats": Dataset(
        title="CL-Splats",
        page=f"{HUB}ackermannj/cl-splats-dataset",
        host="Hugging Face",
        licence="see its page",
        format="cl-splats",
        citation="Ackermann et al., CL-Splats: Continual Learning of Gaussian Splatting with Local "
        "Optimization, ICCV 2025",
        by_hand=f"take the folders of the scenes from {HUB}ackermannj/cl-splats-dataset",
        repo="ackermannj/cl-splats-dataset",
        # A scene is a base with its changes, or has a folder for each of its dates t0, t1, ...
        scene_file=r"transforms_train\.json|t\d+/.+|sparse/0/images\.(bin|txt)",
        left_out=(".blend", ".blend1", ".pth"),
    ),
    "5pointz": Dataset(
        title="5Pointz (NeuSC)",
        page="https://github.com/zju3dv/NeuSC",
        host="Google Drive",
        licence="none stated",
        format="neusc",
        citation="Lin et al., Neural Scene Chronology, CVPR 2023",
        by_hand="pip install gdown && gdown 1ytPDh5s5bzVnPLU01jcQ4xOA9_DDgliD && "
        "unzip 5pointz.zip, or 5pointz.zip from "
        "https://drive.google.com/drive/folders/1hRIHBBjj1JzyBc0WF6xuNwo-wTKuQ_3i",
    ),
}
