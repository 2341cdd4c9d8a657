"""Foreign text on its way to people: escaped and cut here, once for each medium.

Names of folders, contents of files and words of servers may hold escape sequences of a terminal, tags, table bars, or 200 MB.
"""

from __future__ import annotations

import base64
import hashlib
import html
import re

LONGEST = 2_000  # characters of one foreign text that a person is shown; the middle of a longer one is left out
LONGEST_LOG = 20_000  # of one log record, which may be the traceback of a bug

# What a terminal obeys instead of printing (C0, DEL, C1), and what turns the order of letters round (bidirectional controls).
# Line feed and tab are harmless; whoever wants one line splits and joins before.
_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_MARKDOWN = re.compile(r"([\\`*\[\]|~#]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9]))")  # within a word, _ means itself


def cut(text: str, longest: int = LONGEST) -> str:
    """Give a text of at most about `longest` characters: the middle of a longer one is left out, and says how much."""
    if len(text) <= longest:
        return text
    head = longest * 2 // 3
    return f"{text[:head]} ... ({len(text) - longest:,} characters left out) ... {text[head - longest :]}"


def for_terminal(text: str, longest: int = LONGEST) -> str:
    """Give text that a terminal prints and never obeys: control characters as `\\x1b`."""
    return _CONTROLS.sub(lambda match: ascii(match[0])[1:-1], cut(text, longest))


def for_html(text: str) -> str:
    """Give text that HTML shows as it is, in an element or in a quoted attribute."""
    return html.escape(for_terminal(text))


def for_markdown(text: str) -> str:
    """Give text that Markdown shows as it is, on one line, also in a cell of a table: no tag, link, emphasis or bar works."""
    line = " ".join(for_terminal(text).split())
    return _MARKDOWN.sub(r"\\\1", html.escape(line, quote=False))


def markdown_code(text: str) -> str:
    """Give text as a code span of Markdown, on one line: the fence is longer than any run of backticks in it."""
    line = " ".join(for_terminal(text).split()).replace("|", "\\|")
    runs = re.findall("`+", line)
    fence = "`" * (max(map(len, runs), default=0) + 1)
    space = " " if runs or not line else ""
    return f"{fence}{space}{line}{space}{fence}"


def html_page(title: str, style: str, body: str, script: str = "") -> str:
    """Give a self-contained page, of a body whose foreign texts went through `for_html`.

    The content security policy lets it do nothing but show itself and run the one script of ours that it names by its hash: no other script, no
    request, no form, even where an escape was forgotten.
    """
    allowed = (
        f"script-src 'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'; " if script else ""
    )
    policy = (
        f"default-src 'none'; {allowed}img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
    )
    run = f"<script>{script}</script>\n" if script else ""
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width">
<title>{for_html(title)}</title><style>{style}</style></head><body>
{body}
{run}</body></html>
"""


def json_block(name: str, text: str) -> str:
    """Give JSON text as an element that a script reads and nothing runs; no text in it can end the element."""
    for sign in "<>&\u2028\u2029":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return f'<script type="application/json" id="{name}">{text}</script>'
