"""JSON files: read into plain values and into pydantic models, and written.

Reading refuses more than JSON forbids: numbers that are not finite (NaN, 1e999), integers of more than DIGITS digits,
nesting deeper than DEPTH, half a surrogate pair, which cannot be written again, and too many lists and objects.
"""

import functools
import json
import math
import re
import reprlib
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from pydantic_core import SchemaValidator, from_json

from cosfly.runtime.errors import InputError, json_type, plain, shown
from cosfly.runtime.io import FILE_MB, decoded, read_bytes, read_lines, write_bytes

Model = TypeVar("Model", bound=BaseModel)
Kind = TypeVar("Kind")

DEPTH = 64  # a CityJSON CompositeSolid, the deepest usual file, has 10
DIGITS = 40  # ids have up to 20; a float cannot store a number of 309
# An empty list or object takes 80 bytes of memory, so these are limits of 0.8 GB, or of ten times the file.
MOST_GROUPS = 10_000_000
LEAST_GROUP_BYTES = 8  # of text for each list or object
MISSING = "the field is missing or null"

# A possible number that overflows or has too many digits. Harmless text that looks like one is parsed twice.
_SUSPECT = re.compile(rb"[0-9]{%d}|[0-9][eE]\+?[0-9]{3}" % (DIGITS + 1))
_COMPACT = json.JSONEncoder(ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"the number {reprlib.repr(text)[1:-1]} is not finite")
    return number


def _integer(text: str) -> int:
    if len(text.lstrip("-")) > DIGITS:
        raise ValueError(f"the number {reprlib.repr(text)[1:-1]} has more than {DIGITS} digits")
    return int(text)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the key {next(name for name in names if names.count(name) > 1)!r} is given twice")
    return members


def parse_json(text: str | bytes, *, unique_keys: bool = False) -> Any:
    """Return the value of JSON text in UTF-8; ValueError if it is invalid or this module refuses it.

    unique_keys: Refuse an object with the same key twice, because other readers may take either value.
    """
    data = text.encode() if isinstance(text, str) else text.removeprefix(b"\xef\xbb\xbf")
    num_groups = data.count(b"[") + data.count(b"{")
    if num_groups > max(MOST_GROUPS, len(data) / LEAST_GROUP_BYTES):
        raise ValueError(f"the text has too many lists and objects: {num_groups:,} in {len(data):,} bytes")
    value = from_json(data, allow_inf_nan=False)
    if num_groups > DEPTH and is_deep(value):
        raise ValueError(f"lists and objects are nested deeper than {DEPTH} levels")
    if unique_keys or _SUSPECT.search(data):  # parsed again for the errors alone
        json.loads(data, parse_float=_finite, parse_int=_integer, object_pairs_hook=_unique if unique_keys else None)
    return value


def is_deep(value: Any) -> bool:
    """Return whether lists and objects are nested deeper than DEPTH."""
    groups = [value]  # of one level
    for _ in range(DEPTH + 1):
        members = chain.from_iterable(group.values() if type(group) is dict else group for group in groups)
        groups = [member for member in members if type(member) is dict or type(member) is list]
        if not groups:
            return False
    return True


def parse_document(data: bytes | str, where: str | Path, *, unique_keys: bool = False) -> Any:
    """Return the value of a file's JSON text; InputError where `parse_json` refuses it."""
    try:
        return parse_json(data, unique_keys=unique_keys)
    except ValueError as error:
        raise InputError(f"the text is not valid JSON: {error}", where=where) from None


def read_json(path: Path, *, what: str = "file", tree: Path | None = None, most_mb: float = FILE_MB) -> Any:
    """Read a JSON file; arguments as for `io.read_bytes`."""
    return parse_document(read_bytes(path, what=what, tree=tree, most_mb=most_mb), path)


def read_object(path: Path, *, what: str = "file", tree: Path | None = None) -> dict[str, Any]:
    """Read a JSON file that holds an object."""
    value = read_json(path, what=what, tree=tree)
    if not isinstance(value, dict):
        raise InputError(f"the {what} is not a JSON object", where=path, got=json_type(value), expected="an object")
    return value


# --- writing ----------------------------------------------------------------------------------------------------------


def dump_json(value: Any, *, indent: int | None = None) -> str:
    """Return JSON text; NaN and infinity are a ValueError."""
    encoder = _COMPACT if indent is None else json.JSONEncoder(ensure_ascii=False, allow_nan=False, indent=indent)
    return encoder.encode(value)


def write_json(path: Path, value: Any, *, indent: int | None = 1) -> None:
    """Write JSON under a temporary name, then rename it; indent None: on one line."""
    write_bytes(path, (dump_json(value, indent=indent) + "\n").encode())


# --- models -----------------------------------------------------------------------------------------------------------


class Record(BaseModel):
    """Base of the records in files: frozen, and an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def validated(kind: type[Kind], value: Any, where: str | Path) -> Kind:
    """Return a JSON value as a model or a dataclass; InputError names the file and the first wrong field.

    Validation ends at the first wrong member of a list or object, because each error takes kilobytes.
    """
    try:
        return _validator(kind).validate_python(value)  # type: ignore[arg-type]
    except ValidationError as error:
        detail = error.errors(include_url=False, include_context=False)[0]
        parts = (f"[{key}]" if isinstance(key, int) else f".{key}" for key in detail["loc"])
        field = "".join(parts).removeprefix(".") or "top level"
        if detail["type"] == "missing":
            raise InputError(MISSING, where=f"{where}: {field}") from None
        is_object_error = detail["type"] in ("model_type", "dataclass_type")
        what = "the value is not an object" if is_object_error else plain(detail["msg"])
        raise InputError(what, where=f"{where}: {field}", got=shown(detail["input"])) from None


@functools.cache
def _validator(kind: type) -> SchemaValidator:
    # Prebuilt validators of inner models would collect all errors. The argument is private in pydantic-core.
    return SchemaValidator(_with_fail_fast(TypeAdapter(kind).core_schema), _use_prebuilt=False)  # type: ignore[call-arg]


def _with_fail_fast(schema: Any) -> Any:
    """Return a schema of pydantic with `fail_fast` in all collections."""
    if isinstance(schema, list):
        return [_with_fail_fast(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    copied = {key: part if key in ("default", "metadata") else _with_fail_fast(part) for key, part in schema.items()}
    is_collection = copied.get("type") in ("list", "tuple", "set", "frozenset", "dict")
    return copied | {"fail_fast": True} if is_collection else copied


def model_lines(path: Path, model: type[Model], *, what: str, fix: str) -> Iterator[tuple[str, Model]]:
    """Yield each line of a JSON-lines file, its end included, and the model it holds.

    what, fix: Words for the message where the file is missing or its `schema_version` is not the model's.
    """
    field = model.model_fields.get("schema_version")
    version = field.default if field else None
    for number, data in enumerate(read_lines(path, what=what, fix=fix), 1):
        where = f"{path}:{number}"
        value = parse_document(data, where)
        if isinstance(value, dict) and value.get("schema_version", version) != version:
            raise InputError(
                f"the version of this line of the {what} is not supported",
                where=f"{where}: schema_version",
                got=shown(value["schema_version"]),
                expected=repr(version),
                fix=f"make the file again: {fix}",
            )
        yield decoded(data, where), validated(model, value, where)


class FileFormat(NamedTuple):
    """The schema name and version of a kind of JSON file, and the words for it in messages."""

    schema: str
    version: str
    what: str = "file"

    @property
    def header(self) -> dict[str, str]:
        """Return the first keys of such a file."""
        return {"schema": self.schema, "schema_version": self.version}


def check_schema(value: Any, form: FileFormat, path: Path | str) -> dict:
    """Return a JSON value that is an object of the schema and major version of a format."""
    if not isinstance(value, dict):
        expected = f"an object with schema {form.schema}"
        raise InputError("the file is not a JSON object", where=path, got=json_type(value), expected=expected)
    for key, expected in form.header.items():
        if value.get(key) is None:
            fix = f"pass a file that cosfly wrote with this schema ({form.what})"
            raise InputError(MISSING, where=f"{path}: {key}", expected=repr(expected), fix=fix)
        if key == "schema" and value[key] != expected:
            what = "the file has a wrong schema"
        elif key == "schema_version" and str(value[key]).split(".")[0] != expected.split(".")[0]:
            what = "the version of the file is not supported"
        else:
            continue
        raise InputError(what, where=f"{path}: {key}", got=shown(value[key]), expected=repr(expected))
    return value


def read_model(path: Path, model: type[Model], form: FileFormat, *, tree: Path | None = None) -> Model:
    """Read a JSON file of the schema and major version of a format."""
    data = read_bytes(path, what=form.what, tree=tree)
    value = check_schema(parse_document(data, path, unique_keys=True), form, path)
    return validated(model, {key: v for key, v in value.items() if key not in form.header}, path)


def write_model(path: Path, content: BaseModel, form: FileFormat) -> None:
    """Write a JSON file that `read_model` reads."""
    write_json(path, {**form.header, **content.model_dump(mode="json")})
