"""A flight as people look at it: tracks of one or several runs, and the recording in which they were found.

In: files of tracks with the records beside them, and a recording. Out: one `TrackedFlight`; where each camera shows the
drones (boxes, outlines of the 90 % ellipsoids); the events of a flight, such as encounters and lost drones; tables of
the quality of each drone and camera. The viewer, the overlay videos and the reports show what this room finds. Other
rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
