"""MOG2 in JAX against OpenCV's, pixel by pixel, on sequences of random images."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from psotrack.silhouettes.mog2_jax import BACKGROUND, FOREGROUND, SHADOW, Mog2Params, mog2_init, mog2_step

HEIGHT, WIDTH = 48, 64
NUM_FRAMES = 40

#: Smallest share of the pixels of a frame that have OpenCV's label. The compilers of both round differently: XLA joins
#: products and sums. A pixel within a rounding error of a threshold then gets another label, once in some frames.
SAME = 0.999

_step = jax.jit(mog2_step)
_step_of_cameras = jax.jit(jax.vmap(mog2_step, in_axes=(0, 0, None)))


def random_frames(seed: int, *, noise: float, num_objects: int) -> Iterator[np.ndarray]:
    """Frames of a random background with noise, objects that move, and a shadow that comes and goes."""
    rng = np.random.default_rng(seed)
    background = rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(float)
    colours = rng.integers(0, 256, (num_objects, 3))
    places = rng.uniform(0, [HEIGHT, WIDTH], (num_objects, 2))
    steps = rng.normal(0, 2, (num_objects, 2))
    for number in range(NUM_FRAMES):
        image = background.copy()
        if number % 7 > 3:
            image[10:30, 20:50] *= rng.uniform(0.4, 1)
        for colour, place in zip(colours, places + number * steps, strict=True):
            y, x = (place % [HEIGHT, WIDTH]).astype(int)
            image[y : y + 12, x : x + 12] = colour
        image += rng.normal(0, noise, image.shape)
        yield np.clip(image, 0, 255).round().astype(np.uint8)


def learning_rates(seed: int, kind: str) -> list[float]:
    """Learning rate of each frame: none after the first, a constant, the mean of all frames, or random."""
    rng = np.random.default_rng(seed)
    constant = rng.uniform(0.001, 0.3)
    return {
        "none": [constant] + [0.0] * (NUM_FRAMES - 1),
        "constant": [constant] * NUM_FRAMES,
        "mean": [0.99] + [1 / (number + 1) for number in range(1, NUM_FRAMES)],
        "random": rng.choice([0.0, *rng.uniform(0.001, 0.5, 5)], NUM_FRAMES).tolist(),
    }[kind]


@settings(max_examples=12)
@given(
    seed=st.integers(0, 10_000),
    noise=st.floats(0, 8),
    num_objects=st.integers(0, 6),
    kind=st.sampled_from(["none", "constant", "mean", "random"]),
    background_ratio=st.sampled_from([0.9, 0.5]),
    shadow_threshold=st.sampled_from([0.5, 0.85]),
    var_threshold=st.sampled_from([16.0, 12.0]),
)
def test_labels_are_those_of_opencv(
    seed: int,
    noise: float,
    num_objects: int,
    kind: str,
    background_ratio: float,
    shadow_threshold: float,
    var_threshold: float,
) -> None:
    model = cv2.createBackgroundSubtractorMOG2(varThreshold=var_threshold, detectShadows=True)
    model.setBackgroundRatio(background_ratio)
    model.setShadowThreshold(shadow_threshold)
    state = mog2_init(HEIGHT, WIDTH)
    frames = random_frames(seed, noise=noise, num_objects=num_objects)
    for image, rate in zip(frames, learning_rates(seed, kind), strict=True):
        expected = model.apply(image, learningRate=rate)
        params = Mog2Params(
            rate,
            background_ratio=background_ratio,
            shadow_threshold=shadow_threshold,
            var_threshold=var_threshold,
        )
        state, labels = _step(state, image, params)
        assert np.mean(np.asarray(labels) == expected) >= SAME


@pytest.mark.parametrize("ratio", [0.9, 0.9 + 1e-6, 0.9 - 1e-6])
def test_where_labels_differ_a_sum_equals_a_threshold(ratio: float) -> None:
    """A new mode at rate 0.1 leaves the older ones the weight 0.9, OpenCV's background ratio: rounding decides.

    A whole object has the same weights, so all its pixels may differ. A millionth beside the ratio, no pixel does.
    """
    rng = np.random.default_rng(2)
    model = cv2.createBackgroundSubtractorMOG2(detectShadows=True)
    model.setBackgroundRatio(ratio)
    state = mog2_init(HEIGHT, WIDTH)
    for _ in range(60):
        image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
        x = rng.integers(0, WIDTH - 12)
        image[10:22, x : x + 12] = rng.integers(0, 256, 3)
        rate = float(rng.choice([0.0, 0.01, 0.1, 0.5]))
        expected = model.apply(image, learningRate=rate)
        state, labels = _step(state, image, Mog2Params(rate, background_ratio=ratio))
        differs = np.asarray(labels) != expected
        from_ratio = np.abs(np.cumsum(state.weight, axis=0) - ratio).min(axis=0)
        # Three rounding units of float32: the weights were scaled to the sum 1 in one frame after the other.
        assert (from_ratio[differs] < 4e-7).all()
        assert ratio == 0.9 or not differs.any()


def test_cameras_at_once_are_the_cameras_alone() -> None:
    sequences = [list(random_frames(seed, noise=2.0, num_objects=3)) for seed in range(3)]
    alone = [mog2_init(HEIGHT, WIDTH) for _ in sequences]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *alone)
    params = Mog2Params(0.02)
    seen = set()
    for images in zip(*sequences, strict=True):
        together, labels = _step_of_cameras(together, np.stack(images), params)
        for camera, image in enumerate(images):
            alone[camera], expected = _step(alone[camera], image, params)
            same = np.mean(np.asarray(labels[camera]) == np.asarray(expected))
            # Another shape is another program, which may round otherwise.
            assert same >= SAME
            seen |= set(np.unique(expected).tolist())
    assert seen == {BACKGROUND, SHADOW, FOREGROUND}
