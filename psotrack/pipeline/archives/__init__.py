"""Archives: tracks, and everything from which they can be computed again, in one file.

In: a file of tracks with its record, and the recording that was tracked; or an archive. Out: an archive
(`pack_tracks`); a folder with a `recording.toml`, which every command reads (`unpack`); and what differs between the
archive's tracks and those that were computed again (`compare_with_archive`). Other rooms may use every name in
`__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
