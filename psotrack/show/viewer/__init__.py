"""A flight in Rerun, a viewer of other people's: tracks, cameras with their images, plots and events over time.

In: a `TrackedFlight`, silhouettes, rows of a live session. Out: a file of Rerun, a window, or a page for a browser.
Rerun is an extra, `pip install '.[view]'`: `camera_images` and `programs` do without, all
other modules import it, and `check_installed` says what to do where it is missing. Other rooms may use every name in
`__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
