"""What of a text may be published: no paths and no addresses of the machine that made a data set, only their last names."""

from __future__ import annotations

import re
from typing import Any

ADDRESS = re.compile(r"[A-Za-z][\w+.-]*://[^\s,;'\"]*")
# From the root, a home or a drive; behind letters (`and/or`) it is no path.
ABSOLUTE = re.compile(r"(?<![\w.])(?:~|[A-Za-z]:)?[\\/][^\s,;'\"]*")
IS_ABSOLUTE = re.compile(r"~|[\\/]|[A-Za-z]:[\\/]")
# One slash: a name on the hub.
RELATIVE = re.compile(r"\.{1,2}[\\/]\S*|[\w.-]+(?:[\\/][\w.-]+){2,}[\\/]?|[\w.-]+\\[\w.-]+")


def published_name(text: str) -> str:
    """Give a text with the last name in the place of each path, and `an address` in that of each URL."""
    if IS_ABSOLUTE.match(text) or RELATIVE.fullmatch(text):
        return _last_name(text)
    text = ADDRESS.sub("an address", text)
    return ABSOLUTE.sub(lambda match: _last_name(match.group()), text)


def published(value: Any) -> Any:
    """Give settings with published names."""
    if isinstance(value, str):
        return published_name(value)
    if isinstance(value, dict):
        return {published_name(str(key)): published(member) for key, member in value.items()}
    return [published(member) for member in value] if isinstance(value, list | tuple) else value


def _last_name(path: str) -> str:
    return next((part for part in reversed(re.split(r"[\\/]", path)) if part.strip("~.")), "a path")
