from .c3d import Markers, read_c3d, write_c3d
from .detections import Detections, read_detections, write_detections
from .filmed import recording_of_video, with_all_videos
from .image_files import (
    IMAGE_SUFFIXES,
    find_images,
    image_files,
    image_of,
    is_image,
    natural_key,
    read_grey,
    read_image,
    read_mask,
)
from .inventory import describe_recording, inventory_table
from .marker_bodies import body_trajectories
from .marker_groups import NoDronesError
from .opencv_messages import silence_opencv
from .pictures import is_picture_folder, open_pictures, open_video, warn_of_missing_numbers
from .recording import OnboardVideo, Recording
from .recording_file import (
    RECORDING_FILE,
    CameraTable,
    MarkersTable,
    RecordingFile,
    ReferenceTable,
    WorldTable,
    read_recording_file,
    recording_file_text,
    write_recording_file,
)
from .stored_silhouettes import ARRAY_FILE, MADE_OF, StoredSilhouettes, probe_silhouettes
from .timestamps import read_timestamps
from .timing import MOST_INSTANTS, REACH, FrameTimes, Timeline, check_rate, make_timeline, nearest_frames
from .video import (
    TruncatedVideoError,
    VideoInfo,
    check_end,
    digest_video,
    probe,
    probe_images,
    read_frames,
    read_frames_at,
    read_near,
)
from .video_writing import VideoEncoder, VideoWriter, encoded_video, join_videos

__all__ = [
    "ARRAY_FILE",
    "IMAGE_SUFFIXES",
    "MADE_OF",
    "MOST_INSTANTS",
    "REACH",
    "RECORDING_FILE",
    "CameraTable",
    "Detections",
    "FrameTimes",
    "Markers",
    "MarkersTable",
    "NoDronesError",
    "OnboardVideo",
    "Recording",
    "RecordingFile",
    "ReferenceTable",
    "StoredSilhouettes",
    "Timeline",
    "TruncatedVideoError",
    "VideoEncoder",
    "VideoInfo",
    "VideoWriter",
    "WorldTable",
    "body_trajectories",
    "check_end",
    "check_rate",
    "describe_recording",
    "digest_video",
    "encoded_video",
    "find_images",
    "image_files",
    "image_of",
    "inventory_table",
    "is_image",
    "is_picture_folder",
    "join_videos",
    "make_timeline",
    "natural_key",
    "nearest_frames",
    "open_pictures",
    "open_video",
    "probe",
    "probe_images",
    "probe_silhouettes",
    "read_c3d",
    "read_detections",
    "read_frames",
    "read_frames_at",
    "read_grey",
    "read_image",
    "read_mask",
    "read_near",
    "read_recording_file",
    "read_timestamps",
    "recording_file_text",
    "recording_of_video",
    "silence_opencv",
    "warn_of_missing_numbers",
    "with_all_videos",
    "write_c3d",
    "write_detections",
    "write_recording_file",
]
