"""Readers and writers of published recordings; each yields a `psotrack.sequence.Sequence`."""
