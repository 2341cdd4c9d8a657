"""What stands on disk against the records of the stages that made it.

`manifest.json` holds the sha256 of what a stage made, `stage.json` that of what it was made of, and a flight's
`checksums.sha256` that of each of its files. Every stage compares its inputs with the first two when it begins, for it
reads them anyway. The digests find what was changed, exchanged or mixed up; they are no
signatures against somebody who changes the records too.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from cosfly.runtime.documents import FileFormat, read_json, read_model, read_object
from cosfly.runtime.errors import InputError, VerifyError
from cosfly.runtime.files import files_named, sha256_file
from cosfly.runtime.store import CHECKSUMS, checksum_lines, dump_json, inside, read_checksums, sha256_bytes

log = logging.getLogger(__name__)

STAGE_FORMAT = FileFormat("cosfly.stage", "1.0", "stage record")
MANIFEST_FORMAT = FileFormat("cosfly.manifest", "1.0", "manifest")
RECORDS = (("manifest.json", MANIFEST_FORMAT.schema), ("stage.json", STAGE_FORMAT.schema))
FLIGHT = "trajectory.json"
ROLES = {"maps": "boxes", "map": "simplified"}  # a product that stages call by two names
NUM_NAMED = 5  # files that an error names


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True)


class StageInput(_Record):
    """A file or folder that a stage reads."""

    path: str
    sha256: str


class StageRecord(_Record):
    """`stage.json`: what the folder was begun with.

    package_files: sha256 of what cosfly itself brings and a later version may bring otherwise, as prompts.
    """

    stage: str
    config: dict[str, Any]
    seed: int
    inputs: dict[str, StageInput]
    code_version: str
    package_files: dict[str, str] = Field({}, exclude_if=lambda digests: not digests)


class Output(_Record):
    """A file of a finished stage, its path relative to the stage folder."""

    path: str
    bytes: int
    sha256: str


class _Made(_Record):
    """Of `manifest.json` what is compared with the disk."""

    outputs: list[Output]


def read_stage_record(folder: Path) -> StageRecord:
    """Read `stage.json`.

    Raises:
        InputError: it is missing or malformed.
    """
    return read_model(folder / "stage.json", StageRecord, STAGE_FORMAT, tree=folder)


def fingerprint(path: Path) -> str:
    """Return one digest for an input: a file's bytes, a finished stage's products, or a playback tree's trajectory
    files."""
    if not path.exists():
        raise InputError(
            "there is no such file or folder", where=path, fix="check the path, or run the stage that makes it"
        )
    if not path.is_dir():
        return sha256_file(path)  # which says so where it is a pipe or a device
    if _has_record(path, "manifest.json", MANIFEST_FORMAT.schema):
        outputs = read_object(path / "manifest.json", what="manifest").get("outputs", [])
        return sha256_bytes(dump_json(outputs).encode())
    digest = hashlib.sha256()
    for file in files_named(path, FLIGHT):
        digest.update(f"{file.relative_to(path)} {sha256_file(file)}\n".encode())
    return digest.hexdigest()


def folder_digests(folder: Path) -> dict[str, str]:
    """Return the sha256 of each file of a flight by its name: as `checksums.sha256` has it, else its own."""
    listed = read_checksums(folder) if (folder / CHECKSUMS).is_file() else {}
    known, root = listed.keys() | {CHECKSUMS}, f"{folder}{os.sep}"
    found = (  # of thousands of files: as text, paths take three times as long
        f"{above}{os.sep}{name}".removeprefix(root).replace(os.sep, "/")
        for above, _, names in os.walk(folder)
        for name in names
    )
    return listed | {
        name: sha256_file(folder / name) for name in found if name not in known and (folder / name).is_file()
    }


def recorded_digests(folder: Path) -> dict[str, str]:
    """Return the sha256 of a finished stage's products by their paths; empty where there is no manifest of ours."""
    if not _has_record(folder, "manifest.json", MANIFEST_FORMAT.schema):
        return {}
    made = read_model(folder / "manifest.json", _Made, MANIFEST_FORMAT, tree=folder)
    return {output.path: output.sha256 for output in made.outputs}


def digest_of(digests: Mapping[str, str]) -> str:
    """Return one digest for the files of a folder."""
    return sha256_bytes(checksum_lines(digests).encode())


# --- the inputs of a stage --------------------------------------------------------------------------------------------


def checked_inputs(inputs: Mapping[str, Path], audited: Collection[str] = ()) -> dict[str, StageInput]:
    """Fingerprint what a stage reads, and see that it is what was finished and belongs together.

    Args:
        inputs: name -> file or folder; of several runs with a number in front, as `2.data`.
        audited: names of inputs whose files the stage itself compares with their records, one by one.
    Raises:
        InputError: an input is missing, or its name is not UTF-8 text.
        VerifyError: one was changed since its stage finished it, its stage is not finished, or it was made of another
            one than that which is given with it.
    """
    for name, path in inputs.items():
        _check_name(path)
        if name not in audited:
            _check_finished(path)
    found = {name: StageInput(path=str(path), sha256=fingerprint(path)) for name, path in sorted(inputs.items())}
    for name, path in inputs.items():
        _check_belongs(name, path, inputs, found)
    return found


def _check_name(path: Path) -> None:
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise InputError("a name that is not UTF-8 text cannot be put on record", where=path, fix="rename it") from None


def _stage_folder(path: Path) -> Path | None:
    """Find the folder of the stage that made an input: itself, the one it stands in, or that one's; None: not ours."""
    places = [path] if path.is_dir() else [path.absolute().parent, path.absolute().parent.parent]
    return next((place for place in places if any(_has_record(place, *record) for record in RECORDS)), None)


def _has_record(folder: Path, name: str, schema: str) -> bool:
    """Return whether a folder has a record of ours; others write files of these names too."""
    value = read_json(folder / name) if (folder / name).is_file() else None
    return isinstance(value, dict) and value.get("schema") == schema


def _record_of(path: Path) -> StageRecord | None:
    """Read what an input was made of; None where nobody says."""
    folder = _stage_folder(path)
    return read_stage_record(folder) if folder is not None and _has_record(folder, *RECORDS[1]) else None


def _check_finished(path: Path) -> None:
    """Compare an input with the manifest of its stage: a file with its line, a folder with all of them."""
    folder = _stage_folder(path)
    if folder is None or not path.exists():
        return
    for name, schema in RECORDS:
        if not _has_record(folder, name, schema):
            what, got = "the stage that makes this is not finished, or its records are gone", f"no {name} in {folder}"
            fix = "run that stage again; to use what is there as it is, copy it to a folder of its own"
            raise VerifyError(what, where=path, got=got, expected=f"{name} of that stage", fix=fix)
    digests = recorded_digests(folder)
    if path.is_file():
        name = path.absolute().relative_to(folder.absolute()).as_posix()
        digests = {name: digests[name]} if name in digests else {}
    if wrong := list(_changed(folder, digests)):
        more = f" and {len(wrong) - NUM_NAMED} more" if len(wrong) > NUM_NAMED else ""
        what = "what stands here is not what its stage finished"
        expected = "the files that its records hold the digests of"
        fix = "put the files back or make them again; to use a file that you changed, copy it to a folder of its own"
        raise VerifyError(what, where=folder, got="; ".join(wrong[:NUM_NAMED]) + more, expected=expected, fix=fix)


def _changed(folder: Path, digests: Mapping[str, str]) -> Iterator[str]:
    for name, digest in digests.items():
        path = inside(folder, name)
        if not path.is_file():
            yield f"{path} is missing"
        elif sha256_file(path) != digest:
            yield f"{path} has other bytes"


def _check_belongs(name: str, path: Path, inputs: Mapping[str, Path], found: Mapping[str, StageInput]) -> None:
    """See that what an input was made of, where it is given too, is what is given: of several, one of them."""
    begun = _record_of(path)
    if begun is None:
        return
    front = name.rpartition(".")[0]
    peers = {_role(other): other for other in inputs if other.rpartition(".")[0] == front}
    made_of: dict[str, list[tuple[str, StageInput]]] = {}  # role -> the inputs of that role
    for other, record in begun.inputs.items():
        made_of.setdefault(_role(other), []).append((other, record))
    for role, records in made_of.items():
        peer = peers.get(role, name)
        if peer == name:
            continue
        if not any(record.sha256 == found[peer].sha256 for _, record in records):
            wanted, record = records[0]
            what, got = f"it was made of another input {wanted!r} than the one given with it", f"given: {inputs[peer]}"
            fix = f"give the two that belong together, or make {path.name} again"
            raise VerifyError(what, where=path, got=got, expected=f"{record.path}, as it was then", fix=fix)


def _role(name: str) -> str:
    role = name.rpartition(".")[2]
    return ROLES.get(role, role)


def is_bound(product: Path) -> bool:
    """Return whether a record binds a product to what it was made of."""
    return _record_of(product) is not None


def was_made_of(product: Path, name: str) -> str | None:
    """Return the fingerprint that an input of a product's stage had; None where there is no record of it."""
    begun = _record_of(product)
    found = begun.inputs.get(name) if begun is not None else None
    return None if found is None else found.sha256


def stages_behind(products: Iterable[Path]) -> list[StageRecord]:
    """Return the records of the stages that made some products, before each those that made its inputs, as far as these
    still stand as they were.
    """
    found: set[str] = set()
    ordered: list[StageRecord] = []

    def visit(path: Path) -> None:
        record = _record_of(path)
        if record is None:
            return
        made_of = sorted((name, entry.sha256) for name, entry in record.inputs.items())
        known = dump_json([record.stage, record.seed, record.config, made_of])  # where it stands does not matter
        if known in found:
            return
        found.add(known)
        for entry in record.inputs.values():
            before = Path(entry.path)
            if before.exists() and _record_of(before) is not None and fingerprint(before) == entry.sha256:
                visit(before)
        ordered.append(record)

    for path in products:
        visit(path)
    return ordered
