"""Nonlinear least squares: damped and undamped Gauss-Newton steps, robust losses, and the elimination of blocks.

A caller writes a class that holds one state of its problem with residuals and derivatives: `Linearised`. The class
returns the `NormalEquations` at the state, and the state that a step leads to, also on a manifold. Two functions
iterate:

- `levenberg_marquardt` lowers a cost, for one problem or for a batch of independent problems.
- `gauss_newton` takes undamped steps, for problems that estimate weights or noise anew after every step, so that no
  single cost decreases.

Unknowns that are coupled to the shared unknowns only, for example the points of a bundle adjustment, form blocks. The
blocks are eliminated before the shared unknowns are solved for (Schur complement; B. Triggs, P. McLauchlan, R. Hartley,
A. Fitzgibbon, Bundle adjustment, a modern synthesis, 2000, section 6.1). All computations are in float64.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

#: Added to a diagonal element before damping, so that an unknown without any equation stays where it is.
_TINY = 1e-12


@dataclass(frozen=True)
class Step:
    """A step of all unknowns: (..., n) of the shared unknowns, and (blocks, m) of the blocks, None without blocks."""

    shared: Float[np.ndarray, "*batch n"]
    blocks: Float[np.ndarray, "blocks m"] | None = None


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of a linearised problem: J the derivatives of predictions by unknowns, W the weights.

    Without blocks, the arrays may have leading batch axes of independent problems.

    Attributes:
        information: (..., n, n), Jᵀ W J of the shared unknowns.
        right: (..., n), Jᵀ W r of the shared unknowns, with residuals r = measured minus predicted.
        block_information: (blocks, m, m), Jᵀ W J of the unknowns of each block; None without blocks.
        block_right: (blocks, m), Jᵀ W r of the unknowns of each block; None without blocks.
        coupling: (blocks, m, n), Jᵀ W J between unknowns of each block and the shared ones; None without blocks.
    """

    information: Float[np.ndarray, "*batch n n"]
    right: Float[np.ndarray, "*batch n"]
    block_information: Float[np.ndarray, "blocks m m"] | None = None
    block_right: Float[np.ndarray, "blocks m"] | None = None
    coupling: Float[np.ndarray, "blocks m n"] | None = None

    def damped(self, damping: float | Float[np.ndarray, "*batch"]) -> NormalEquations:
        """Increase each diagonal element by the share `damping` of itself (D. W. Marquardt, 1963)."""
        information = _damped(self.information, damping)
        blocks = self.block_information
        return replace(
            self,
            information=information,
            block_information=None if blocks is None else _damped(blocks, damping),
        )

    def solved(self) -> Step:
        """Solve the equations.

        Raises:
            numpy.linalg.LinAlgError: the equations are singular.
        """
        if self.block_right is None:
            return Step(np.linalg.solve(self.information, self.right[..., None])[..., 0])
        reduced = self.reduced()
        shared = np.linalg.solve(reduced.information, reduced.right)
        alone = np.matvec(reduced.block_covariance, self.block_right)
        return Step(shared, alone - reduced.gain @ shared)

    def reduced(self) -> ReducedEquations:
        """Eliminate the blocks.

        Raises:
            TypeError: the equations have no blocks.
            numpy.linalg.LinAlgError: the equations of a block are singular.
        """
        if self.block_information is None or self.block_right is None or self.coupling is None:
            raise TypeError("expected equations with blocks, found none")
        covariance = np.linalg.inv(self.block_information)
        gain = covariance @ self.coupling
        # Not -1 rows: there may be no shared unknowns.
        flat = (self.block_right.size, self.information.shape[-1])
        flat_gain = gain.reshape(flat)
        explained = flat_gain.T @ self.coupling.reshape(flat)
        return ReducedEquations(
            information=self.information - (explained + explained.T) / 2,
            right=self.right - flat_gain.T @ self.block_right.ravel(),
            block_covariance=covariance,
            gain=gain,
        )


@dataclass(frozen=True)
class ReducedEquations:
    """Normal equations of the shared unknowns after the elimination of the blocks.

    Attributes:
        information: (n, n), inverse of the covariance of the shared unknowns.
        right: (n,), right-hand side.
        block_covariance: (blocks, m, m), covariance of each block if the shared unknowns were known.
        gain: (blocks, m, n): a step x of the shared unknowns changes the step of each block by -gain @ x.
    """

    information: Float[np.ndarray, "n n"]
    right: Float[np.ndarray, " n"]
    block_covariance: Float[np.ndarray, "blocks m m"]
    gain: Float[np.ndarray, "blocks m n"]


def covariance_from_information(
    information: Float[np.ndarray, "n n"], largest_inflation: float = np.inf
) -> Float[np.ndarray, "n n"]:
    """Invert an information matrix in units of its diagonal, so that metres and radians have the same weight.

    Args:
        information: (n, n), symmetric.
        largest_inflation: largest ratio of the variance of an unknown to its variance if the others were known.

    Raises:
        numpy.linalg.LinAlgError: the matrix does not determine all unknowns.
    """
    diagonal = information.diagonal()
    if not (diagonal > 0).all():
        raise np.linalg.LinAlgError("expected an information above 0 of every unknown")
    scale = np.sqrt(diagonal)
    scale = scale * scale[:, None]
    inverse = np.linalg.inv(information / scale)
    inflation = inverse.diagonal()
    if not ((inflation > 0) & (inflation < largest_inflation)).all():
        raise np.linalg.LinAlgError("expected information that determines every unknown")
    covariance = inverse / scale
    return (covariance + covariance.T) / 2


def cauchy_loss(
    squares: Float[np.ndarray, "*residuals"], width: float = 1.0
) -> Float[np.ndarray, "*residuals"]:
    """Cauchy loss of squared residuals: equal to small squares, logarithmic beyond `width`."""
    return width * np.log1p(squares / width)


def cauchy_weight(
    squares: Float[np.ndarray, "*residuals"], width: float = 1.0
) -> Float[np.ndarray, "*residuals"]:
    """Derivative of `cauchy_loss`: weights of an equivalent least-squares problem (iteratively reweighted)."""
    return 1 / (1 + squares / width)


@runtime_checkable
class Linearised(Protocol):
    """A state of a problem with its residuals and derivatives.

    For a batch the class is a dataclass whose arrays have a leading axis of problems; a part that all states have in
    common is one object in one field.
    """

    @property
    def cost(self) -> Any:
        """Sum of the losses in squared standard deviations: a number, or (problems,); infinite if impossible."""

    def equations(self) -> NormalEquations:
        """Normal equations at this state; a robust loss weights the residuals here."""

    def moved(self, step: Step) -> Any:
        """The same problem, linearised at the state that a step leads to."""


@dataclass(frozen=True)
class Damping:
    """Schedule of the damping, in shares of the diagonal of the normal equations.

    Attributes:
        first: damping of the first step.
        least: smallest damping.
        largest: a problem that needs more damping than this value has no better state in reach.
        increase: factor on the damping after a step that does not lower the cost.
        decrease: factor on the damping after a step that lowers the cost.
    """

    first: float = 1e-4
    least: float = 1e-12
    largest: float = 1e8
    increase: float = 10.0
    decrease: float = 0.1


_State = TypeVar("_State", bound=Linearised)


def levenberg_marquardt(
    start: _State,
    *,
    max_steps: int,
    least_gain: float | None = None,
    least_length: float = 0.0,
    damping: Damping = Damping(),
) -> _State:
    """Lower the cost of one problem, or of each problem of a batch, by damped steps; no step raises a cost.

    The search ends after `max_steps`, or where all problems meet one of the other criteria.

    Args:
        start: state near the solution.
        max_steps: largest number of steps that are tried.
        least_gain: relative change of the cost by the last step; None to leave the criterion out.
        least_length: length of the next step in standard deviations; the step is not taken.
        damping: schedule of the damping.
    """
    state, equations = start, None
    strength = np.full(np.shape(start.cost), damping.first)
    for _ in range(max_steps):
        equations = equations or state.equations()
        step = equations.damped(strength).solved()
        if least_length > 0 and (_squared_length(equations, step) < least_length**2).all():
            break
        tried = state.moved(step)
        before, after = state.cost, tried.cost
        is_better = np.asarray(after < before)
        strength = np.where(
            is_better, np.maximum(strength * damping.decrease, damping.least), strength * damping.increase
        )
        state = _choose(is_better, tried, state)
        is_done = strength > damping.largest
        if least_gain is not None:
            is_done = is_done | (np.abs(before - after) <= least_gain * before)
        if is_done.all():
            break
        if is_better.any():
            equations = None
    return state


@runtime_checkable
class Reweighted(Protocol):
    """A state of a problem that estimates weights or noise together with the unknowns."""

    def moved(self) -> Any:
        """Solve the equations at this state, take the step, and estimate weights or noise anew."""

    def is_settled(self, before: Any) -> bool:
        """True if the step from the state `before` to this state is the last one."""


_Reweighted = TypeVar("_Reweighted", bound=Reweighted)


def gauss_newton(start: _Reweighted, *, max_steps: int) -> _Reweighted:
    """Take undamped steps until the state settles, at most `max_steps`.

    Raises:
        numpy.linalg.LinAlgError: the equations at a state are singular.
    """
    state = start
    for _ in range(max_steps):
        before, state = state, state.moved()
        if state.is_settled(before):
            break
    return state


def _damped(
    information: Float[np.ndarray, "*batch n n"], damping: float | Float[np.ndarray, "*#batch"]
) -> Float[np.ndarray, "*batch n n"]:
    stiffness = np.asarray(damping)[..., None] * (information.diagonal(axis1=-2, axis2=-1) + _TINY)
    return information + stiffness[..., None] * np.eye(information.shape[-1])


def _squared_length(equations: NormalEquations, step: Step) -> Float[np.ndarray, "*batch"]:
    """(...), squared length of a step of the shared unknowns in standard deviations."""
    return np.asarray(np.vecdot(step.shared, np.matvec(equations.information, step.shared)))


def _choose(is_better: Bool[np.ndarray, "*batch"], new: Any, old: Any) -> Any:
    """Take the new state of the problems that it makes better, and the old state of all others."""
    if is_better.all():
        return new
    if new is old or not is_better.any():
        return old
    if isinstance(new, np.ndarray):
        return np.where(is_better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
    if is_dataclass(new):
        parts = {f.name: _choose(is_better, getattr(new, f.name), getattr(old, f.name)) for f in fields(new)}
        return replace(old, **parts)
    raise TypeError(f"expected arrays and dataclasses in a batched state, found {type(new).__name__}")
