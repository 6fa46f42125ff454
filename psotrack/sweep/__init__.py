"""Sweeps: grids of settings, run and remembered cell by cell, and tables of what came out."""

from psotrack.sweep.frames import sweep
from psotrack.sweep.grid import Cell, Grid, Perturbation, grid, key_of, load
from psotrack.sweep.perturbations import perturbed
from psotrack.sweep.printing import render
from psotrack.sweep.tables import pivot

__all__ = ["Cell", "Grid", "Perturbation", "grid", "key_of", "load", "perturbed", "pivot", "render", "sweep"]
