"""Makes hostile files of honest ones: `mutated(name, data, rng)`. What is made depends on the generator alone.

Half of the changes know nothing of the format; the others keep it: JSON, JSON lines (with the checksums of a journal),
YAML, `.npy`, PNG, gzip, parquet, checksums. What is broken in structure never gets past a parser; what is broken in
meaning does.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import random
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import pyarrow.parquet as pq
import yaml

Instead = Literal[
    "pipe", "folder", "device", "link out", "link to itself", "link to nothing", "nothing", "20 GB of nothing"
]
INSTEAD: tuple[Instead, ...] = (
    "pipe", "folder", "device", "link out", "link to itself", "link to nothing", "nothing", "20 GB of nothing",
)  # fmt: skip
HUGE: Instead = "20 GB of nothing"
Random = random.Random

TOKENS = [
    b"NaN", b"-Infinity", b"1e999", b"-1e-999", b"7" * 400, b"9" * 39, b"18446744073709551616", b"-1", b"0", b"null",
    b"true",
    b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"\xc3\x28", b"\xed\xa0\x80", b"\\ud800", b"\x1b[31m", b"\r", b"\n", b"\n\n",
    b"\xe2\x80\xa8",
    b"[" * 300, b"]" * 300, b'{"a":' * 300, b'"', b"'", b"{", b"}", b"[", b"]", b",", b":", b"\\", b"&a [*a]",
    b"!!python/name:os.system ",
    b"<<: *a", b"../" * 20 + b"etc/passwd", b"/dev/zero", b"<script>", b"[bold]", b"%s%n", b"x" * 70_000, b" " * 70_000,
    b"PAR1",
    b"\x89PNG\r\n\x1a\n", b"\x93NUMPY\1\0", b"\x1f\x8b\x08\0", b"<think>" * 200, b"```json", b"{{" * 200, b"//", b"/*",
    b"#", b"---\n",
]  # fmt: skip
WHOLE = [
    b"", b"\0", b"\n", b"null", b"[]", b"{}", b"0", b'""', b'"word"', b"[NaN,[[[", b"[" * 100_000, b'{"a":' * 50_000,
    b"[" * 60 + b"]" * 60,
    "{}".encode("utf-16"), b"\xff" * 1000, b"7" * 5000, b"a: &a [x, x]\n" + b"".join(b"%c: &%c [*%c, *%c, *%c]\n" % (k,
    k, k - 1, k - 1, k - 1) for k in range(98, 120)),
    gzip.compress(b"0" * 200_000_000, 9, mtime=0), b"\x1f\x8b\x08\0", b"PAR1" + b"\0" * 40 + b"\xff\xff\xff\x7fPAR1",
    b"# " * 40_000, b"[[]," * 50_000,
]  # fmt: skip


class Raw:
    """JSON text that no value gives."""

    def __init__(self, text: str) -> None:
        self.text = text


VALUES: list[Any] = [
    None, True, False, 0, -1, 1, 2, 1.5, -0.0, 1e308, -1e308, 5e-324, 1e18, 2**31, 2**53 + 1, 2**63, 2**64, 10**39,
    10**9, "", "x", "0", "nan", "1e999",
    "\0", "\x1b[31m", "../../../etc/passwd", "/dev/zero", "/", ".", "..", "a/b", "a" * 300, "<script>alert(1)</script>",
    "[bold]", "行人", "\u202e", "x" * 100_000,
    "2026-01-01", [], {}, [[]], [None], [0, 0, 0], ["x"], {"x": 0}, [{}], [{}] * 20_000, {"": ""}, [1e308] * 4,
    list(range(2000)),
    Raw("NaN"), Raw("1e999"), Raw("-Infinity"),
    Raw("7" * 400), Raw("-" + "7" * 5000), Raw('"\\ud800"'), Raw("[" * 70 + "]" * 70), Raw("[" * 50 + "]" * 50),
    Raw("[" * 5000 + "]" * 5000), Raw("1E400"), Raw("01"),
]  # fmt: skip


def mutated(name: str, data: bytes, rng: Random) -> bytes | Instead:
    """Give what stands in the place of a file: other bytes, or no file. One change, seldom two or three."""
    if rng.random() < 0.03:
        return rng.choice(INSTEAD)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        change = _any_bytes if rng.random() < 0.3 else _keeping(name)
        data = change(data, rng)
    return data


def mutated_text(text: str, rng: Random) -> str:
    """Give another text of the same kind: an answer, a setting, a URL."""
    kind = "x.json" if text.lstrip().startswith(("{", "[")) else "x.txt"
    data = _any_bytes(text.encode(), rng) if rng.random() < 0.5 else _keeping(kind)(text.encode(), rng)
    return data.decode("utf-8", rng.choice(("replace", "surrogateescape", "ignore")))


def put(path: Path, content: bytes | Instead) -> None:
    """Put it where a file stood."""
    clear(path)
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content == "folder":
        path.mkdir()
    elif content == "pipe":
        import os

        os.mkfifo(path)
    elif content == HUGE:
        with open(path, "wb") as file:
            file.truncate(20_000_000_000)
    elif content != "nothing":
        targets = {"device": "/dev/zero", "link out": "/etc/passwd", "link to itself": path.name}
        path.symlink_to(targets.get(content, "gone"))


def clear(path: Path) -> None:
    """Take away whatever stands there."""
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    else:
        path.unlink(missing_ok=True)


# --- changes that know nothing ----------------------------------------------------------------------------------------


def _any_bytes(data: bytes, rng: Random) -> bytes:
    if not data or rng.random() < 0.05:
        return rng.choice(WHOLE)
    begin, end = sorted((rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)))
    end = min(end, begin + rng.choice((1, 4, 64, 4096)))
    return rng.choice(
        [
            lambda: _flipped(data, rng),
            lambda: data[:begin],
            lambda: data[:begin] + data[end:],
            lambda: data[:end] + data[begin:],
            lambda: data[:begin] + rng.choice(TOKENS) + data[begin:],
            lambda: data[:begin] + rng.choice(TOKENS) + data[end:],
            lambda: data[:begin] + rng.randbytes(end - begin) + data[end:],
            lambda: data[end:] + data[:end],
            lambda: data + data,
        ]
    )()


def _flipped(data: bytes, rng: Random) -> bytes:
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8))):
        found[rng.randrange(len(found))] ^= 1 << rng.randrange(8)
    return bytes(found)


# --- JSON, JSON lines, journals, YAML ---------------------------------------------------------------------------------

_MARK = re.compile(r'"@@(\d+)@@"')


def _json(data: bytes, rng: Random) -> bytes:
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return _any_bytes(data, rng)
    return _changed(value, rng).encode("utf-8", "surrogatepass")


def _changed(value: Any, rng: Random) -> str:
    """Change one place of a value, and write it as JSON."""
    raws: list[str] = []

    def plain(new: Any) -> Any:
        if isinstance(new, Raw):
            raws.append(new.text)
            return f"@@{len(raws) - 1}@@"
        return new

    box = [value]
    places = list(_places(box))
    group, key = rng.choice(places)
    # A place deep in a long series is as likely as all its siblings, so the few keys at the top get their share.
    if rng.random() < 0.4:
        group, key = min(
            (rng.choice(places) for _ in range(6)),
            key=lambda place: len(str(type(place[0][place[1]]))) + 1e9 * (place[0] is box),
        )
    _change(group, key, rng, places, plain)
    text = json.dumps(box[0], ensure_ascii=rng.random() < 0.5) if box else ""
    text = text.replace('"@@twice@@', '"')
    return _MARK.sub(lambda match: raws[int(match[1])] if int(match[1]) < len(raws) else match[0], text)


def _places(group: Any) -> Any:
    stack = [group]
    while stack:
        group = stack.pop()
        for key in group if isinstance(group, dict) else range(len(group)):
            yield group, key
            if isinstance(group[key], dict | list):
                stack.append(group[key])


def _change(group: Any, key: Any, rng: Random, places: list, plain: Callable[[Any], Any]) -> None:
    old = group[key]
    way = rng.randrange(9)
    if way == 0 and len(group) > 1:
        del group[key]
    elif way == 1 and isinstance(group, dict):
        group[rng.choice(("x", "", "id", f"@@twice@@{key}", str(key).upper()))] = plain(rng.choice(VALUES))
    elif way == 2:
        other, k = rng.choice(places)
        group[key] = json.loads(json.dumps(other[k]))
    elif way == 3 and isinstance(old, list):
        group[key] = old * rng.choice((0, 2, 300)) if len(old) < 1000 else old[: rng.randrange(len(old))]
    elif way == 4 and isinstance(old, int | float) and abs(old) < 1e300:
        group[key] = rng.choice((-old, old + 1, old - 1, old * 1e6, old * 1e-6, old * 1e300, str(old), [old], not old))
    elif way == 5 and isinstance(old, str):
        group[key] = (
            mutated_text(old, rng)
            if old and rng.random() < 0.5
            else rng.choice((old * 2, old.upper(), old[:-1], old + "\0", "../" + old, [old]))
        )
    elif way == 6 and isinstance(group, list):
        rng.shuffle(group)
    else:
        group[key] = plain(rng.choice(VALUES))


def _json_lines(data: bytes, rng: Random) -> bytes:
    lines = data.splitlines(keepends=True)
    if not lines:
        return _any_bytes(data, rng)
    k = rng.randrange(len(lines))
    way = rng.randrange(10)
    if way == 0:
        del lines[k]
    elif way == 1:
        lines.insert(rng.randrange(len(lines)), lines[k])
    elif way == 2:
        lines[k] = lines[k].rstrip(b"\n") + rng.choice((b"", b"\r\n", b"\n\n", b" \n"))
    elif way == 3:
        rng.shuffle(lines)
    else:
        lines[k] = _line(lines[k], rng)
    return b"".join(lines)


def _line(line: bytes, rng: Random) -> bytes:
    """Change a line's content; a journal's line gets the checksum of what it then says."""
    found = re.fullmatch(rb"([0-9a-f]{16}) (.*)\n", line, re.DOTALL)
    if not found:
        return _json(line, rng).replace(b"\n", b"") + b"\n"
    body = _json(found[2], rng).replace(b"\n", b"")
    return hashlib.sha256(body).hexdigest()[:16].encode() + b" " + body + b"\n"


def _yaml(data: bytes, rng: Random) -> bytes:
    try:
        value = yaml.load(data, yaml.CSafeLoader)
        return _changed(value, rng).encode("utf-8", "surrogatepass") if rng.random() < 0.7 else _words(data, rng)
    except (yaml.YAMLError, ValueError, TypeError, RecursionError):
        return _any_bytes(data, rng)


def _words(data: bytes, rng: Random) -> bytes:
    """Change one word of a text."""
    words = re.split(rb"(\s+|[=:,])", data)
    k = rng.randrange(len(words))
    words[k] = rng.choice([*TOKENS, b"", rng.choice(words), words[k] * 2])
    return b"".join(words)


# --- arrays, pictures, gzip, parquet, checksums -----------------------------------------------------------------------


def _npy(data: bytes, rng: Random) -> bytes:
    if len(data) < 80 or rng.random() < 0.2:
        return _flipped(data, rng) if data else data
    (length,) = struct.unpack_from("<H", data, 8)
    header, body = data[10 : 10 + length], data[10 + length :]
    pattern, news = rng.choice(
        [
            (rb"\(\d+, *\d+\)", [b"(1000000, 1000000)", b"(0, 0)", b"(36,)", b"()", b"(-1, -1)",
            b"(9999999999999999999, 0)", b"(2304, 1)", b"(36, 64, 1)", b"(1, 36, 64)", b"(1e9, 1)"]),
            (rb"'<f4'", [b"'<f8'", b"'|O8'", b"'>f4'", b"'<i4'", b"'|V4'", b"'<U1'", b"[('a', '<f4')]", b"'<m8[s]'",
            b"'<c8'", b"'|b1'"]),
            (rb"False", [b"True", b"None", b"__import__('os')", b"1"]),
        ]
    )  # fmt: skip
    if rng.random() < 0.5:
        header = re.sub(pattern, lambda _: rng.choice(news), header)
    else:
        number = struct.pack("<f", rng.choice((float("nan"), float("inf"), -1.0, 1e38, 0.0)))
        at = 4 * rng.randrange(max(1, len(body) // 4))
        body = number * (len(body) // 4) if rng.random() < 0.3 else body[:at] + number + body[at + 4 :]
    return data[:8] + struct.pack("<H", len(header) & 0xFFFF) + header + body


def _chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def _png(data: bytes, rng: Random) -> bytes:
    """Change chunks of a PNG; their checksums fit."""
    chunks, at = [], 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    if len(chunks) < 3 or chunks[0][0] != b"IHDR" or len(chunks[0][1]) != 13:
        return _any_bytes(data, rng)
    k = rng.randrange(len(chunks))
    way = rng.randrange(6)
    if way == 0:
        width, height, *rest = struct.unpack(">IIBBBBB", chunks[0][1])
        sizes = (0, 1, width, height, (width + 1) % 2**32, 7000, 32_000, 2**31 - 1, 2**32 - 1)
        rest[rng.randrange(5)] = rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
        chunks[0] = (b"IHDR", struct.pack(">IIBBBBB", rng.choice(sizes), rng.choice(sizes), *rest))
    elif way == 1:
        chunks[0] = (b"IHDR", struct.pack(">IIBBBBB", *rng.choice(((7000, 7000), (64, 36))), 8, 2, 0, 0, 0))
        chunks[1:] = [(b"IDAT", zlib.compress(b"\0" * rng.choice((1, 10_000, 60_000_000)), 1)), (b"IEND", b"")]
    elif way == 2:
        del chunks[k]
    elif way == 3:
        chunks.insert(k, chunks[rng.randrange(len(chunks))])
    elif way == 4:
        extra = rng.choice((b"zTXt", b"iCCP", b"iTXt", b"PLTE", b"tRNS", b"acTL", b"eXIf", b"gAMA"))
        chunks.insert(1, (extra, b"a\0\0" + zlib.compress(b"x" * rng.choice((10, 30_000_000)), 1)))
    else:
        name, body = chunks[k]
        chunks[k] = (name, _any_bytes(body, rng) if body else b"x")
    return data[:8] + b"".join(_chunk(*chunk) for chunk in chunks)


def _gzip(data: bytes, rng: Random) -> bytes:
    try:
        return gzip.compress(_json(gzip.decompress(data), rng), 1, mtime=0)
    except (OSError, EOFError, zlib.error):
        return _any_bytes(data, rng)


def _parquet(data: bytes, rng: Random) -> bytes:
    """Change a table and write it anew, or the footer's bytes."""
    if rng.random() < 0.5 and len(data) > 12:
        (length,) = struct.unpack_from("<I", data, len(data) - 8)
        footer = data[-8 - length : -8]
        changed = _flipped(footer, rng) if footer else footer
        return data[: -8 - length] + changed + struct.pack("<I", rng.choice((length, length, 0, 2**31 - 1))) + data[-4:]
    try:
        table = pq.read_table(io.BytesIO(data))
    except (pa.ArrowException, OSError, ValueError):
        return _any_bytes(data, rng)
    out = io.BytesIO()
    pq.write_table(_other_table(table, rng), out, row_group_size=rng.choice((1, 1000)))
    return out.getvalue()


def _other_table(table: pa.Table, rng: Random) -> pa.Table:
    k, way = rng.randrange(table.num_columns), rng.randrange(5)
    field = table.schema.field(k)
    if way == 0:
        return table.drop_columns([field.name])
    if way == 1:
        return table.slice(0, rng.choice((0, 1)))
    if way == 2:
        return table.append_column(field.name, table.column(k))
    if way == 3:
        return table.set_column(k, field.name, pa.nulls(table.num_rows, field.type))
    rows = table.column(k).to_pylist()
    values = [value for value in VALUES if not isinstance(value, Raw | int)]
    for at in range(len(rows)) if rng.random() < 0.5 else [rng.randrange(max(1, len(rows)))]:
        if at < len(rows):
            rows[at] = (
                rng.choice([float("nan"), float("inf"), *values])
                if not isinstance(rows[at], dict)
                else {**rows[at], "bytes": rng.choice(WHOLE)}
            )
    try:
        return table.set_column(k, field, pa.array(rows, field.type))
    except (pa.ArrowException, TypeError, ValueError, OverflowError):
        return table.set_column(k, field.name, pa.array([str(row) for row in rows]))


NAMES = [
    b"../" * 8 + b"etc/passwd", b"/etc/passwd", b"", b".", b"a\0b", b"\xff", b"a" * 300, b"trajectory.json", b"//",
    b"frames_playback",
]  # fmt: skip


def _checksums(data: bytes, rng: Random) -> bytes:
    lines, digest, name = data.splitlines(keepends=True), b"0" * 64, rng.choice(NAMES)
    line = rng.choice([
        digest + b"  " + name, b"0" * 63 + b"  x", digest + name, b"G" * 64 + b"  x", digest.upper() + b" *" + name,
    ])  # fmt: skip
    lines.insert(rng.randrange(len(lines) + 1), line + b"\n")
    return b"".join(lines) if rng.random() < 0.6 else _words(data, rng)


_BY_ENDING: dict[str, Callable[[bytes, Random], bytes]] = {
    ".json": _json, ".jsonl": _json_lines, ".yaml": _yaml, ".npy": _npy, ".png": _png, ".gz": _gzip,
    ".parquet": _parquet, ".sha256": _checksums,
}  # fmt: skip


def _keeping(name: str) -> Callable[[bytes, Random], bytes]:
    return _BY_ENDING.get(Path(name).suffix, _words)
