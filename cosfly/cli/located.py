"""Addresses (s3://BUCKET/FOLDER) in place of paths: of every command in one place, before it reads its words."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from cosfly.errors import ConfigError

ADDRESS = re.compile(r"(--[\w-]+=)?([A-Za-z][A-Za-z0-9+.-]*)://.")
ENDPOINTS = ("http", "https")  # of teachers; `release get` opens them itself
WRITTEN = ("--out", "--export", "--json")
# Commands that write where they read; "": what is no option. The first two only without --out.
IN_PLACE = {"run": "", "reproduce": "", "release sign": "", "inspect review": "--inspect", "roi edit": "--roi"}
NO_ADDRESS = {
    "doctor": "it looks at the disk of this machine",
    "list": "`cosfly show ADDRESS` looks at one run",
    "sim serve": "fetch the map first",
}


def located(words: Sequence[str], cache: Path, held: ExitStack) -> list[str]:
    """Give the words of a command with working folders in place of addresses; `held` copies out what is written there."""
    if not any(ADDRESS.match(word) for word in words):
        return list(words)
    from cosfly.work.locations import WorkingFolder

    plain = [word for word in words[:2] if not word.startswith("-") and not ADDRESS.match(word)]
    command = next((name for name in (" ".join(plain), *plain[:1]) if name in IN_PLACE or name in NO_ADDRESS), "")
    options = [word.partition("=")[0] for word in words]
    in_place = None if "--out" in options and command in ("run", "reproduce") else IN_PLACE.get(command)
    given, outputs, inputs = list(words), list[WorkingFolder](), list[WorkingFolder]()
    for number, word in enumerate(words):
        found = ADDRESS.match(word)
        if found is None or found[2].lower() in ENDPOINTS or (plain == ["release", "get"] and options[number] == word):
            continue
        option = (found[1] or "").rstrip("=") or (options[number - 1] if words[number - 1].startswith("--") else "")
        address = word.removeprefix(found[1] or "")
        if command in NO_ADDRESS:
            raise ConfigError("this command works at no address", where=command, fix=NO_ADDRESS[command])
        if found[2].lower() in ("file", "local"):
            given[number] = f"{found[1] or ''}{address.partition('://')[2]}"
            continue
        is_written = option in WRITTEN or (option == in_place and not address.endswith((".yaml", ".yml")))
        folder = WorkingFolder(address, cache, is_written=is_written and "--dry-run" not in words)
        (outputs if is_written else inputs).append(folder)
        given[number] = f"{found[1] or ''}{folder.local}"
    if inputs and plain[:1] == ["caption"] and len(plain) == 1 and "--out" not in options:
        raise ConfigError("captions beside what was fetched would stay here", where="--data", fix="give --out ADDRESS")
    for folder in outputs:
        if "--dry-run" in words:
            folder.fetch(is_input=False)
        else:
            folder.take()
            held.enter_context(folder.at_work())
    for folder in inputs:
        folder.fetch()
    return given


def default_cache() -> Path:
    """Give the folder where what lies elsewhere is kept: `$XDG_CACHE_HOME/cosfly`, or `~/.cache/cosfly`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "cosfly", "locations")
