"""Foreign text for people: escaped and cut here for terminal and Markdown, for HTML in `cosfly/viz/page.py`.

Names of folders, contents of files and answers of servers may hold escape sequences, tags, table bars, or 200 MB.
"""

from __future__ import annotations

import html
import re
from typing import Any

LONGEST = 2_000  # characters of one foreign text that a person is shown; the middle of a longer one is cut
LONGEST_LOG = 20_000  # of one log record, which may be the traceback of a bug

# Control characters that a terminal obeys (C0, DEL, C1) and bidirectional controls. Line feed and tab are harmless.
_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_MARKDOWN = re.compile(r"([\\`*\[\]|~#]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9]))")  # within a word, _ means itself


def cut(text: str, longest: int = LONGEST) -> str:
    """Return a text of about `longest` characters at most: the middle of a longer one is replaced by its length."""
    if len(text) <= longest:
        return text
    head = longest * 2 // 3
    return f"{text[:head]} ... ({len(text) - longest:,} characters left out) ... {text[head - longest :]}"


def for_terminal(text: str, longest: int = LONGEST) -> str:
    """Return text with control characters as `\\x1b`, which a terminal prints."""
    return _CONTROLS.sub(lambda match: ascii(match[0])[1:-1], cut(text, longest))


def for_markdown(text: str) -> str:
    """Return text that Markdown shows as it is, on one line, also in a table: no tag, link, emphasis or bar works."""
    line = " ".join(for_terminal(text).split())
    return _MARKDOWN.sub(r"\\\1", html.escape(line, quote=False))


def markdown_code(text: str) -> str:
    """Return text as a code span of Markdown, on one line: the fence is longer than any run of backticks in it."""
    line = " ".join(for_terminal(text).split()).replace("|", "\\|")
    runs = re.findall("`+", line)
    fence = "`" * (max(map(len, runs), default=0) + 1)
    space = " " if runs or not line else ""
    return f"{fence}{space}{line}{space}{fence}"


# --- published --------------------------------------------------------------------------------------------------------

ADDRESS = re.compile(r"[A-Za-z][\w+.-]*://[^\s,;'\"]*")
# From the root, a home or a drive; behind letters (`and/or`) it is no path.
ABSOLUTE = re.compile(r"(?<![\w.])(?:~|[A-Za-z]:)?[\\/][^\s,;'\"]*")
IS_ABSOLUTE = re.compile(r"~|[\\/]|[A-Za-z]:[\\/]")
# One slash: a name on the hub.
RELATIVE = re.compile(r"\.{1,2}[\\/]\S*|[\w.-]+(?:[\\/][\w.-]+){2,}[\\/]?|[\w.-]+\\[\w.-]+")


def published_name(text: str) -> str:
    """Return a text with each path replaced by its last name, and each URL by `an address`."""
    if IS_ABSOLUTE.match(text) or RELATIVE.fullmatch(text):
        return _last_name(text)
    text = ADDRESS.sub("an address", text)
    return ABSOLUTE.sub(lambda match: _last_name(match.group()), text)


def published(value: Any) -> Any:
    """Return settings with paths and URLs replaced as by `published_name`."""
    if isinstance(value, str):
        return published_name(value)
    if isinstance(value, dict):
        return {published_name(str(key)): published(member) for key, member in value.items()}
    return [published(member) for member in value] if isinstance(value, list | tuple) else value


def _last_name(path: str) -> str:
    return next((part for part in reversed(re.split(r"[\\/]", path)) if part.strip("~.")), "a path")
