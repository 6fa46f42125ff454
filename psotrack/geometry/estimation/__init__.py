"""General estimators: nonlinear least squares, and the backward pass of a Rauch-Tung-Striebel smoother.

In: residuals with their derivatives and a rule that applies a step, or the states of a Kalman filter. Out: the state
that minimises the cost, smoothed states, and covariances. The room knows neither cameras nor drones; every fit and
every smoother of the package is a caller of `least_squares` or `rauch_tung_striebel`. Other rooms may use every name in
`__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
