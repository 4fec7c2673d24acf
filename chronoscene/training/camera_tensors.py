"""Views as the tensors that a rasterizer takes."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from chronoscene.methods import View
from chronoscene.scene.geometry import camera_centre


def camera_tensors(view: View, device: str | torch.device = "cpu") -> tuple[Tensor, Tensor]:
    """World-to-camera transform and calibration of one view, as a batch of one.

    Returns:
        viewmats: Pose in the training frame. float32 [1, 4, 4]
        Ks: Intrinsics in pixels. float32 [1, 3, 3]
    """
    viewmats = torch.from_numpy(np.array(view.cam_from_world, dtype=np.float32)[None])
    Ks = torch.from_numpy(np.array(view.K, dtype=np.float32)[None])
    return viewmats.to(device), Ks.to(device)


def camera_centre_tensor(view: View, device: str | torch.device = "cpu") -> Tensor:
    """Camera centre in the training frame, computed in float64. float32 [3]"""
    centre = camera_centre(np.asarray(view.cam_from_world, dtype=np.float64))
    return torch.from_numpy(centre.astype(np.float32)).to(device)
