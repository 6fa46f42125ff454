"""Pages for people: the report of a flight as one HTML file, and a 3D view in notebooks.

In: tracked flights. Out: HTML that needs no network: tables, pictures, plots, and a 3D view that turns and plays. Other
rooms may use every name in `__init__.pyi`. The JavaScript of the 3D view is in `assets`, with the library three.js.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
