"""Readers and writers of published datasets; each reader yields a `psotrack.recordings.Sequence`.

In: a folder in a dataset's layout. Out: a `Sequence`, and the writers that make such a folder. `dpjait` is the public
face of the DPJAIT dataset; modules with an underscore are its parts.
"""
