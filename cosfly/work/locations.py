"""Addresses that fsspec opens, and how they are shown."""

from __future__ import annotations

import re
from typing import Any
from urllib.parse import urlsplit, urlunsplit

from cosfly.errors import EnvironmentMissing, InputError

CHAIN = re.compile(r"::(?![^\[]*\])")  # between the links of a chain, not within [::1]


def without_secrets(address: str) -> str:
    """Give an address without user, password, query and fragment; of a chain (`zip://x::https://...`) each link."""
    return "::".join(_plain(link) for link in CHAIN.split(address))


def _plain(link: str) -> str:
    if "://" not in link:  # a folder, or what is left of an address that is none
        return re.split("[?#]", link, maxsplit=1)[0].rpartition("@")[2]
    try:
        parts = urlsplit(link)
        host = parts.netloc.rpartition("@")[2]
    except ValueError:
        return f"{link.partition('://')[0]}://..."
    return urlunsplit((parts.scheme, host, parts.path, "", ""))


def opened(address: str) -> tuple[Any, str]:
    """Give the file system of an address, and the path in it."""
    shown = without_secrets(address)
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        fix = "pip install 'cosfly[remote]'"
        raise EnvironmentMissing("fsspec is not installed", where=shown, fix=fix) from None
    try:
        system, root = url_to_fs(address)
    except ImportError as error:
        fix = re.sub(r".*nstall ([\w.-]+) to .*", r"pip install \1", str(error))  # 'Install s3fs to access S3'
        raise EnvironmentMissing("what opens such addresses is not installed", where=shown, fix=fix) from None
    except Exception as error:  # each file system has its own; their words may hold the address
        got, expected = type(error).__name__, "what fsspec opens"
        raise InputError("no such address", where=shown, got=got, expected=expected) from None
    return system, str(root).rstrip("/")
