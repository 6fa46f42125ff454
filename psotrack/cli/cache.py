"""`psotrack cache`: list, prune and empty the cache of silhouettes and compiled programs."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta

from psotrack.cli.commands import command
from psotrack.cli.options import Cache, cache_folder
from psotrack.cli.output import Output
from psotrack.cli.types import says

if TYPE_CHECKING:
    from psotrack.foreground.silhouettes import CacheEntry


@command(without=["progress"])
def cache(
    output: Output,
    *,
    older_than: Annotated[Annotated[float, Meta(ge=0)] | None, says(metavar="DAYS")] = None,
    max_gb: Annotated[Annotated[float, Meta(ge=0)] | None, says(metavar="GB")] = None,
    empty: bool = False,
    cache: Cache = None,
) -> None:
    """List, prune and empty the cache of silhouettes and compiled programs.

    The next run makes anew what is missing or damaged. A running command has read its silhouettes and is not disturbed.
    What psotrack did not put into the folder is left alone.

    \b
    Examples:
      psotrack cache
      psotrack cache --older-than 30 --max-gb 20
      psotrack cache --empty

    Options:
        older_than: remove entries that were not used for DAYS days.
        max_gb: then remove entries until the rest has at most GB gigabytes, those first that were used longest ago.
        empty: remove all entries.
    """
    from psotrack.foreground.silhouettes import choose_to_prune, list_entries, remove_entry

    folder, now_s = cache_folder(cache), time.time()
    entries = list_entries(folder)
    content: dict[str, Any] = {"cache": str(folder), "entries": [_described(each, now_s) for each in entries]}
    if older_than is None and max_gb is None and not empty:
        output.json(content)
        rows = (
            (each.path.name, each.video, f"{each.size_bytes / 1e6:.1f}", f"{_days(each, now_s):.1f}")
            for each in entries
            if each.kind == "silhouettes"
        )
        output.table(("silhouettes", "video", "MB", "days unused"), rows)
        output.say(f"{folder}: {_counted(entries)}")
        return
    max_bytes = None if max_gb is None else 1e9 * max_gb
    chosen = entries if empty else choose_to_prune(entries, now_s, older_than, max_bytes)
    for each in chosen:
        remove_entry(each)
    output.json({**content, "removed": [str(each.path) for each in chosen]})
    output.say(f"{folder}: removed: {_counted(chosen)}")


def _counted(entries: list[CacheEntry]) -> str:
    kinds = [each.kind for each in entries]
    size_mb = sum(each.size_bytes for each in entries) / 1e6
    return f"silhouettes of {kinds.count('silhouettes')} videos, {kinds.count('program')} programs, {size_mb:.1f} MB"


def _days(entry: CacheEntry, now_s: float) -> float:
    return max(0.0, now_s - entry.used_s) / (24 * 3600)


def _described(entry: CacheEntry, now_s: float) -> dict[str, Any]:
    return {
        "path": str(entry.path),
        "kind": entry.kind,
        "video": entry.video,
        "size_bytes": entry.size_bytes,
        "days_unused": round(_days(entry, now_s), 3),
    }
