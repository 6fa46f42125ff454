"""The thirteen simulated sequences of the dataset, one TOML file each."""
