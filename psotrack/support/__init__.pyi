from .compile_time import measured_compiling
from .compiled import drop_programs_if_many, keep_compiled
from .covariances import has_negative_eigenvalue
from .delimited import Column, Table, TextRow, read_rows, read_table, write_rows
from .devices import Device, processors, share_processors, use_device
from .figures import COLOURS, drone_colour, save_figure
from .files import (
    ARCHIVE_SUFFIX,
    atomic_write,
    atomic_write_all,
    check_file_name,
    check_no_nul,
    digest_file,
    digest_record,
    end_of_links,
    left_over,
    read_text,
    refuse_files,
    refuse_to_overwrite,
    user_cache,
)
from .html import html_block, html_lines, html_paths, html_table
from .numbers import LARGEST, MODERATE, NotNegative, Positive, Share, is_moderate, whole_number
from .plugins import (
    PluginKind,
    check_interface,
    identify,
    lasting_name,
    make_plugin,
    plugin_names,
    plugin_source,
    register_plugin,
)
from .processes import map_in_processes, with_traceback, worker_processes
from .program_seals import is_whole_program
from .progress import Advance, Report, joined, no_progress, progress_bar, progress_lines, terminal_bar
from .representation import short_repr
from .schema import assign, check_types, convert, nearest, plain, read_json, read_toml, toml_key, toml_value
from .standard_errors import standard_error
from .stored_programs import load_ahead, stored_jit
from .times import LEAST_STEP_S, first_repeat

__all__ = [
    "ARCHIVE_SUFFIX",
    "COLOURS",
    "LARGEST",
    "LEAST_STEP_S",
    "MODERATE",
    "Advance",
    "Column",
    "Device",
    "NotNegative",
    "PluginKind",
    "Positive",
    "Report",
    "Share",
    "Table",
    "TextRow",
    "assign",
    "atomic_write",
    "atomic_write_all",
    "check_file_name",
    "check_interface",
    "check_no_nul",
    "check_types",
    "convert",
    "digest_file",
    "digest_record",
    "drone_colour",
    "drop_programs_if_many",
    "end_of_links",
    "first_repeat",
    "has_negative_eigenvalue",
    "html_block",
    "html_lines",
    "html_paths",
    "html_table",
    "identify",
    "is_moderate",
    "is_whole_program",
    "joined",
    "keep_compiled",
    "lasting_name",
    "left_over",
    "load_ahead",
    "make_plugin",
    "map_in_processes",
    "measured_compiling",
    "nearest",
    "no_progress",
    "plain",
    "plugin_names",
    "plugin_source",
    "processors",
    "progress_bar",
    "progress_lines",
    "read_json",
    "read_rows",
    "read_table",
    "read_text",
    "read_toml",
    "refuse_files",
    "refuse_to_overwrite",
    "register_plugin",
    "save_figure",
    "share_processors",
    "short_repr",
    "standard_error",
    "stored_jit",
    "terminal_bar",
    "toml_key",
    "toml_value",
    "use_device",
    "user_cache",
    "whole_number",
    "with_traceback",
    "worker_processes",
    "write_rows",
]
