"""Steps of the training, and what the network says without them; compiled once for each size of a batch."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, UInt8

from psotrack.foreground.learning.loss import Targets, losses
from psotrack.foreground.network import Network, inputs_of, peaks_of, untrained
from psotrack.support import as_written

#: Largest norm of a gradient: of images without drones, or with many, it may be many times the usual one.
_LARGEST_GRADIENT = 5.0
#: Share of the steps in which the learning rate rises to its largest value.
_WARM_UP = 0.05
#: Share of each weight that a step takes away, as a multiple of the learning rate.
_DECAY = 1e-4


_Arrays = Array | np.ndarray


class Batch(NamedTuple):
    """Parts of frames of one size.

    Attributes:
        image, background: BGR; the background is of use where `is_known`.
        covered: share of each pixel that drones cover, 0 to 255.
        counts: whether `covered` is known.
        box_px: xyxy of each drone, pixels; NaN for no drone.
        is_known: whether the background is known.
    """

    image: UInt8[_Arrays, "images height width 3"]
    background: UInt8[_Arrays, "images height width 3"]
    covered: UInt8[_Arrays, "images height width"]
    counts: Bool[_Arrays, "images height width"]
    box_px: Float[_Arrays, "images drones 4"]
    is_known: Bool[_Arrays, "images"]


class State(NamedTuple):
    """What a training goes on from: the network, the memory of the optimiser, and the best network so far."""

    network: Network
    memory: Any
    best: Network


class Teacher:
    """AdamW with a learning rate that rises and falls (Loshchilov and Hutter, 2019).

    Args:
        learning_rate: largest learning rate.
        steps: number of steps in all.
        seed: seed of the first network.
    """

    def __init__(self, learning_rate: float, steps: int, seed: int) -> None:
        warm_up = max(1, round(_WARM_UP * steps))
        rate = optax.warmup_cosine_decay_schedule(0.0, learning_rate, warm_up, steps)
        adam = optax.adamw(rate, weight_decay=_DECAY)
        self._optimiser, self._seed = optax.chain(optax.clip_by_global_norm(_LARGEST_GRADIENT), adam), seed

    @as_written()
    def begin(self, network: Network | None = None) -> State:
        """The state before the first step, of a network or of one that knows nothing."""
        network = untrained(self._seed) if network is None else network
        return State(network, self._optimiser.init(eqx.filter(network, eqx.is_array)), network)

    @as_written()
    @jax.numpy_dtype_promotion("standard")  # optax mixes types
    def step(self, state: State, batch: Batch) -> tuple[State, float]:
        """The state after one step down the gradient, and the loss before the step."""
        network, memory, loss = _step(state.network, state.memory, batch, self._optimiser)
        return State(network, memory, state.best), float(loss)


@eqx.filter_jit
def _step(
    network: Network, memory: Any, batch: Batch, optimiser: optax.GradientTransformation
) -> tuple[Network, Any, Float[Array, ""]]:
    inputs, targets = _shown(batch)

    def loss_of(network: Network) -> Float[Array, ""]:
        return losses(network(inputs), targets).total

    loss, gradient = eqx.filter_value_and_grad(loss_of)(network)
    updates, memory = optimiser.update(gradient, memory, eqx.filter(network, eqx.is_array))
    return eqx.apply_updates(network, updates), memory, loss


def _shown(batch: Batch) -> tuple[Float[Array, "images height width 6"], Targets]:
    """Inputs and targets of a batch."""
    image, background, covered, counts, box_px, is_known = map(jnp.asarray, batch)
    inputs = inputs_of(image.astype(jnp.float32), background.astype(jnp.float32), is_known)
    return inputs, Targets(covered.astype(jnp.float32) / 255, counts, box_px)


@as_written()
def look(network: Network, batch: Batch) -> tuple[Array, Array, Array, Array]:
    """The loss of one image without random changes, and what the network finds (see `peaks_of`)."""
    return _look(network, batch)


@eqx.filter_jit
def _look(network: Network, batch: Batch) -> tuple[Array, Array, Array, Array]:
    inputs, targets = _shown(batch)
    found = network(inputs)
    return (losses(found, targets).total, *peaks_of(found))
