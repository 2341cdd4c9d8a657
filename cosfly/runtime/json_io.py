"""JSON on disk: into plain values, and into models. Whatever stands there, a reader gets what it asked for or an
InputError.

Refused beyond what JSON forbids: numbers that are not finite (NaN, 1e999) or whole with more than DIGITS digits,
nesting deeper than DEPTH, half a surrogate pair, which no file could hold again, more brackets than such a text has,
and in files of ours a key that is given twice.
"""

from __future__ import annotations

import builtins
import functools
import json
import math
import re
import reprlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from pydantic_core import SchemaValidator

from cosfly.runtime.errors import InputError, plain
from cosfly.runtime.io import CHECK_PATH, FILE_MB, decoded, not_utf8, read_bytes, read_lines, write_bytes

Model = TypeVar("Model", bound=BaseModel)
Kind = TypeVar("Kind")

DEPTH = 64  # the deepest honest file, a CityJSON CompositeSolid, has 10
DIGITS = 40  # ids have up to 20; a float holds no number of 309
MOST_SHOWN = 40  # characters of a number in a message
# An empty list or object takes 80 bytes of memory: 0.8 GB, or ten times the file.
MOST_GROUPS, LEAST_GROUP_BYTES = 10_000_000, 8

# A number that may overflow has an exponent of three digits, or very many digits: looked for with these, which takes a
# fortieth of the time of a parse. A text that looks so is harmless and only parsed more slowly.
_ZEROS = bytes.maketrans(b"123456789E", b"000000000e")
_LONG_EXPONENT, _LONG_NUMBER = b"e000", b"0" * (DIGITS + 1)
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")


def _no_constants(text: str) -> float:
    raise ValueError(f"{_short(text)} is not a finite number")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{_short(text)} is not a finite number")
    return number


def _whole(text: str) -> int:
    if len(text.lstrip("-")) > DIGITS:
        raise ValueError(f"{_short(text)} has more than {DIGITS} digits")
    return int(text)


def _short(word: str) -> str:
    return word if len(word) <= MOST_SHOWN else f"{word[:MOST_SHOWN]}... of {len(word)} characters"


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members: dict[str, Any] = {}
    for name, value in pairs:
        if name in members:
            raise ValueError(f"{name[:MOST_SHOWN]!r} is given twice")
        members[name] = value
    return members


def parse_json(text: str | bytes, *, each_key_once: bool = False) -> Any:
    """Read JSON text in UTF-8.

    Raises:
        ValueError: it is no JSON, or holds what no file of a data set may hold.
    """
    data = text.encode() if isinstance(text, str) else text.removeprefix(b"\xef\xbb\xbf")
    num_groups = data.count(b"[") + data.count(b"{")
    if num_groups > max(MOST_GROUPS, len(data) / LEAST_GROUP_BYTES):
        raise ValueError(f"{num_groups:,} lists and objects in {len(data):,} characters")
    hooks: dict[str, Any] = {"object_pairs_hook": _each_once} if each_key_once else {}
    flat = data.translate(_ZEROS, b"+")
    if _LONG_EXPONENT in flat or _LONG_NUMBER in flat:
        hooks |= {"parse_float": _finite, "parse_int": _whole}
    del flat  # as large as the file
    try:
        value = json.loads(data.decode() if isinstance(text, bytes) else text, parse_constant=_no_constants, **hooks)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if num_groups > DEPTH and is_deep(value):
        raise ValueError(f"nested deeper than {DEPTH}")
    return value


def is_deep(value: Any) -> bool:
    """Return whether lists and objects are nested deeper than DEPTH."""
    level = [value]
    for _ in range(DEPTH + 1):
        level = [
            member
            for group in level
            for member in (group.values() if type(group) is dict else group)
            if type(member) is dict or type(member) is list
        ]
        if not level:
            return False
    return True


def parse_document(data: bytes | str, where: str | Path, *, what: str = "file", each_key_once: bool = False) -> Any:
    """Read the JSON text of a file."""
    raw = data.encode() if isinstance(data, str) else data
    try:
        value = parse_json(raw, each_key_once=each_key_once)
        if _SURROGATE.search(raw):
            json.dumps(value, ensure_ascii=False).encode()  # fails on half of a pair
    except UnicodeDecodeError as error:
        raise not_utf8(error, where) from None
    except UnicodeEncodeError:
        raise InputError(
            f"the {what} holds half of a surrogate pair", where=where, expected="whole characters"
        ) from None
    except ValueError as error:
        raise InputError("not valid JSON", where=where, got=str(error)) from None
    return value


def read_json(
    path: Path,
    *,
    what: str = "file",
    fix: str = CHECK_PATH,
    tree: Path | None = None,
    each_key_once: bool = False,
    most_mb: float = FILE_MB,
) -> Any:
    """Read a JSON file; raises InputError as `read_bytes`, and where it is not JSON."""
    data = read_bytes(path, what=what, fix=fix, tree=tree, most_mb=most_mb)
    return parse_document(data, path, what=what, each_key_once=each_key_once)


def read_object(path: Path, *, what: str = "file", tree: Path | None = None) -> dict[str, Any]:
    """Read a JSON file that holds an object; raises as `read_json`, and for anything else."""
    value = read_json(path, what=what, tree=tree)
    if not isinstance(value, dict):
        raise InputError(f"not the {what}", where=path, got=type(value).__name__, expected="an object")
    return value


# --- models -----------------------------------------------------------------------------------------------------------


class Record(BaseModel):
    """Base of what a file holds: frozen, and an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def validated(kind: type[Kind], value: Any, where: str | Path) -> Kind:
    """Return what a JSON value says as a model or a dataclass. It ends at the first wrong member of a list or object:
    each error takes kilobytes.

    Raises:
        InputError: names the file and the first wrong field.
    """
    try:
        return _validator(kind).validate_python(value)  # type: ignore[arg-type]
    except ValidationError as error:
        detail = error.errors(include_url=False, include_context=False)[0]
        places = (f"[{key}]" if isinstance(key, int) else f".{key}" for key in detail["loc"])
        field = "".join(places).removeprefix(".") or "top level"
        what = "not an object" if detail["type"] in ("model_type", "dataclass_type") else plain(detail["msg"])
        raise InputError(what, where=f"{where}: {field}", got=_shown(detail["input"])) from None


@functools.cache
def _validator(kind: type) -> SchemaValidator:
    # The models inside would bring validators of their own, which collect all errors.
    return SchemaValidator(_ending_early(TypeAdapter(kind).core_schema), _use_prebuilt=False)  # type: ignore[call-arg]


def _ending_early(schema: Any) -> Any:
    """Return a schema of pydantic's with `fail_fast` in all that has members."""
    if isinstance(schema, list):
        return [_ending_early(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    copied = {key: one if key in ("default", "metadata") else _ending_early(one) for key, one in schema.items()}
    return (
        copied | {"fail_fast": True} if copied.get("type") in ("list", "tuple", "set", "frozenset", "dict") else copied
    )


def _shown(value: Any) -> str:
    """Return a value in a message; of one with members the first few."""
    return (reprlib if isinstance(value, dict | list) else builtins).repr(value)[:80]


def model_lines(path: Path, model: type[Model], *, what: str, fix: str) -> Iterator[tuple[str, Model]]:
    """Yield each line of a JSON-lines file as it stands there, its end included, and the model it holds.

    Args:
        what, fix: for the message when there is no such file, or one of another `schema_version` than the model's.
    """
    version = field.default if (field := model.model_fields.get("schema_version")) else None
    for number, data in enumerate(read_lines(path, what=what, fix=fix), 1):
        line = decoded(data, f"{path}:{number}")
        value = parse_document(data, f"{path}:{number}", what="line")
        if isinstance(value, dict) and value.get("schema_version", version) != version:
            raise InputError(
                f"{what} of another version",
                where=f"{path}:{number}: schema_version",
                got=repr(value["schema_version"])[:80],
                expected=repr(version),
                fix=f"make it anew: {fix}",
            )
        yield line, validated(model, value, f"{path}:{number}")


MISSING = "the field is missing or null"


class FileFormat(NamedTuple):
    """What a kind of JSON file says of itself, and how messages call it."""

    schema: str
    version: str
    what: str = "file"

    @property
    def header(self) -> dict[str, str]:
        """What such a file begins with."""
        return {"schema": self.schema, "schema_version": self.version}


def check_schema(value: Any, form: FileFormat, path: Path | str) -> dict:
    """Return a JSON value that is an object of the wanted schema and major version."""
    schema, version, _ = form
    if not isinstance(value, dict):
        raise InputError(
            "not a cosfly file", where=path, got=type(value).__name__, expected=f"an object, schema {schema}"
        )
    kind, found = value.get("schema"), value.get("schema_version")
    if kind is None or (kind == schema and found is None):
        raise InputError(
            MISSING, where=f"{path}: {'schema' if kind is None else 'schema_version'}",
            expected=repr(schema if kind is None else version), fix="check that this is the file that was meant",
        )  # fmt: skip
    if kind != schema:
        raise InputError(
            "not the expected kind of file", where=f"{path}: schema", got=repr(kind)[:80], expected=repr(schema)
        )
    if str(found).split(".")[0] != version.split(".")[0]:
        got = repr(found)[:80]
        raise InputError("unknown version", where=f"{path}: schema_version", got=got, expected=repr(version))
    return value


def model_of(value: Any, model: type[Model], form: FileFormat, where: Path | str) -> Model:
    """Return what a JSON value of the wanted schema and major version says as a model."""
    value = check_schema(value, form, where)
    return validated(model, {key: v for key, v in value.items() if key not in form.header}, where)


def read_model(path: Path, model: type[Model], form: FileFormat, *, tree: Path | None = None) -> Model:
    """Read a JSON file of the wanted schema and major version; raises as `read_json` and `model_of`."""
    return model_of(read_json(path, what=form.what, tree=tree, each_key_once=True), model, form, path)


# --- writing ----------------------------------------------------------------------------------------------------------


_COMPACT = json.JSONEncoder(ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def dump_json(value: Any, *, indent: int | None = None) -> str:
    """Return JSON text; NaN and infinity are an error, never a value."""
    encoder = _COMPACT if indent is None else json.JSONEncoder(ensure_ascii=False, allow_nan=False, indent=indent)
    return encoder.encode(value)


def write_json(path: Path, value: Any, *, indent: int | None = 1) -> None:
    """Write JSON as `write_bytes` writes; indent None: on one line."""
    write_bytes(path, (dump_json(value, indent=indent) + "\n").encode())


def write_model(path: Path, content: BaseModel, form: FileFormat) -> None:
    """Write what `read_model` reads."""
    write_json(path, {**form.header, **content.model_dump(mode="json")})
