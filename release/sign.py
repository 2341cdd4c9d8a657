"""Who published a release: an ed25519 signature over its list of checksums, which names every file with its sha256.

The signed bytes are `checksums.sha256` as they stand, so that `openssl pkeyutl -verify` can check them too. Key pairs
are made by other tools: `openssl genpkey -algorithm ed25519` or `ssh-keygen -t ed25519`. Nothing of a private key or
its passphrase is printed, logged or written.
"""

from __future__ import annotations

import base64
import contextlib
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from cosfly.errors import EnvironmentMissing, InputError, VerifyError
from cosfly.reading.documents import FileFormat, read_model
from cosfly.reading.files import read_bytes, sha256_file
from cosfly.work.store import CHECKSUMS, read_checksums, remove_left, storage_errors, write_model
from release.record import RECORD, Strict

SIGNATURE = "signature.json"
FORMAT = FileFormat("cosfly.signature", "1.0", "signature")
PASSPHRASE = "COSFLY_SIGNING_PASSPHRASE"
MOST_SIGNATURE_BYTES = 4_096
MAKE_KEY = "make a pair: openssl genpkey -algorithm ed25519 -out key.pem, openssl pkey -in key.pem -pubout -out pub.pem"
INSTALL = "pip install 'cosfly[sign]'"
log = logging.getLogger(__name__)


class Signature(Strict):
    """`signature.json`. public_key: base64 of its 32 bytes; signature: of its 64, over the bytes of `signed_file`."""

    algorithm: Literal["ed25519"]
    signed_file: Literal["checksums.sha256"]
    public_key: str = Field(pattern="^[A-Za-z0-9+/]{43}=$")
    signature: str = Field(pattern="^[A-Za-z0-9+/]{86}==$")


def read_private_key(path: Path) -> Any:
    """Read an ed25519 private key, PEM as openssl or ssh-keygen write it; an encrypted one by the passphrase of the
    environment.
    """
    data, serialization = _key_file(path, "private key", "PUBLIC KEY-----")
    is_ssh = b"BEGIN OPENSSH PRIVATE KEY" in data
    parse = serialization.load_ssh_private_key if is_ssh else serialization.load_pem_private_key
    try:
        with _key_errors(path, "cannot read this private key"):
            key = parse(data, None)
    except TypeError:  # it is encrypted
        if not (passphrase := os.environ.get(PASSPHRASE)):
            raise InputError("an encrypted key", where=path, fix=f"set {PASSPHRASE}, or decrypt it") from None
        with _key_errors(path, f"{PASSPHRASE} does not open this private key"):
            key = parse(data, passphrase.encode())
    if path.stat().st_mode & 0o077:
        log.warning("%s: other accounts of this machine may read this private key: chmod 600 it", path)
    return _of_kind("Ed25519PrivateKey", key, path)


def read_public_key(path: Path) -> bytes:
    """Read an ed25519 public key, PEM of openssl or the line of ssh-keygen; gives its 32 bytes. InputError if it is
    none."""
    data, serialization = _key_file(path, "public key", "PRIVATE KEY-----")
    is_ssh = data.startswith(b"ssh-")
    parse = serialization.load_ssh_public_key if is_ssh else serialization.load_pem_public_key
    with _key_errors(path, "cannot read this public key"):
        key = parse(data)
    return _of_kind("Ed25519PublicKey", key, path).public_bytes_raw()


def _key_file(path: Path, what: str, mark_of_other: str) -> tuple[bytes, Any]:
    """Give the bytes of a key file that is not the other one of the pair, and the library's module that loads it."""
    try:
        from cryptography.hazmat.primitives import serialization
    except ImportError:
        raise EnvironmentMissing("cryptography is not installed", fix=INSTALL) from None
    data = read_bytes(path, what=what, fix=MAKE_KEY)
    if mark_of_other.encode() in data or (what == "private key" and data.startswith(b"ssh-")):
        raise InputError("this is the other key of the pair", where=path, expected=f"a {what}", fix=MAKE_KEY)
    return data, serialization


@contextlib.contextmanager
def _key_errors(path: Path, what: str) -> Iterator[None]:
    """Turn what the library raises into one line without its words, which may quote the file."""
    from cryptography.exceptions import UnsupportedAlgorithm

    try:
        yield
    except (ValueError, UnsupportedAlgorithm) as error:
        if "bcrypt" in str(error):  # what encrypted keys of ssh-keygen need
            raise EnvironmentMissing("bcrypt is not installed", fix=INSTALL) from None
        raise InputError(what, where=path, expected="an ed25519 key", fix=MAKE_KEY) from None


def _of_kind(name: str, key: Any, path: Path) -> Any:
    from cryptography.hazmat.primitives.asymmetric import ed25519

    if not isinstance(key, getattr(ed25519, name)):
        got = type(key).__name__.partition("P")[0]
        raise InputError("a key of another kind", where=path, got=got, expected="ed25519", fix=MAKE_KEY)
    return key


def sign(folder: Path, key: Any) -> Path:
    """Sign the list of checksums of a release folder, after every file was compared with it; gives the file of the
    signature.
    """
    digests = read_checksums(folder)
    wrong = [name for name, digest in digests.items() if sha256_file(folder / name, tree=folder) != digest]
    if wrong or RECORD not in digests:
        got = ", ".join(wrong)[:300] or f"{CHECKSUMS} without {RECORD}"
        raise VerifyError(
            "files that the list of checksums does not have", where=folder, got=got, fix="nothing was signed"
        )
    parts = (key.public_key().public_bytes_raw(), key.sign(read_bytes(folder / CHECKSUMS, tree=folder)))
    public, made = (base64.b64encode(part).decode() for part in parts)
    value = Signature(algorithm="ed25519", signed_file="checksums.sha256", public_key=public, signature=made)
    write_model(folder / SIGNATURE, value, FORMAT)
    return folder / SIGNATURE


def remove_unfinished(folder: Path) -> None:
    """Remove what a kill in the middle of signing left beside the signature: verification finds it foreign."""
    with storage_errors(folder):
        remove_left(folder / SIGNATURE)


def is_signed(folder: Path) -> bool:
    return os.path.lexists(folder / SIGNATURE)


def signature_fault(folder: Path, public_key: bytes) -> tuple[str, str] | None:
    """Check the signature of a release folder; gives what was found and what was expected, or None where it holds."""
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    wanted = base64.b64encode(public_key).decode()
    if not is_signed(folder):
        return "no signature", f"one of the key that was given, {wanted}"
    try:
        found = read_model(folder / SIGNATURE, Signature, FORMAT, tree=folder)
        if found.public_key != wanted:
            return f"signed with another key, {found.public_key}", f"the key that was given, {wanted}"
        data, signature = read_bytes(folder / CHECKSUMS, tree=folder), base64.b64decode(found.signature)
        Ed25519PublicKey.from_public_bytes(public_key).verify(signature, data)
    except InvalidSignature:
        return f"a signature that does not hold: {CHECKSUMS} was changed after it", f"one of {wanted} over {CHECKSUMS}"
    except InputError as error:
        return error.got if isinstance(error.got, str) else error.what, "a signature that can be read"
    return None
