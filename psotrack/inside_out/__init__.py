"""Inside-out: where a drone is, from markers of known place that its own camera sees (the paper's third method)."""
