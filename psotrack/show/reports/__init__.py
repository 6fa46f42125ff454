"""Pages for people: a report of a flight, of a sweep or of a calibration as one HTML file, and 3D views in notebooks.

In: tracked flights, results of sweeps, records of calibrations. Out: HTML that needs no network: tables, pictures,
plots, and 3D views that turn and play. Other rooms may use every name in `__init__.pyi`. The JavaScript of the 3D view
is in `assets`, with the library three.js.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
