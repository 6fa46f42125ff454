"""Drone models, and rooms with their light."""
