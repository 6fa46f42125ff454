from .codecs import Codec, find_codec
from .folder import OverlayOptions, WrittenOverlays, write_overlays

__all__ = ["Codec", "OverlayOptions", "WrittenOverlays", "find_codec", "write_overlays"]
