"""Flights: positions and attitudes of drones over time, from formulas, recorded files, and flying by hand."""
