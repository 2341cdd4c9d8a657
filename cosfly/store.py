"""Files that are never half written: atomic writes, checksummed journals, folders that appear whole."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, TypeVar

from pydantic import BaseModel, ValidationError

from cosfly.errors import InputError, StorageError

Model = TypeVar("Model", bound=BaseModel)

DISK_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
NOT_WRITABLE = frozenset({errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EIO})
NO_SUCH_PLACE = frozenset({errno.ENOENT, errno.EEXIST, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP})


# --- bytes and JSON ---------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turn a full, read-only or otherwise unusable disk into a StorageError that names the file."""
    try:
        yield
    except OSError as error:
        if error.errno in DISK_FULL:
            fix = "free some space or choose another --out, then run the same command again: finished work is kept"
        elif error.errno in NOT_WRITABLE or (error.errno in NO_SUCH_PLACE and _concerns(error, path)):
            fix = "choose another --out, or mend the folder and run the same command again: finished work is kept"
        else:
            raise
        raise StorageError("cannot write", where=path, got=error.strerror, fix=fix) from error


def _concerns(error: OSError, path: Path) -> bool:
    """Tell whether an error is about the file that is being written or a folder above it, not about something read."""
    return error.filename is not None and path.absolute().is_relative_to(Path(os.fsdecode(error.filename)).absolute())


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[IO[bytes]]:
    """Fill a file under a temporary name; rename it when the block ends, so that a kill leaves either the old file or the new."""
    partial = _partial(path)
    refuse_link(path)
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.unlink(missing_ok=True)  # a kill left it, or somebody put a link there
        try:
            with open(partial, "xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
        except BaseException:
            partial.unlink(missing_ok=True)  # on a full disk it would hold the space that is needed
            raise


def _partial(path: Path) -> Path:
    """Give the temporary name of a file or folder; `remove_partials` knows it."""
    return path.with_name(f".{path.name}.{os.getpid()}.partial")


def write_bytes(path: Path, data: bytes) -> None:
    with atomic_file(path) as file:
        file.write(data)


_COMPACT = json.JSONEncoder(ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def dump_json(value: Any, *, indent: int | None = None) -> str:
    """Give JSON text; NaN and infinity are an error, never a value."""
    encoder = _COMPACT if indent is None else json.JSONEncoder(ensure_ascii=False, allow_nan=False, indent=indent)
    return encoder.encode(value)


def write_json(path: Path, value: Any, *, indent: int | None = 1) -> None:
    write_bytes(path, (dump_json(value, indent=indent) + "\n").encode())


class _NotFinite(ValueError):
    """NaN or Infinity stands in JSON text."""

    def __init__(self, word: str) -> None:
        super().__init__(f"{word} is not a number that a file may hold")
        self.word = word


def _no_constants(text: str) -> float:
    raise _NotFinite(text)


def _place_of_constant(value: Any) -> str | None:
    """Name the first field that holds NaN or infinity, as in `.boxes[3].center[0]`; None where there is none."""
    if isinstance(value, float):
        return None if math.isfinite(value) else ""
    if not isinstance(value, dict | list):
        return None
    for key, member in value.items() if isinstance(value, dict) else enumerate(value):
        place = _place_of_constant(member)
        if place is not None:
            return (f".{key}" if isinstance(value, dict) else f"[{key}]") + place
    return None


def parse_json(text: str | bytes) -> Any:
    """Read JSON text; NaN and infinity are an error.

    Raises:
        ValueError: it is no JSON, or nested deeper than can be read.
    """
    try:
        return json.loads(text, parse_constant=_no_constants)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def read_json(path: Path, *, what: str = "file") -> Any:
    """Read a JSON file.

    Raises:
        InputError: it is missing, unreadable or not JSON.
    """
    try:
        return parse_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"cannot read the {what}", where=path, got=error.strerror, fix="check the path") from None
    except _NotFinite as error:
        with contextlib.suppress(ValueError, RecursionError):  # broken farther on: then the place stays unknown
            place = _place_of_constant(json.loads(path.read_bytes()))
            raise InputError(
                f"the {what} holds a number that is not finite", where=f"{path}: {(place or '').lstrip('.')}", got=error.word,
                expected="a finite number",
            ) from None  # fmt: skip
        raise InputError(f"the {what} is not valid JSON", where=path, got=str(error)) from None
    except ValueError as error:
        raise InputError(f"the {what} is not valid JSON", where=path, got=str(error)) from None


@contextlib.contextmanager
def validation_errors(where: str | Path) -> Iterator[None]:
    """Turn what pydantic says of data that was read into an InputError that names the file and the first wrong field."""
    try:
        yield
    except ValidationError as error:
        detail = error.errors()[0]
        places = (f"[{key}]" if isinstance(key, int) else f".{key}" for key in detail["loc"])
        field = "".join(places).removeprefix(".") or "top level"
        what = "not an object" if detail["type"] == "model_type" else detail["msg"].removeprefix("Value error, ")
        raise InputError(what, where=f"{where}: {field}", got=repr(detail["input"])[:80]) from None


def _text_lines(file: Iterable[str], path: Path) -> Iterator[str]:
    """Yield the lines of an open text file; bytes that are no UTF-8 are an InputError."""
    try:
        yield from file
    except UnicodeDecodeError as error:
        raise InputError("not UTF-8 text", where=path, got=str(error)) from None


def model_lines(path: Path, model: type[Model], *, what: str, fix: str) -> Iterator[tuple[str, Model]]:
    """Yield each line of a JSON-lines file as it stands there, its end included, and the model it holds.

    Args:
        what, fix: for the message when there is no such file, or one of another `schema_version` than the model's.
    Raises:
        InputError: names the file, the line and the field.
    """
    try:
        file = open(path, encoding="utf-8")  # noqa: SIM115 (closed below)
    except OSError as error:
        raise InputError(f"cannot read the {what}", where=path, got=error.strerror, fix=fix) from None
    version = field.default if (field := model.model_fields.get("schema_version")) else None
    with file:
        for number, line in enumerate(_text_lines(file, path), 1):
            try:
                value = parse_json(line)
            except ValueError as error:
                raise InputError("not valid JSON", where=f"{path}:{number}", got=str(error)) from None
            if isinstance(value, dict) and value.get("schema_version", version) != version:
                raise InputError(
                    f"{what} of another version",
                    where=f"{path}:{number}: schema_version",
                    got=repr(value["schema_version"]),
                    expected=repr(version),
                    fix=f"make it anew: {fix}",
                )
            with validation_errors(f"{path}:{number}"):
                content = model.model_validate(value)
            yield line, content


def check_schema(value: Any, schema: str, version: str, path: Path) -> dict:
    """Check that a JSON value is an object of the wanted schema and major version."""
    if not isinstance(value, dict):
        raise InputError(
            "not a cosfly file", where=path, got=type(value).__name__, expected=f"an object, schema {schema}"
        )
    kind, found = value.get("schema"), value.get("schema_version")
    if kind != schema:
        raise InputError(
            "not the expected kind of file", where=f"{path}: schema", got=repr(kind), expected=repr(schema)
        )
    if str(found).split(".")[0] != version.split(".")[0]:
        raise InputError("unknown version", where=f"{path}: schema_version", got=repr(found), expected=repr(version))
    return value


def read_model(path: Path, model: type[Model], *, schema: str, version: str, what: str = "file") -> Model:
    """Read a JSON file of the wanted schema and major version.

    Raises:
        InputError: names the file and the field.
    """
    value = check_schema(read_json(path, what=what), schema, version, path)
    with validation_errors(path):
        return model.model_validate({key: v for key, v in value.items() if key not in ("schema", "schema_version")})


def write_model(path: Path, content: BaseModel, *, schema: str, version: str) -> None:
    """Write what `read_model` reads."""
    write_json(path, {"schema": schema, "schema_version": version, **content.model_dump(mode="json")})


def sha256_bytes(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def sha256_file(path: Path) -> str:
    """Give the hex digest of a file.

    Raises:
        InputError: it cannot be read.
    """
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError("cannot read the file", where=path, got=error.strerror, fix="check the path") from None


# --- folders of many files ----------------------------------------------------------------------------------------------


def refuse_link(path: Path) -> None:
    """Refuse to write to a link, which may lead anywhere.

    Raises:
        StorageError: the path is a link; says where it leads.
    """
    if path.is_symlink():
        raise StorageError(
            "a link stands where files are written, and writing follows none",
            where=path,
            got=f"a link to {os.readlink(path)}",
            fix="remove it, or put what it leads to in its place; the folder that --out names may itself be a link",
        )


def refuse_links(folder: Path) -> None:
    """Refuse to write into a folder in which a link stands, at any depth; the folder itself may be one."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_symlink():
                refuse_link(Path(entry.path))
            elif entry.is_dir():
                refuse_links(Path(entry.path))


def remove_partials(folder: Path) -> None:
    """Remove what a kill left under temporary names."""
    for path in sorted(folder.rglob(".*.partial"), reverse=True):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def inside(root: Path, name: str) -> Path:
    """Join a name from a file to a root.

    Raises:
        InputError: the name leads out of the root.
    """
    path = (root / name).resolve()
    if not path.is_relative_to(root.resolve()):
        raise InputError("a name leads out of its folder", where=root, got=name, expected="a path inside the folder")
    return path


CHECKSUMS = "checksums.sha256"


def write_checksums(folder: Path, digests: dict[str, str]) -> None:
    """Write `checksums.sha256` (the format of sha256sum) for files named relative to the folder."""
    write_bytes(folder / CHECKSUMS, checksum_lines(digests).encode())


def checksum_lines(digests: Mapping[str, str]) -> str:
    """Give the lines of `checksums.sha256`."""
    return "".join(f"{digest}  {name}\n" for name, digest in sorted(digests.items()))


def read_checksums(folder: Path) -> dict[str, str]:
    """Read `checksums.sha256`: relative name -> hex digest."""
    path = folder / CHECKSUMS
    digests: dict[str, str] = {}
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise InputError("cannot read the checksums", where=path, got=error.strerror) from None
    for number, line in enumerate(lines, 1):
        digest, _, name = line.partition("  ")
        if len(digest) != 64 or not name:
            raise InputError("a broken checksum line", where=f"{path}:{number}", got=line[:80])
        digests[str(inside(folder, name).relative_to(folder.resolve()))] = digest
    return digests


@contextlib.contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Fill a folder under a temporary name; rename it when the block ends without an error."""
    partial = _partial(path)
    refuse_link(path)
    with storage_errors(path):
        partial.mkdir(parents=True)
        try:
            yield partial
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
        if path.exists():
            shutil.rmtree(path)
        os.replace(partial, path)
