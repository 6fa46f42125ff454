from .flight_report import WrittenPage, write_flight_report
from .scene import MOST_BYTES, MOST_ROWS, View3D, view_3d, write_page

__all__ = [
    "MOST_BYTES",
    "MOST_ROWS",
    "View3D",
    "WrittenPage",
    "view_3d",
    "write_flight_report",
    "write_page",
]
