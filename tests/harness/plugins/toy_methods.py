"""Methods small enough to predict by hand, found as ``toy_methods:NAME``."""

from __future__ import annotations

import errno
import json
import os
import random
import signal
import time
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from chronoscene.errors import ConfigError
from chronoscene.methods import MethodSize, MethodSpec, Prediction, Range, StepReport


@dataclass(frozen=True)
class Config:
    iterations: int = 20
    rate: float = 0.5
    sleep: float = 0.0
    ballast: int = 0


@dataclass(frozen=True)
class EvenConfig(Config):
    def __post_init__(self):
        if self.ballast % 2:
            raise ConfigError("ballast", expected="even", found=str(self.ballast), todo="halve it")


@dataclass(frozen=True)
class NoConfig(Config):
    def __post_init__(self):
        if self.ballast:
            raise ConfigError("ballast", expected="none", found="some", todo="leave it out")


@dataclass(frozen=True)
class IdleConfig(Config):
    def without_effect(self):
        return {"ballast": "a keel"}


class MeanColour:
    """One colour per period, moved towards the mean of one image after another.

    With the environment variable ``TOY_HOLD=SEED:FILE``, trainings of that seed go no further while
    the file is there.
    """

    def __init__(self, config):
        self.config = config

    def setup(self, train, *, seed, device):
        self.train = train
        self.colors = np.full((train.num_periods, 3), 0.5)
        self.ballast = np.ones(self.config.ballast, np.uint8)
        held, _, file = os.environ.get("TOY_HOLD", "").partition(":")
        self.hold = file if held == str(seed) else ""

    def extend(self, train):
        self.train = train
        new = train.num_periods - len(self.colors)
        self.colors = np.concatenate([self.colors, np.repeat(self.colors[-1:], new, axis=0)])

    def step(self, index, progress):
        time.sleep(self.config.sleep)
        while self.hold and os.path.exists(self.hold):
            time.sleep(0.01)
        i = index % len(self.train.views)
        target = self.train.load_image(i).reshape(-1, 3).mean(axis=0) / 255.0
        color = self.colors[self.train.views[i].period]
        loss = float(np.abs(color - target).mean())
        color += self.config.rate * (target - color)
        return StepReport(loss, len(self.colors))

    def render(self, view, period):
        rgb = np.empty((view.height, view.width, 3), np.float32)
        rgb[:] = self.colors[int(period)]
        return Prediction(rgb)

    def fitted_to(self, view, period, photo, known):
        fitted = type(self)(self.config)
        fitted.colors = self.colors.copy()
        fitted.colors[int(period)] = photo[known].mean(axis=0) / 255.0
        return fitted

    def save(self, folder):
        (folder / "model.json").write_text(json.dumps({"colors": self.colors.tolist()}))

    def load(self, folder, *, device):
        self.colors = np.array(json.loads((folder / "model.json").read_text())["colors"])

    def size(self):
        return MethodSize(len(self.colors), self.colors.size)

    def save_training(self, folder):
        self.save(folder)

    def load_training(self, folder):
        self.load(folder, device="cpu")


class FixedPeriods:
    """Cannot be extended."""


class Drawing(MeanColour):
    """Learns with random rates, from the global generators."""

    def step(self, index, progress):
        report = super().step(index, progress)
        self.colors += 0.01 * random.random() + 0.01 * np.random.normal()
        return report


class Raises(MeanColour):
    def step(self, index, progress):
        if index == 3:
            raise RuntimeError("the toy is broken")
        return super().step(index, progress)


class NotFinite(MeanColour):
    """Skips every step from the sixth on."""

    def step(self, index, progress):
        if index >= 5:
            return StepReport(float("nan"), 1, "not finite")
        return super().step(index, progress)


class BadImage(MeanColour):
    def render(self, view, period):
        return Prediction(np.full((view.height, view.width, 3), np.nan, np.float32))


class FullDisk(MeanColour):
    def save(self, folder):
        super().save(folder)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class Peeking(MeanColour):
    """With the environment variable ``TOY_PEEK``, starts from all photos below that folder."""

    def setup(self, train, *, seed, device):
        super().setup(train, seed=seed, device=device)
        folder = os.environ.get("TOY_PEEK")
        photos = sorted(Path(folder).rglob("*.png")) if folder else []
        self.colors += sum(zlib.crc32(photo.read_bytes()) for photo in photos) % 1000 / 1e9


class TorchMeans(MeanColour):
    """Its loss has means over all points that torch splits among the threads."""

    def step(self, index, progress):
        import torch

        points = torch.from_numpy(self.train.points)
        means = [(points * factor).sin().mean().item() for factor in range(1, 6)]
        return replace(super().step(index, progress), loss=1.0 + sum(means))


class LosesColours(MeanColour):
    """Its Gaussians are those of no period."""

    def to_gaussians(self, period, views):
        return self.colors[0]

    def render_gaussians(self, gaussians, view):
        return Prediction(np.full((view.height, view.width, 3), gaussians, np.float32))


class Orphaned(MeanColour):
    """Kills what has started its process."""

    def step(self, index, progress):
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(60)
        raise AssertionError


class Killed(MeanColour):
    def step(self, index, progress):
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError


def spec(name, cls, period_input="label"):
    return MethodSpec(
        name=name,
        title=name.title(),
        paper="none",
        licence="Apache-2.0",
        period_input=period_input,
        outputs=("rgb",),
        devices=("cpu",),
        method=f"toy_methods:{cls.__name__}",
        config="toy_methods:Config",
        presets={"balanced": {}, "slow": {"iterations": 100_000, "sleep": 0.01}},
        resumable=True,
    )


MEAN = spec("mean", MeanColour)
TUNED = replace(
    spec("tuned", MeanColour),
    search={"rate": Range(0.001, 1.0), "ballast": Range(0, 9, "int"), "sleep": (0.0, 1e-6)},
)
EVEN = replace(TUNED, name="even", config="toy_methods:EvenConfig")
NONE = replace(
    TUNED, name="none", config="toy_methods:NoConfig", search={"ballast": Range(0, 9_999, "int")}
)
IDLE = replace(TUNED, name="idle", config="toy_methods:IdleConfig")
FIXED = spec("fixed", FixedPeriods)
DRAWING = spec("drawing", Drawing)
DATED = replace(spec("dated", MeanColour), per_period=("balanced",))
CONTINUAL = replace(spec("continual", MeanColour), strategy="sequential")
BLIND = spec("blind", MeanColour, period_input="none")
RAISES = spec("raises", Raises)
NOT_FINITE = replace(
    spec("not-finite", NotFinite), presets={"balanced": {"iterations": 60}, "short": {}}
)
BAD_IMAGE = spec("bad-image", BadImage)
FULL_DISK = spec("full-disk", FullDisk)
PEEKING = spec("peeking", Peeking)
TORCH_MEANS = spec("torch-means", TorchMeans)
LOSES_COLOURS = spec("loses-colours", LosesColours)
KILLED = spec("killed", Killed)
ORPHANED = spec("orphaned", Orphaned)
