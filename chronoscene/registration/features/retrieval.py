"""One vector for each image, so that similar images can be found without matching all pairs.

VLAD over SIFT: residuals to the nearest of a few visual words, summed by word, power- and
length-normalised (Jegou et al. 2010; Arandjelovic and Zisserman 2013). The words are learnt from
the images themselves, so nothing has to be downloaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chronoscene.io.pycolmap import pycolmap

WORDS = 64
TRAINING_DESCRIPTORS = 20_000
ITERATIONS = 10
PER_IMAGE = 2_000
"""Descriptors that are used of an image: those of the largest features, which last longest."""


def global_descriptors(database: str | Path, names: Sequence[str]) -> NDArray[np.float32]:
    """A unit vector for each image; zero for one without features. [N, WORDS * 128]"""
    local = [_local(database, name) for name in names]
    words = visual_words(np.concatenate(local))
    return np.stack([vlad(descriptors, words) for descriptors in local])


def _local(database: str | Path, name: str) -> NDArray[np.float32]:
    """Descriptors of the largest features of an image, with unit length. [K, 128]"""
    with pycolmap.Database.open(str(database)) as opened:
        image = opened.read_image_with_name(name)
        assert image is not None
        keypoints = np.asarray(opened.read_keypoints(image.image_id))
        data = np.asarray(opened.read_descriptors(image.image_id).data, np.float32)
    if not len(data):
        return np.zeros((0, 128), np.float32)
    size = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
    data = data[np.argsort(-size, kind="stable")[:PER_IMAGE]]
    return data / np.maximum(np.linalg.norm(data, axis=1, keepdims=True), 1e-6)


def visual_words(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Centres of clusters of descriptors (Lloyd's algorithm, fixed seed). [K, 128]"""
    rng = np.random.default_rng(0)
    if len(descriptors) > TRAINING_DESCRIPTORS:
        descriptors = descriptors[rng.choice(len(descriptors), TRAINING_DESCRIPTORS, replace=False)]
    count = min(WORDS, max(1, len(descriptors)))
    if not len(descriptors):
        return np.zeros((1, 128), np.float32)
    words = descriptors[rng.choice(len(descriptors), count, replace=False)].copy()
    for _ in range(ITERATIONS):
        nearest = assign(descriptors, words)
        for word in range(count):
            members = descriptors[nearest == word]
            if len(members):
                words[word] = members.mean(axis=0)
    return words


def assign(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.int64]:
    """Nearest word of each descriptor. [K]"""
    scores = descriptors @ words.T - 0.5 * (words**2).sum(axis=1)
    return np.asarray(scores.argmax(axis=1), np.int64)


def vlad(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """The vector of an image. [WORDS * 128]"""
    sums = np.zeros_like(words)
    if len(descriptors):
        nearest = assign(descriptors, words)
        np.add.at(sums, nearest, descriptors - words[nearest])
    norms = np.linalg.norm(sums, axis=1, keepdims=True)
    sums /= np.maximum(norms, 1e-12)
    vector = np.sign(sums) * np.sqrt(np.abs(sums))
    length = float(np.linalg.norm(vector))
    return np.asarray((vector / max(length, 1e-12)).ravel(), np.float32)
