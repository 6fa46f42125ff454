"""Nonlinear least squares: damped Gauss-Newton steps, robust losses, and the elimination of blocks.

A caller writes a class that holds one state of its problem with residuals and derivatives: `Linearised`. The class
returns the `NormalEquations` at the state, and the state that a step leads to, also on a manifold.
`levenberg_marquardt` lowers the cost step by step.

Unknowns that are coupled to the shared unknowns only, for example the points of a bundle adjustment, form blocks. The
blocks are eliminated before the shared unknowns are solved for (Schur complement; B. Triggs, P. McLauchlan, R. Hartley,
A. Fitzgibbon, Bundle adjustment, a modern synthesis, 2000, section 6.1). All computations are in float64.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float

#: Added to a diagonal element before damping, so that an unknown without any equation stays where it is.
_TINY = 1e-12
#: Damping of the first step and its limits, as shares of the diagonal of the equations. A problem that needs more
#: than the largest damping has no better state in reach.
_FIRST_DAMPING, _LEAST_DAMPING, _LARGEST_DAMPING = 1e-4, 1e-12, 1e8
#: Factor on the damping after a step that lowers the cost, and after one that does not.
_LESS_DAMPING, _MORE_DAMPING = 0.1, 10.0


@dataclass(frozen=True)
class Step:
    """A step of all unknowns: (n,) of the shared unknowns, and (blocks, m) of the blocks, None without blocks."""

    shared: Float[np.ndarray, "n"]
    blocks: Float[np.ndarray, "blocks m"] | None = None


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of a linearised problem: J the derivatives of predictions by unknowns, W the weights.

    Attributes:
        information: (n, n), Jᵀ W J of the shared unknowns.
        right: (n,), Jᵀ W r of the shared unknowns, with residuals r = measured minus predicted.
        block_information: (blocks, m, m), Jᵀ W J of the unknowns of each block; None without blocks.
        block_right: (blocks, m), Jᵀ W r of the unknowns of each block; None without blocks.
        coupling: (blocks, m, n), Jᵀ W J between unknowns of each block and the shared ones; None without blocks.
    """

    information: Float[np.ndarray, "n n"]
    right: Float[np.ndarray, "n"]
    block_information: Float[np.ndarray, "blocks m m"] | None = None
    block_right: Float[np.ndarray, "blocks m"] | None = None
    coupling: Float[np.ndarray, "blocks m n"] | None = None

    def damped(self, damping: float) -> NormalEquations:
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
            return Step(np.linalg.solve(self.information, self.right))
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
    """A state of a problem with its residuals and derivatives."""

    @property
    def cost(self) -> float:
        """Sum of the losses in squared standard deviations; infinite if impossible."""

    def equations(self) -> NormalEquations:
        """Normal equations at this state; a robust loss weights the residuals here."""

    def moved(self, step: Step) -> Any:
        """The same problem, linearised at the state that a step leads to."""


_State = TypeVar("_State", bound=Linearised)


def levenberg_marquardt(start: _State, *, max_steps: int, least_gain: float | None = None) -> _State:
    """Lower the cost of a problem by damped steps; no step raises the cost.

    The search ends after `max_steps`, or where another criterion is met.

    Args:
        start: state near the solution.
        max_steps: largest number of steps that are tried.
        least_gain: relative change of the cost by the last step; None to leave the criterion out.
    """
    state, equations, damping = start, None, _FIRST_DAMPING
    for _ in range(max_steps):
        equations = equations or state.equations()
        step = equations.damped(damping).solved()
        tried = state.moved(step)
        before, after = state.cost, tried.cost
        if after < before:
            state, equations, damping = tried, None, max(_LESS_DAMPING * damping, _LEAST_DAMPING)
        else:
            damping *= _MORE_DAMPING
        if damping > _LARGEST_DAMPING or (
            least_gain is not None and abs(before - after) <= least_gain * before
        ):
            break
    return state


def _damped(information: Float[np.ndarray, "*batch n n"], damping: float) -> Float[np.ndarray, "*batch n n"]:
    stiffness = damping * (information.diagonal(axis1=-2, axis2=-1) + _TINY)
    return information + stiffness[..., None] * np.eye(information.shape[-1])
