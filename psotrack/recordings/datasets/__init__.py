"""Recordings on disk: readers of `recording.toml`, and readers and writers of published datasets.

In: a file or folder that a user names. Out: a `psotrack.recordings.Recording`; for the simulator, writers of a folder
in a dataset's layout. Other rooms use the names in `__init__.pyi`, and `dpjait`, the module of the DPJAIT dataset;
modules with an underscore are parts of these.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
