"""Where drones are at any time: from formulas, from recordings, and from a person at the controls."""
