"""Foreign text for people: escaped and cut here for terminal and Markdown, for HTML in `cosfly/viz/page.py`.

Names of folders, contents of files and answers of servers may hold escape sequences, tags, table bars, or 200 MB.
"""

import html
import re

LONGEST = 2_000  # characters of one foreign text that a person is shown; the middle of a longer one is cut
LONGEST_LOG = 20_000  # of one log record, which may be the traceback of a bug

# Control characters that a terminal obeys (C0, DEL, C1) and bidirectional controls. Line feed and tab are harmless.
_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_MARKDOWN = re.compile(r"([\\`*\[\]|~#]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9]))")  # within a word, _ means itself


# All repetitions before a fixed character are bounded, so that the time is linear in the length of a foreign text.
# An address, `https://host/path`, or a user with a password, `user:password@`. A slot of a caption is no address:
# `{change:distance@t2-t4}`.
_ADDRESS = re.compile(
    r"\b[A-Za-z][\w+.-]{0,30}://[^\s'\"<>]+|\b(?!(?<=\{)\w+:\w+@t\d)[\w.+-]{1,100}:[^\s@/'\"<>]{1,500}@(?=\w)"
)
# What may be a key in an address, and its replacement: user and password; query, parameters and fragment; and a part of
# the path that names itself a key, such as `key=1234567` or `sk-1234567`.
_KEYS = (
    (re.compile(r"(^|//)[^/]*(@|%40)"), r"\1***@"),
    (re.compile(r"(?i)([?;&]|%3f|%3b|%26|#(?=[^#]*=)).*"), "?***"),
    (re.compile(r"(?i)((?<![a-z])(sk|hf|gsk|key|token|secret|password|bearer)([-_=/]|%3d))[\w.~%+-]{6,}"), r"\1***"),
)


def without_keys(text: str) -> str:
    """Return text with `***` for what may be an access key in an address."""

    def masked(match: re.Match[str]) -> str:
        address = match[0]
        for pattern, replacement in _KEYS:
            address = pattern.sub(replacement, address)
        return address

    return _ADDRESS.sub(masked, text)


def cut(text: str, longest: int = LONGEST) -> str:
    """Return a text of about `longest` characters at most: the middle of a longer one is replaced by its length."""
    if len(text) <= longest:
        return text
    head = longest * 2 // 3
    return f"{text[:head]} ... ({len(text) - longest:,} characters omitted) ... {text[head - longest :]}"


def for_terminal(text: str, longest: int = LONGEST) -> str:
    """Return text with control characters as `\\x1b`, which a terminal prints, and without keys in addresses."""
    return _CONTROLS.sub(lambda match: ascii(match[0])[1:-1], without_keys(cut(text, longest)))


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
