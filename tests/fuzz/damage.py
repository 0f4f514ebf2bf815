"""Ways to damage a file: in its bytes, regardless of the format, and with wrong but valid content.

Every function takes a random generator, so that the damage is reproducible from a seed.
"""

from __future__ import annotations

import functools
import json
import random
import re
import sqlite3
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from labapp.session.file.blobs import HEAD, MAGIC
from tests.fuzz.originals import hot_journal

ODD_BYTES = (0, 1, 2, 0x7F, 0x80, 0xFE, 0xFF)
PAGE = 4096


# --- bytes ------------------------------------------------------------------------------------


def damaged_bytes(content: bytes, rng: random.Random, head: int = 100) -> bytes:
    """Change some bytes, mostly near the start or the end, or a range of bytes."""
    data = bytearray(content)
    damage = rng.choice([_flip] * 6 + [_cut, _zeroed, _doubled, _moved, _grown])
    damage(data, rng, head)
    return bytes(data)


def _flip(data: bytearray, rng: random.Random, head: int) -> None:
    for _ in range(rng.choice([1, 1, 2, 4, 16, 100])):
        where = rng.choice(["head", "anywhere", "anywhere", "tail"])
        end = min(head, len(data))
        position = rng.randrange(len(data)) if where == "anywhere" else rng.randrange(end)
        position = len(data) - 1 - position if where == "tail" else position
        odd_byte = rng.choice(ODD_BYTES)
        data[position] = rng.choice(
            [odd_byte, rng.randrange(256), data[position] ^ 1 << rng.randrange(8)]
        )


def _cut(data: bytearray, rng: random.Random, head: int) -> None:
    del data[rng.choice([rng.randrange(len(data)), rng.randrange(min(head, len(data)))]) :]


def _stretch(data: bytearray, rng: random.Random) -> slice:
    start = rng.randrange(len(data))
    return slice(start, start + rng.choice([4, 16, 200, 4096]))


def _zeroed(data: bytearray, rng: random.Random, _: int) -> None:
    part = _stretch(data, rng)
    data[part] = bytes([rng.choice([0, 255])]) * len(data[part])


def _doubled(data: bytearray, rng: random.Random, _: int) -> None:
    part = _stretch(data, rng)
    data[part] = data[part] * 2


def _moved(data: bytearray, rng: random.Random, _: int) -> None:
    part, target = _stretch(data, rng), rng.randrange(len(data))
    data[target : target + len(data[part])] = data[part]


def _grown(data: bytearray, rng: random.Random, _: int) -> None:
    data += rng.randbytes(rng.choice([1, 100, 5000]))


def damaged_pages(content: bytes, rng: random.Random) -> bytes:
    """Change a database's header, page headers or complete pages."""
    data = bytearray(content)
    count = len(data) // PAGE
    one, other = rng.randrange(count), rng.randrange(count)
    page, other_page = (slice(k * PAGE, (k + 1) * PAGE) for k in (one, other))
    damage = rng.choice(
        ["header", "header", "page", "page", "page", "swap", "double", "zero", "less"]
    )
    if damage == "header":
        for _ in range(rng.choice([1, 1, 2, 5])):
            data[rng.randrange(16, 100)] = rng.choice([*ODD_BYTES, rng.randrange(256)])
    elif damage == "page":
        start = one * PAGE + (100 if one == 0 else 0)
        for _ in range(rng.choice([1, 1, 2, 5])):
            data[start + rng.choice([rng.randrange(12), rng.randrange(64)])] = rng.randrange(256)
    elif damage == "swap":
        data[page], data[other_page] = data[other_page], data[page]
    elif damage == "double":
        data[page] = data[other_page]
    elif damage == "zero":
        data[page] = bytes(PAGE)
    else:
        del data[page]
    return bytes(data)


# --- a session --------------------------------------------------------------------------------


def damage_session(path: Path, rng: random.Random) -> str:
    """Damage a session in place; return the kind of damage."""
    damage = rng.choice(
        ["bytes"] * 3 + ["pages"] * 4 + ["journal"] * 2 + ["tables"] * 5 + ["blob"] * 6
    )
    if damage == "bytes":
        path.write_bytes(damaged_bytes(path.read_bytes(), rng))
    elif damage == "pages":
        path.write_bytes(damaged_pages(path.read_bytes(), rng))
    elif damage == "journal":
        _damage_journal(path, rng)
    elif damage == "tables":
        for _ in range(rng.choice([1, 1, 2, 4])):
            _change_table(path, rng)
    else:
        _change_blob(path, rng)
    return damage


def _damage_journal(path: Path, rng: random.Random) -> None:
    original = path.read_bytes()
    hot_journal(path)
    journal = Path(f"{path}-journal")
    damage = rng.choice(["journal", "both", "foreign", "noise", "empty", "whole"])
    if damage in ("journal", "both"):
        journal.write_bytes(damaged_bytes(journal.read_bytes(), rng, 600))
    if damage == "both":
        path.write_bytes(damaged_bytes(path.read_bytes(), rng))
    elif damage == "foreign":
        path.write_bytes(damaged_bytes(original, rng))
    elif damage == "noise":
        journal.write_bytes(rng.randbytes(3000))
    elif damage == "empty":
        journal.write_bytes(b"")


def _connected(path: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("PRAGMA ignore_check_constraints = ON")
    return connection


ODD_VALUES = (
    "NULL", "0", "-1", "1", "9223372036854775807", "-9223372036854775808", "1e308", "-9e999", "0.5",
    "''", "'text'", "'1'", "'ok'", "char(0)", "char(55296)", "x''", "x'00ff'", "zeroblob(2000)",
    "x'4c414231'", "CAST(x'ff41' AS TEXT)", "'2026-01-01T00:00:00+00:00'", "'fit'",
)  # fmt: skip

PRAGMAS = (
    "user_version = 0", "user_version = 2", "user_version = 2000000000", "user_version = -3",
    "application_id = 0", "application_id = -1", "journal_mode = WAL", "auto_vacuum = 1; VACUUM",
    "page_size = 512; VACUUM", "page_size = 65536; VACUUM", "schema_version = 77",
)  # fmt: skip


def _change_table(path: Path, rng: random.Random) -> None:
    connection = _connected(path)
    try:
        _change_one_table(connection, rng)
    except sqlite3.Error:
        pass  # rejected by SQLite: the table is unchanged
    finally:
        connection.close()


def _change_one_table(connection: sqlite3.Connection, rng: random.Random) -> None:
    rows = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
    names = [name for (name,) in rows]
    names = [name for name in names if not name.startswith("sqlite_")] or ["document"]
    weights = [4 if name in ("result", "frame", "document") else 1 for name in names]
    (table,) = rng.choices(names, weights)
    columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")] or ["id"]
    column, other = rng.choice(columns[: rng.choice([8, 99])]), rng.choice(columns)
    condition = (
        f"rowid IN (SELECT rowid FROM {table} ORDER BY random() LIMIT {rng.choice([1, 1, 1, 99])})"
    )
    condition = condition.replace("random()", f"rowid * {rng.randrange(1, 99)} % 101")
    odd_value, step = rng.choice(ODD_VALUES), rng.choice([1, 0.01])
    row = rng.choices(ODD_VALUES, k=len(columns))
    triggered = f"BEGIN UPDATE {table} SET {column} = {odd_value}; END"
    statements = [
        *[f"UPDATE OR REPLACE {table} SET {column} = {odd_value} WHERE {condition}"] * 6,
        *[f"UPDATE OR REPLACE {table} SET {column} = {column} + {step} WHERE {condition}"] * 2,
        f"UPDATE OR REPLACE {table} SET {column} = {other} WHERE {condition}",
        f"UPDATE OR REPLACE {table} SET {column} = (SELECT {column} FROM {table} LIMIT 1 OFFSET 1) "
        f"WHERE {condition}",
        *[f"DELETE FROM {table} WHERE {condition}"] * 2,
        f"DELETE FROM {table}",
        f"DROP TABLE {table}",
        f"INSERT OR REPLACE INTO {table} ({column}) VALUES ({odd_value})",
        f"INSERT OR REPLACE INTO {table} VALUES ({', '.join(row)})",
        f"ALTER TABLE {table} RENAME COLUMN {column} TO more",
        f"ALTER TABLE {table} ADD COLUMN more TEXT DEFAULT 'x'",
        f"CREATE VIEW more AS SELECT * FROM {table}",
        f"CREATE TRIGGER more AFTER UPDATE ON {table} {triggered}",
        f"CREATE TRIGGER more AFTER INSERT ON document {triggered}",
        f"CREATE TABLE more AS SELECT * FROM {table}",
        "PRAGMA writable_schema = ON; UPDATE sqlite_master SET rootpage = "
        f"{rng.randrange(1, 9)} WHERE name = '{table}'",
        "PRAGMA writable_schema = ON; UPDATE sqlite_master SET sql = replace(sql, 'NOT NULL', '')",
        *[f"PRAGMA {pragma}" for pragma in PRAGMAS],
    ]
    connection.executescript(rng.choice(statements))


# --- a blob with a right checksum and wrong content ---------------------------------------------

BLOBS = (
    ("document", "content"), ("document", "content"), ("change_part", "before"),
    ("change_part", "after"), ("recording", "content"), ("inputs", "setup"),
    ("inputs", "settings"), ("detail", "content"), ("detail", "content"), ("detail", "content"),
    ("frame_image", "content"),
)  # fmt: skip

ODD_TREES: tuple[Any, ...] = (
    None, True, 0, -1, 3.5, 1e308, float("nan"), float("inf"), 10**30, "", "text", "ok", [], {},
    {"list": []}, {"tuple": [1, 2]}, {"dict": []}, {"bytes": [0, 5]}, {"frozenset": [1]},
    {"array": ["<f8", [3], 0]}, {"array": ["<i8", [2, 2], 0]}, {"array": ["|O", [1], 0]},
    {"array": ["<f8", [10**12], 0]}, {"array": ["<f8", [0], 0]}, {"array": ["|S8", [2], 0]},
    {"Record": {}}, {"Settings": {}}, {"FlatSurface": 0.5}, {"Nothing": {}},
    {"ThinPlateSurface": {"array": ["<f8", [2, 3], 0]}}, {"Laser": {"projection_angle_deg": "x"}},
    {"CloughTocherSurface": {"array": ["<f8", [1, 3], 0]}},
)  # fmt: skip


def _change_blob(path: Path, rng: random.Random) -> None:
    connection = _connected(path)
    table, column = rng.choice(BLOBS)
    rows = connection.execute(
        f"SELECT rowid, {column} FROM {table} WHERE {column} IS NOT NULL"
    ).fetchall()
    if rows:
        rowid, content = rng.choice(rows)
        if content.startswith(MAGIC):
            changed = _repacked(content, rng)
        else:
            changed = damaged_bytes(content, rng)
        same = f"{column} = (SELECT {column} FROM {table} WHERE rowid = ?)"
        connection.execute("PRAGMA foreign_keys = OFF")
        if table == "document" or rng.random() < 0.5:
            # The history is changed alike.
            connection.execute(
                f"UPDATE change_part SET after = ? WHERE after IS "
                f"(SELECT {column} FROM {table} WHERE rowid = ?)",
                (changed, rowid),
            )
        connection.execute(f"UPDATE {table} SET {column} = ? WHERE {same}", (changed, rowid))
    connection.close()


@functools.cache
def _bomb() -> bytes:
    """Return a few megabytes that decompress to four gigabytes."""
    packer = zlib.compressobj(1)
    chunk, count = 1 << 24, 256
    head = packer.compress(b"") + packer.flush(zlib.Z_FULL_FLUSH)
    same = packer.compress(bytes(chunk)) + packer.flush(zlib.Z_FULL_FLUSH)
    checksum = (chunk * count % 65521 << 16) + 1  # Adler's, of zeros
    return b"".join([head, *[same] * count, b"\x03\x00", checksum.to_bytes(4, "big")])


def _repacked(content: bytes, rng: random.Random) -> bytes:
    plain = zlib.decompress(content[HEAD.size :])
    length = int.from_bytes(plain[:4], "little")
    tree, arrays = json.loads(plain[4 : 4 + length]), plain[4 + length :]
    damage = rng.choice(["tree"] * 8 + ["arrays", "deep", "bomb", "text", "plain", "length"])
    if damage == "tree":
        for _ in range(rng.choice([1, 1, 3])):
            tree = _changed_tree(tree, rng)
        text = json.dumps(tree)
    elif damage == "deep":
        text = '{"list":[' * 100_000 + "]}" * 100_000
    elif damage == "text":
        text = damaged_bytes(json.dumps(tree).encode(), rng).decode("latin-1")
    else:
        text = json.dumps(tree)
    if damage == "arrays" and arrays:
        arrays = damaged_bytes(arrays, rng)
    stated = len(text.encode()) if damage != "length" else rng.choice([0, 3, 2**32 - 1])
    body = struct.pack("<I", stated) + text.encode() + arrays
    if damage == "plain":
        body = damaged_bytes(body, rng)
    packed = _bomb() if damage == "bomb" else zlib.compress(body, 1)
    return HEAD.pack(MAGIC, zlib.crc32(packed)) + packed


def _changed_tree(tree: Any, rng: random.Random) -> Any:
    """Return the tree with one change: another value, a key removed, renamed or moved."""
    places: list[Callable[[Any], None]] = []

    def walk(node: Any) -> None:
        if isinstance(node, dict | list):
            keys = list(node) if isinstance(node, dict) else range(len(node))
            for key in keys:
                places.append(lambda value, node=node, key=key: node.__setitem__(key, value))
                walk(node[key])
            if keys:
                last = keys[-1]
                places.append(lambda _, node=node, last=last: node.pop(last))
                if isinstance(node, dict):
                    places.append(lambda _, node=node, last=last: node.update(more=node[last]))
                else:
                    places.append(lambda _, node=node: node.append(node[0]))
                    places.append(lambda _, node=node: rng.shuffle(node))

    walk(tree)
    if not places or rng.random() < 0.1:
        return rng.choice(ODD_TREES)
    rng.choice(places)(json.loads(json.dumps(rng.choice(ODD_TREES))))
    return tree


# --- text: a setup, a table, a manifest ----------------------------------------------------------

ODD_WORDS = (
    "nan", "inf", "-inf", "1e400", "-0.0", "9" * 400, "0x1F", "1_000", "true", '"text"', "''", "[]",
    "{}", "[[", "]]", "[1, [2, 3]]", "2026-01-01", "07:32:00", "{a = 1}", "\x00", "\ufeff",
    "\u2028",
    "=", ",", ";", "\t", '"', "\n", "\r", "-1", "0", "1e-320", "١٢", "10.5", '{"name": 1}', "null",
    "..", "/etc/passwd", "a/b", "\\ud800", "[laser]", "[[laser]]", "laser.distance_mm = 3", "# ",
)  # fmt: skip


WORD = re.compile(r"[^\s,;=:\[\]]+|[,;=:\[\]]")


def damaged_text(content: bytes, rng: random.Random) -> bytes:
    """Change tokens, lines or bytes."""
    damage = rng.choice(
        ["bytes", "word", "word", "word", "word", "line", "line", "deep", "long", "utf"]
    )
    if damage == "bytes":
        return damaged_bytes(content, rng)
    if damage == "utf":
        return content.decode().encode(rng.choice(["utf-16", "utf-32", "utf-8-sig", "utf-16-le"]))
    if damage == "deep":
        depth = rng.choice([50, 5000, 100_000])
        brackets = rng.choice(["[", "{a = ", '{"a":', "a."])
        return content + f"\nmore = {brackets * depth}".encode()
    if damage == "long":
        position = rng.randrange(len(content))
        return (
            content[:position]
            + rng.choice([b"9", b"x", b",", b"[]\n", b" "]) * 200_000
            + content[position:]
        )
    lines = content.decode().split("\n")
    for _ in range(rng.choice([1, 1, 2, 5])):
        k = rng.randrange(len(lines))
        if damage == "line":
            rng.choice(
                [
                    lambda k=k: lines.pop(k) if len(lines) > 1 else None,
                    lambda k=k: lines.insert(rng.randrange(len(lines)), lines[k]),
                    lambda k=k: lines.__setitem__(k, rng.choice(ODD_WORDS)),
                    lambda: rng.shuffle(lines),
                ]
            )()
            continue
        words = [(match.start(), match.end()) for match in WORD.finditer(lines[k])]
        start, end = rng.choice(words or [(0, 0)])
        new = rng.choice([*ODD_WORDS, *(lines[k][a:b] for a, b in words * 5)])
        lines[k] = lines[k][:start] + new + lines[k][end:]
    return "\n".join(lines).encode("utf-8", "replace")
