"""`psotrack cache`: list, check, prune and empty the cache of silhouettes and compiled programs."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psotrack.cli.options import CACHE, FORCE, JSON, QUIET, cache_folder
from psotrack.cli.output import Output, pass_output
from psotrack.errors import SettingsError

if TYPE_CHECKING:
    from psotrack.foreground.silhouettes import CacheEntry


@click.group()
def cache() -> None:
    """List, check, prune and empty the cache of silhouettes and compiled programs.

    The next run makes anew what is missing. A running command has read its silhouettes and is not disturbed. What
    psotrack did not put into the folder is left alone.

    \b
    Examples:
      psotrack cache list
      psotrack cache check
      psotrack cache prune --older-than 30 --max-gb 20
    """


@cache.command("list")
@CACHE
@QUIET
@FORCE
@JSON
@pass_output
def list_command(output: Output, cache: Path | None) -> None:
    """List the entries: key, video, size and the days since the last use.

    \b
    Examples:
      psotrack cache list
      psotrack cache list --cache /shared/cache --json -
    """
    from psotrack.foreground.silhouettes import list_entries

    folder, now_s = cache_folder(cache), time.time()
    entries = list_entries(folder)
    output.json({"cache": str(folder), "entries": [_described(each, now_s) for each in entries]})
    stored = [each for each in entries if each.kind == "silhouettes"]
    rows = (
        (each.path.name, each.video, f"{each.size_bytes / 1e6:.1f}", f"{_days(each, now_s):.1f}")
        for each in stored
    )
    output.table(("silhouettes", "video", "MB", "days unused"), rows)
    output.say(f"{folder}: {_counted(entries)}")


@cache.command()
@CACHE
@QUIET
@FORCE
@JSON
@pass_output
def check(output: Output, cache: Path | None) -> None:
    """Check every byte of the silhouettes, and name what is damaged.

    The exit code is 2 if an entry is damaged. The next run that needs a damaged entry makes it anew.

    \b
    Examples:
      psotrack cache check
      psotrack cache check --cache /shared/cache --json damaged.json
    """
    from psotrack.foreground.silhouettes import is_damaged, list_entries

    folder = cache_folder(cache)
    entries = list_entries(folder)
    damaged = [str(entry.path) for entry in entries if is_damaged(entry)]
    output.json({"cache": str(folder), "entries": len(entries), "damaged": damaged})
    for path in damaged:
        output.say(f"damaged: {path}")
    output.say(f"{folder}: {_counted(entries)}, {len(damaged)} damaged")
    if damaged:
        output.say("the next run that needs a damaged entry makes it anew")
        sys.exit(2)


@cache.command()
@click.option(
    "--older-than",
    "older_than_days",
    type=click.FloatRange(min=0),
    metavar="DAYS",
    help="Remove entries that were not used for DAYS days.",
)
@click.option(
    "--max-gb",
    type=click.FloatRange(min=0),
    metavar="GB",
    help="Then remove entries until the rest has at most GB gigabytes, those first that were used longest ago.",
)
@click.option("--dry-run", is_flag=True, help="Say what would be removed, and remove nothing.")
@CACHE
@QUIET
@FORCE
@JSON
@pass_output
def prune(
    output: Output, older_than_days: float | None, max_gb: float | None, dry_run: bool, cache: Path | None
) -> None:
    """Remove entries that were not used for some days, or that make the cache larger than a size.

    \b
    Examples:
      psotrack cache prune --older-than 30 --dry-run
      psotrack cache prune --max-gb 20
    """
    from psotrack.foreground.silhouettes import choose_to_prune, list_entries

    if older_than_days is None and max_gb is None:
        raise SettingsError("cache prune", expected="--older-than DAYS or --max-gb GB", found="neither")
    folder, now_s = cache_folder(cache), time.time()
    max_bytes = None if max_gb is None else 1e9 * max_gb
    chosen = choose_to_prune(list_entries(folder), now_s, older_than_days, max_bytes)
    _remove(output, folder, chosen, dry_run)


@cache.command()
@FORCE
@CACHE
@QUIET
@JSON
@pass_output
def empty(output: Output, cache: Path | None) -> None:
    """Remove all entries, after a question.

    \b
    Examples:
      psotrack cache empty
      psotrack cache empty --force --cache /shared/cache
    """
    from psotrack.foreground.silhouettes import list_entries

    folder = cache_folder(cache)
    entries = list_entries(folder)
    if entries and not output.force:
        question = f"{folder}: remove {_counted(entries)}?"
        # Nobody is there to answer where stdin is no terminal.
        if not sys.stdin.isatty():
            raise SettingsError(
                "cache empty", expected="an answer to a question", found="no terminal", remedy="pass --force"
            )
        if not click.confirm(question, err=True):
            output.say(f"{folder}: nothing was removed")
            return
    _remove(output, folder, entries, False)


def _remove(output: Output, folder: Path, chosen: list[CacheEntry], dry_run: bool) -> None:
    """Remove entries, and say which."""
    from psotrack.foreground.silhouettes import remove_entry

    if not dry_run:
        for each in chosen:
            remove_entry(each)
    # Nothing is in use: a command has read its silhouettes before it goes on.
    content = {
        "cache": str(folder),
        "dry_run": dry_run,
        "removed": [str(each.path) for each in chosen],
        "in_use": [],
    }
    output.json(content)
    words = "would be removed" if dry_run else "removed"
    output.say(f"{folder}: {words}: {_counted(chosen)}")


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
