"""Bundle adjustments as `psotrack.geometry.estimation` solves them: residuals, derivatives and normal equations.

In: what cameras see, and a state near the solution. Out: the state with the smallest cost, and its equations. There are
two adjustments, with the same parts: a problem (the data), a state (the unknowns), and a bundle (a state with its
residuals, which a step moves). They differ in what is eliminated as blocks:

- `points`: cameras with known lenses and single points, which are the blocks; common motions of the rig are held
  (`calibration.bundle`).
- `boards`: lenses, cameras and a board of known shape, whose pose at each instant is a block (`calibration.rig`).
"""
