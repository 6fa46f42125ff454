"""Steps of the training, and what the network says without them; compiled once for each size of a batch."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import optax
from jaxtyping import Array, Float

from psotrack.foreground.learning.loss import losses
from psotrack.foreground.learning.variations import Batch, plain, varied
from psotrack.foreground.network import Network, peaks_of, untrained
from psotrack.support import as_written

#: Largest norm of a gradient: of images without drones, or with many, it may be many times the usual one.
_LARGEST_GRADIENT = 5.0
#: Share of the steps in which the learning rate rises to its largest value.
_WARM_UP = 0.05
#: Share of each weight that a step takes away, as a multiple of the learning rate.
_DECAY = 1e-4


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
        seed: seed of the first network and of all random changes.
    """

    def __init__(self, learning_rate: float, steps: int, seed: int) -> None:
        warm_up = max(1, round(_WARM_UP * steps))
        rate = optax.warmup_cosine_decay_schedule(0.0, learning_rate, warm_up, steps)
        adam = optax.adamw(rate, weight_decay=_DECAY)
        self._optimiser, self._seed = optax.chain(optax.clip_by_global_norm(_LARGEST_GRADIENT), adam), seed

    @as_written()
    def begin(self) -> State:
        """The state before the first step."""
        network = untrained(self._seed)
        return State(network, self._optimiser.init(eqx.filter(network, eqx.is_array)), network)

    @as_written()
    @jax.numpy_dtype_promotion("standard")  # optax mixes types
    def step(self, state: State, batch: Batch, number: int) -> tuple[State, float]:
        """The state after one step down the gradient, and the loss before the step.

        Args:
            state: the state.
            batch: parts of frames.
            number: number of the step, which chooses the random changes.
        """
        key = jax.random.fold_in(jax.random.key(self._seed), number)
        network, memory, loss = _step(state.network, state.memory, batch, key, self._optimiser)
        return State(network, memory, state.best), float(loss)


@eqx.filter_jit
def _step(
    network: Network, memory: Any, batch: Batch, key: Array, optimiser: optax.GradientTransformation
) -> tuple[Network, Any, Float[Array, ""]]:
    inputs, targets = varied(key, batch)

    def loss_of(network: Network) -> Float[Array, ""]:
        return losses(network(inputs), targets).total

    loss, gradient = eqx.filter_value_and_grad(loss_of)(network)
    updates, memory = optimiser.update(gradient, memory, eqx.filter(network, eqx.is_array))
    return eqx.apply_updates(network, updates), memory, loss


@as_written()
def look(network: Network, batch: Batch) -> tuple[Array, Array, Array, Array]:
    """The loss of one image without random changes, and what the network finds (see `peaks_of`)."""
    return _look(network, batch)


@eqx.filter_jit
def _look(network: Network, batch: Batch) -> tuple[Array, Array, Array, Array]:
    inputs, targets = plain(batch)
    found = network(inputs)
    return (losses(found, targets).total, *peaks_of(found))
