from .archive_file import FORMAT_VERSION, MANIFEST_FILE, Manifest, PackedVideo, read_manifest, unpack
from .comparison import ArchiveComparison, compare_with_archive
from .packing import pack_tracks

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
