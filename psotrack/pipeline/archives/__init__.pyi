from .comparison import ArchiveComparison, compare_with_archive
from .manifest import FORMAT_VERSION, MANIFEST_FILE, Manifest, PackedVideo, read_manifest
from .packing import pack_tracks
from .zip_file import unpack

__all__ = [
    "FORMAT_VERSION",
    "MANIFEST_FILE",
    "ArchiveComparison",
    "Manifest",
    "PackedVideo",
    "compare_with_archive",
    "pack_tracks",
    "read_manifest",
    "unpack",
]
