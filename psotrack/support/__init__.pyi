from .compiled import keep_compiled
from .delimited import Column, Table, TextRow, read_rows, read_table, write_rows
from .figures import COLOURS, colour_of, save_figure
from .files import digest_of, read_text, refuse_to_overwrite, written_whole
from .processes import map_in_processes
from .progress import Advance, Report, silent, terminal
from .schema import assign, convert, nearest, read_toml
from .standard_errors import standard_error

__all__ = [
    "COLOURS",
    "Advance",
    "Column",
    "Report",
    "Table",
    "TextRow",
    "assign",
    "colour_of",
    "convert",
    "digest_of",
    "keep_compiled",
    "map_in_processes",
    "nearest",
    "read_rows",
    "read_table",
    "read_text",
    "read_toml",
    "refuse_to_overwrite",
    "save_figure",
    "silent",
    "standard_error",
    "terminal",
    "write_rows",
    "written_whole",
]
