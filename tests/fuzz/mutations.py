"""Changes of a file's content, each drawn by a seeded generator.

Bytes and integers are changed in any file; lines, cells, words and values in texts; members in ZIP archives; columns in
Parquet tables. Some contents are replaced as a whole.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random

Change = Callable[[Random, bytes], bytes]

#: Cells of tables and scalars of JSON, TOML, YAML and XML.
WORDS: list[str] = json.loads(Path(__file__).with_name("words.json").read_text(encoding="utf-8"))
_TOKEN = re.compile(rb"-?\d[\d.e+-]*|\w+|\"[^\"\n]*\"|[\[\]{}:,=<>/;]")
_VALUE = re.compile(rb"(?<=[=:])[^\n,}\]]+|\"[^\"\n]*\"|\[[^\[\]\n]*\]")
_SEPARATORS = (b";", b",", b"\t", b" ")
_EXTREMES = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)


def mutate(random: Random, content: bytes, others: Sequence[bytes], inside: Change | None = None) -> bytes:
    """Change a content in one to three places.

    Args:
        random: the generator.
        content: content of a sound file.
        others: contents of files of other formats.
        inside: change of what a container holds; None if the format is no container.
    """
    if random.random() < 0.04:
        return _whole(random, content, others)
    is_text = b"\x00" not in content[:4000]
    for _ in range(random.choice((1, 1, 2, 3))):
        if inside is not None and random.random() < 0.7:
            content = inside(random, content)
        elif is_text and random.random() < 0.85:
            content = random.choice(_OF_TEXT)(random, content)
        else:
            content = random.choice(_OF_BYTES)(random, content)
    return content


def members(random: Random, content: bytes) -> bytes:
    """Change of a ZIP archive whose members stay readable: one is changed, left out, renamed or written twice."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as before:
            entries = [(entry.filename, before.read(entry)) for entry in before.infolist()]
    except Exception:  # an earlier change made the archive unreadable
        return content
    if not entries:
        return content
    index = random.randrange(len(entries))
    name, data = entries[index]
    kind = random.random()
    if kind < 0.6:
        entries[index] = name, mutate(random, data, [each for _, each in entries])
    elif kind < 0.75:
        del entries[index]
    elif kind < 0.9:
        renamed = random.choice(_OF_TEXT)(random, name.encode()).decode("utf-8", "replace")
        entries[index] = renamed.replace("\x00", "0") or "0", data
    else:
        entries.append((name.upper(), data))
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as after:
        for name, data in entries:
            after.writestr(name, data)
    return out.getvalue()


#: Values of cells of Parquet tables.
_CELLS = [
    None,
    float("nan"),
    float("inf"),
    -1,
    0,
    1.5,
    2**53,
    -(2**62),
    "x",
    "",
    True,
    b"\xff",
    [1],
    {"a": 1},
]


def columns(random: Random, content: bytes) -> bytes:
    """Change of a Parquet table that stays readable: a column has another type, name or value, or is missing."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(io.BytesIO(content))
        index = random.randrange(table.num_columns)
        name, values = table.column_names[index], table.column(index).to_pylist()
    except (pa.ArrowException, OSError, ValueError):  # an earlier change made the table unreadable
        return content
    row = random.randrange(max(len(values), 1))
    kind = random.random()
    if kind < 0.15:
        table = table.remove_column(index)
    elif kind < 0.25:
        other = random.choice(table.column_names)
        table = table.rename_columns([other if each == name else each for each in table.column_names])
    elif kind < 0.35:
        table = table.slice(0, row)
    elif kind < 0.45:
        table = pa.concat_tables([table, table.slice(row, 1)])
    else:
        value = random.choice(_CELLS)
        # One cell, or all of the column.
        values = [value if kind > 0.7 or place == row else each for place, each in enumerate(values)]
        try:
            table = table.set_column(index, name, [pa.array(values)])
        except (pa.ArrowException, TypeError, OverflowError):  # no column can hold these values together
            table = table.set_column(index, name, [pa.array(map(str, values), pa.string())])
    out = io.BytesIO()
    pq.write_table(table, out)
    return out.getvalue()


def _whole(random: Random, content: bytes, others: Sequence[bytes]) -> bytes:
    """Another content: none, zeros, noise, brackets in brackets, twice or half the content, or another file."""
    return random.choice(
        (
            *(b"", b"\n" * 50, b"\x00" * 200, b"\xef\xbb\xbf", b"[]", b"{}", b"null", b"1"),
            *(b"[" * 20_000, b'{"a":' * 20_000, b"a = " + b"[" * 20_000, b"<a>" * 20_000, b"- " * 2_000),
            random.randbytes(300),
            content + content,
            content[: len(content) // 2],
            content.decode("latin-1").encode("utf-16"),
            random.choice(others or [b""]),
        )
    )


# --- bytes


def _flip(random: Random, content: bytes) -> bytes:
    changed = bytearray(content)
    for _ in range(random.choice((1, 1, 4, 30))):
        if changed:
            changed[random.randrange(len(changed))] = random.randrange(256)
    return bytes(changed)


def _integer(random: Random, content: bytes) -> bytes:
    """An extreme integer of one to four bytes, rather at the beginning, where headers are."""
    if not content:
        return content
    place = random.randrange(min(len(content), random.choice((64, 600, 10**9))))
    size = random.choice((1, 2, 4))
    value = random.choice(_EXTREMES) & (1 << 8 * size) - 1
    return content[:place] + value.to_bytes(size, random.choice(("little", "big"))) + content[place + size :]


def _cut(random: Random, content: bytes) -> bytes:
    return content[: random.randrange(len(content) + 1)]


def _insert(random: Random, content: bytes) -> bytes:
    start = random.randrange(len(content) + 1)
    new = random.choice((b"\x00", b"\xff\xfe", b"\xc3", b"\xef\xbb\xbf", b"\r", random.randbytes(9)))
    return content[:start] + new + content[start:]


def _piece(random: Random, content: bytes) -> bytes:
    """A piece is left out, written twice or erased."""
    start = random.randrange(len(content) + 1)
    piece = content[start : start + random.choice((1, 4, 16, 100, 512, 4000))]
    new = random.choice((b"", piece + piece, bytes(len(piece))))
    return content[:start] + new + content[start + len(piece) :]


_OF_BYTES: tuple[Change, ...] = (_flip, _flip, _integer, _integer, _cut, _insert, _piece, _piece, _piece)


# --- texts


def _replace(pattern: re.Pattern[bytes]) -> Change:
    def change(random: Random, content: bytes) -> bytes:
        found = list(pattern.finditer(content))
        if not found:
            return content
        match = random.choice(found)
        new = random.choice(WORDS).encode("utf-8", "surrogatepass")
        if random.random() < 0.15:
            # A word of the same file in a wrong place.
            new = random.choice(found)[0]
        return content[: match.start()] + new + content[match.end() :]

    return change


def _lines(random: Random, content: bytes) -> bytes:
    lines = content.split(b"\n")
    place = random.randrange(len(lines))
    line = lines[place]
    kind = random.randrange(7)
    if kind == 0:
        del lines[place]
    elif kind == 1:
        lines.insert(random.randrange(len(lines) + 1), line)
    elif kind == 2:
        lines[place] = line[: random.randrange(len(line) + 1)]
    elif kind == 3:
        random.shuffle(lines)
    elif kind == 4:
        lines[place] = line + b"\r"
    elif kind == 5:
        lines = lines[: place + 1]
    else:
        return content.replace(b"\n", random.choice((b"\r\n", b"\r", b"\n\n", b"\x0b", b"\xe2\x80\xa8")))
    return b"\n".join(lines)


def _cells(random: Random, content: bytes) -> bytes:
    """A cell is replaced, added, left out or moved; or a column is, in all lines."""
    separator = max(_SEPARATORS, key=content.count)
    rows = [line.split(separator) for line in content.split(b"\n")]
    row = random.randrange(len(rows))
    column = random.randrange(len(rows[row]))
    word = random.choice(WORDS).encode("utf-8", "surrogatepass")
    kind = random.randrange(4)
    for each in rows if random.random() < 0.3 else [rows[row]]:
        if column >= len(each):
            continue
        if kind < 2:
            each[column] = word
        elif kind == 2:
            each.insert(column, word)
        else:
            del each[column]
    return b"\n".join(separator.join(each) for each in rows)


_OF_TEXT: tuple[Change, ...] = (
    *(_replace(_TOKEN), _replace(_TOKEN), _replace(_VALUE), _replace(_VALUE)),
    *(_lines, _lines, _cells, _cells, _cut),
)
