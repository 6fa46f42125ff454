from .camera_images import CameraKey, ImagePlan, find_silhouettes
from .flight_file import ViewContent, WrittenFlight, write_flight
from .live_view import LiveView
from .programs import check_display, check_installed, show_in_browser, show_window, viewer_program

__all__ = [
    "CameraKey",
    "ImagePlan",
    "LiveView",
    "ViewContent",
    "WrittenFlight",
    "check_display",
    "check_installed",
    "find_silhouettes",
    "show_in_browser",
    "show_window",
    "viewer_program",
    "write_flight",
]
