"""Readers and writers of published datasets.

In: a folder in a dataset's layout. Out: a `psotrack.recordings.Recording`; for the simulator, writers of such a folder.
Other rooms import from `dpjait`, the module of the DPJAIT dataset; modules with an underscore are parts of `dpjait`.
"""
