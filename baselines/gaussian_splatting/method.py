"""3D Gaussian Splatting as a plug-in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from baselines.gaussian_splatting.config import GaussianSplattingConfig
from baselines.gaussian_splatting.density import GradientStatistics, densify, reset_opacities
from baselines.gaussian_splatting.gaussians import SHAPES, initialise, opacities_of, scales_of
from baselines.gaussian_splatting.timeline import Due, Timeline
from chronoscene.errors import CheckpointError
from chronoscene.gaussians.spherical_harmonics import evaluate
from chronoscene.methods import MethodSize, Prediction, StepReport, TrainingSet, View
from chronoscene.rasterizer import Rasterization, rasterize
from chronoscene.scene.geometry import Sim3
from chronoscene.training.camera_tensors import camera_centre_tensor, camera_tensors
from chronoscene.training.checkpoint import META_FILE, build_meta, load_tensors, save_tensors
from chronoscene.training.losses import photometric_loss
from chronoscene.training.optimizer import Adam
from chronoscene.training.sampler import ViewSampler

NAME = "3dgs"
VERSION = "1"
SPLIT_STREAM = 1
"""Keeps the samples of splits apart from other draws of the same seed."""


class GaussianSplatting:
    """One static scene of Gaussians, trained on all views alike.

    The period is not used: every period renders the same image.

    Source: Kerbl et al. 2023, "3D Gaussian Splatting for Real-Time Radiance Field Rendering".
    Different on purpose: the principal point is kept, and the near plane is 0.01 (see the option).
    """

    def __init__(self, config: GaussianSplattingConfig) -> None:
        self.config = config
        self.parameters: dict[str, Tensor] = {}
        """Groups as `gaussians.SHAPES` says."""
        self.sh_degree = 0
        """Degree that is in use now."""

    def setup(self, train: TrainingSet, *, seed: int, device: str) -> None:
        self._train = train
        self._seed = seed
        self._timeline = Timeline(self.config)
        self._sampler = ViewSampler(len(train.views), seed)
        start = initialise(train, opacity=self.config.initial_opacity)
        self.parameters = {k: v.to(device).requires_grad_() for k, v in start.items()}
        self._optimizer = Adam(self.parameters)
        self._statistics = GradientStatistics(len(start["means"]), device)
        self._background = torch.from_numpy(np.array(train.background, np.float32)).to(device)
        self._training_from_world = train.training_from_world
        self._num_periods = train.num_periods

    def step(self, index: int, progress: float) -> StepReport:
        due = self._timeline.at(index, progress)
        self.sh_degree = due.sh_degree
        number = self._sampler.next()
        view = self._train.views[number]
        raster = self._rasterize(view)
        # A copy, as cached images are not ours to write to, which torch cannot promise.
        target = torch.from_numpy(self._train.load_image(number).copy()).to(raster.image.device)
        loss = photometric_loss(raster.image[0], target, ssim_weight=self.config.ssim_weight)
        self._optimizer.zero_grad()
        loss.backward()
        if due.collect:
            self._statistics.add(raster.info, view.width, view.height)
        if due.densify:
            self._densify(index, prune_large=due.prune_large)
        self._update(due)
        return StepReport(loss=float(loss.detach()), primitives=len(self.parameters["means"]))

    def render(self, view: View, period: float) -> Prediction:
        with torch.no_grad():
            raster = self._rasterize(view, depth=True)
        assert raster.depths is not None
        return Prediction(
            rgb=raster.image[0].clamp(0.0, 1.0).cpu().numpy(),
            alpha=raster.alphas[0, ..., 0].cpu().numpy(),
            depth=raster.depths[0, ..., 0].cpu().numpy(),
        )

    def save(self, folder: Path) -> None:
        meta = build_meta(
            NAME,
            VERSION,
            self.config,
            training_from_world=self._training_from_world,
            num_periods=self._num_periods,
            sh_degree=self.sh_degree,
            background=self._background.tolist(),
        )
        save_tensors(folder, self.parameters, meta)

    def load(self, folder: Path, *, device: str) -> None:
        tensors, meta = load_tensors(folder, device=device, method=NAME)
        _check_groups(folder, tensors)
        self.config = _config_of(folder, meta)
        self.parameters = tensors
        self.sh_degree = meta["sh_degree"]
        self._background = torch.tensor(meta["background"], dtype=torch.float32, device=device)
        self._training_from_world = Sim3.from_matrix(meta["training_from_world"])
        self._num_periods = meta["num_periods"]

    def size(self) -> MethodSize:
        return MethodSize(
            primitives=len(self.parameters["means"]),
            parameters=sum(group.numel() for group in self.parameters.values()),
        )

    def _rasterize(self, view: View, *, depth: bool = False) -> Rasterization:
        p = self.parameters
        device = self._background.device
        centre = camera_centre_tensor(view, device)
        viewmats, Ks = camera_tensors(view, device)
        return rasterize(
            p["means"],
            p["quats"],
            scales_of(p["log_scales"]),
            opacities_of(p["logit_opacities"]),
            evaluate(p["sh_dc"], p["sh_rest"], p["means"], centre, self.sh_degree),
            viewmats,
            Ks,
            view.width,
            view.height,
            near_plane=self.config.near_plane,
            backgrounds=self._background[None],
            render_depth=depth,
        )

    @torch.no_grad()
    def _densify(self, index: int, *, prune_large: bool) -> None:
        """Change the set of Gaussians; their gradients of this step are dropped."""
        result = densify(
            self.parameters,
            self._statistics.mean(),
            extent=self._train.camera_extent,
            prune_large=prune_large,
            config=self.config,
            generator=np.random.default_rng((self._seed, SPLIT_STREAM, index)),
        )
        for name in SHAPES:
            self._optimizer.keep(name, result.keep)
            self.parameters[name] = self._optimizer.extend(name, result.new[name])
        self._statistics = GradientStatistics(
            len(self.parameters["means"]), self._background.device
        )

    @torch.no_grad()
    def _update(self, due: Due) -> None:
        """Adam's step for every group that has a gradient, and the opacity reset."""
        skip: tuple[str, ...] = ()
        if due.reset:
            logits = self.parameters["logit_opacities"]
            logits.copy_(reset_opacities(logits, self.config.reset_opacity))
            self._optimizer.reset_moments("logit_opacities")
            skip = ("logit_opacities",)
        self._optimizer.step(
            {
                "means": due.position_lr * self._train.camera_extent,
                "log_scales": self.config.scale_lr,
                "quats": self.config.rotation_lr,
                "logit_opacities": self.config.opacity_lr,
                "sh_dc": self.config.sh_dc_lr,
                "sh_rest": self.config.sh_rest_lr,
            },
            skip=skip,
        )


def _config_of(folder: Path, meta: dict[str, Any]) -> GaussianSplattingConfig:
    try:
        return GaussianSplattingConfig(**meta["config"])
    except (KeyError, TypeError) as error:
        raise CheckpointError(
            folder / META_FILE,
            expected="the configuration of 3dgs",
            found=str(error),
            todo="use the version of the software that wrote it, or train again",
        ) from error


def _check_groups(folder: Path, tensors: dict[str, Tensor]) -> None:
    """Raise unless a checkpoint holds all groups, each with a row for each Gaussian."""
    counts = {
        name: tensors[name].shape[0] if name in tensors and tensors[name].dim() else None
        for name in SHAPES
    }
    fits = {name: (counts["means"], *shape) for name, shape in SHAPES.items()}
    if any(name not in tensors or tuple(tensors[name].shape) != fits[name] for name in SHAPES):
        found = ", ".join(f"{name} {list(tensor.shape)}" for name, tensor in tensors.items())
        raise CheckpointError(
            folder / META_FILE,
            expected=f"the parameter groups {', '.join(SHAPES)}, one row per Gaussian",
            found=found or "none",
            todo="train again with this version",
        )
