"""The directory of one stage: its lock, its records, and the digests of its inputs.

`stage.json` is written first (settings, digests of inputs, seed, code version). `items.jsonl` grows with each finished
item. `failures.jsonl` and `manifest.json` are written last: a manifest means that the stage is complete. The digests
detect files that were changed, exchanged or mixed up; they are no signatures against someone who changes records too.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shutil
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, Self

from filelock import FileLock, Timeout
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, field_serializer

import cosfly
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError, NothingKept, ResumeError, StorageError, VerifyError, counts_text, shown
from cosfly.runtime.events import EVENTS
from cosfly.runtime.io import (
    CHECKSUMS,
    checksum_lines,
    files_named,
    inside,
    read_checksums,
    remove_partials,
    sha256_bytes,
    sha256_file,
    storage_errors,
    write_bytes,
)
from cosfly.runtime.journal import Journal
from cosfly.runtime.json_io import (
    FileFormat,
    Model,
    dump_json,
    model_lines,
    read_json,
    read_model,
    validated,
    write_model,
)

log = logging.getLogger(__name__)

LOCK = ".lock"
STAGE_FORMAT = FileFormat("cosfly.stage", "1.0", "stage record")
MANIFEST_FORMAT = FileFormat("cosfly.manifest", "1.0", "manifest")
RECORDS = {"manifest.json": MANIFEST_FORMAT.schema, "stage.json": STAGE_FORMAT.schema}
TRACK_FILE = "trajectory.json"
BEGUN = ("stage.json", "items.jsonl", "failures.jsonl", EVENTS)  # present before any item is finished
ROLES = {"maps": "boxes", "map": "simplified"}  # input names of some stages -> the name of that product in others
NUM_NAMED = 5  # most files that an error lists


# --- the lock ---------------------------------------------------------------------------------------------------------


class FolderLock(FileLock):
    """The system's lock on `.lock` in a folder, held until release, its last reference or the end of the process."""

    def __enter__(self) -> Self:  # `hold_folder` has acquired it
        return self

    def release(self, force: bool = True) -> None:
        """Release the folder and remove the file, so that a finished folder holds only products."""
        if self.is_locked:
            with contextlib.suppress(OSError):
                os.unlink(self.lock_file)  # while locked: a process that waits for this file then creates its own
            super().release(force)


def hold_folder(folder: Path) -> FolderLock:
    """Lock a folder, which is created if needed; raises ResumeError if another process holds it.

    A process that still refers to a lock may lock the folder again, as after an error in a notebook.
    """
    path = folder.resolve() / LOCK
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = FolderLock(path, timeout=0, thread_local=False, is_singleton=True)
        try:
            lock.acquire()
        except Timeout:
            fix = "wait for that process or stop it, then run the same command again; or choose another --out"
            raise ResumeError("another cosfly process uses this folder", where=path.parent, fix=fix) from None
        except NotImplementedError:
            fix = "choose an --out on another file system"
            raise StorageError("the file system does not support file locks", where=path.parent, fix=fix) from None
    return lock


# --- records ----------------------------------------------------------------------------------------------------------


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True)


class StageInput(_Record):
    """A file or folder that a stage reads."""

    path: str
    sha256: str


class StageRecord(_Record):
    """`stage.json`: the settings, inputs and version with which a folder was started."""

    stage: str
    config: dict[str, Any]
    seed: int
    inputs: dict[str, StageInput]
    code_version: str
    # sha256 of data that are part of cosfly and may change with its version, such as prompts.
    package_files: dict[str, str] = Field({}, exclude_if=lambda digests: not digests)


class Output(_Record):
    """A file of a finished stage, its path relative to the stage folder."""

    path: str
    bytes: int
    sha256: str


class Kept(_Record):
    """A line of `items.jsonl`: the item is finished; each stage defines its `result`."""

    id: str
    status: Literal["kept"] = "kept"
    result: dict[str, Any] = {}
    seconds: float = 0.0


class Dropped(_Record):
    """A line of `items.jsonl`: the item is finished, and a rule of the stage drops it."""

    id: str
    status: Literal["dropped"] = "dropped"
    result: dict[str, Any] = {}
    reason: str
    seconds: float = 0.0


class Failed(_Record):
    """A line of `items.jsonl`, and without `status` of `failures.jsonl`: a later run tries the item again."""

    id: str
    status: Literal["failed"] = "failed"
    code: str
    message: str


ItemRecord = Kept | Dropped | Failed
_ITEM: TypeAdapter[ItemRecord] = TypeAdapter(Annotated[ItemRecord, Field(discriminator="status")])
read_item = _ITEM.validate_python  # parses a line of `items.jsonl`


def result_of(record: Kept | Dropped, model: type[Model]) -> Model:
    """Return the result of an item, which an earlier run may have finished, as a model of its stage."""
    return validated(model, record.result, f"items.jsonl: {record.id}: result")


def write_failures(path: Path, failures: Iterable[Failed]) -> None:
    """Write `failures.jsonl`."""
    write_bytes(path, "".join(dump_json(f.model_dump(exclude={"status"})) + "\n" for f in failures).encode())


def read_failures(path: Path) -> list[Failed]:
    """Read `failures.jsonl`."""
    return [failure for _, failure in model_lines(path, Failed, what="record of failures", fix="run the stage first")]


class Tally(BaseModel):
    """The counts of the items of a stage: kept + dropped + failed = input."""

    input: int = 0
    kept: int = 0
    dropped: Counter[str] = Counter()
    failed: Counter[str] = Counter()

    def count(self, record: ItemRecord) -> Failed | None:
        """Count a record, and return it if it is a failure."""
        if isinstance(record, Failed):
            self.failed[record.code] += 1
            return record
        if isinstance(record, Dropped):
            self.dropped[record.reason] += 1
        else:
            self.kept += 1
        return None

    def check(self) -> None:
        """Assert that each item has one outcome; a violation is a bug, not an error of the input."""
        total = self.kept + self.dropped.total() + self.failed.total()
        assert total == self.input, f"{total} outcomes for {self.input} items: {self}"

    def __add__(self, other: Tally) -> Tally:
        return Tally(**{name: getattr(self, name) + getattr(other, name) for name in Tally.model_fields})

    @field_serializer("dropped", "failed")
    def _sorted(self, counts: Counter[str]) -> dict[str, int]:
        return dict(sorted(counts.items()))

    def __str__(self) -> str:
        text = f"{self.kept} kept"
        for outcome, reasons in (("dropped", self.dropped), ("failed", self.failed)):
            if reasons:
                text += f", {reasons.total()} {outcome} ({counts_text(reasons)})"
        return f"{text} of {self.input}"


class Manifest(_Record, extra="allow"):
    """`manifest.json`: the products of a finished stage; each stage defines its further `facts`."""

    stage: str
    outputs: list[Output]
    counts: Tally
    seconds: float

    @property
    def facts(self) -> dict[str, Any]:
        return self.model_extra or {}


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of a complete stage."""
    return read_model(folder / "manifest.json", Manifest, MANIFEST_FORMAT, tree=folder)


def read_stage_record(folder: Path) -> StageRecord:
    """Read `stage.json`."""
    return read_model(folder / "stage.json", StageRecord, STAGE_FORMAT, tree=folder)


# --- a stage at work --------------------------------------------------------------------------------------------------


class StageFolder:
    """The output folder of a stage, opened for one set of settings and inputs.

    `open` writes `stage.json`; `finish` writes `manifest.json`. If the folder is already complete for the same settings
    and inputs, and no item is tried again, `is_complete` is true and the stage has nothing to do.
    """

    def __init__(self, path: Path, stage: str, is_complete: bool, lock: FolderLock | None = None) -> None:
        self.path = path
        self.stage = stage
        self.is_complete = is_complete
        self._lock = lock
        self.started_s = time.monotonic()

    @classmethod
    def open(
        cls,
        out: Path,
        stage: str,
        *,
        config: Config,
        inputs: dict[str, Path],
        seed: int,
        package_files: Mapping[str, Path] = MappingProxyType({}),
        audited: Collection[str] = (),
        begun: Collection[str] = (),
        retries: bool = True,
    ) -> StageFolder:
        """Start a stage, or resume it if its settings, inputs and seed are the same.

        Args:
            inputs: Name -> file or folder that the stage reads.
            package_files: Name -> file or flat folder of the package that determines the products.
            audited: Names of inputs that the stage itself compares with their records, item by item.
            begun: Files and folders that this stage writes before any item is finished, in addition to BEGUN.
            retries: Whether every run tries failed items again; otherwise a folder with failed items is complete.
        """
        record = StageRecord(
            stage=stage,
            config=config.recorded(),
            seed=seed,
            inputs=checked_inputs(inputs, audited),
            code_version=cosfly.__version__,
            package_files={name: _digest(p) for name, p in sorted(package_files.items())},
        )
        if out.exists() and not out.is_dir():
            raise StorageError("the output path is a file, not a folder", where=out, fix="choose another --out")
        if (out / "manifest.json").exists() and _is_complete(out, record, retries=retries):
            log.info("%s: already complete in %s", stage, out)
            return cls(out, stage, True)
        lock = hold_folder(out)
        try:
            _prepare_resume(out, record, (*BEGUN, *begun))
            # Failed items are tried again; the others are in the journal.
            (out / "manifest.json").unlink(missing_ok=True)
            write_model(out / "stage.json", record, STAGE_FORMAT)
            remove_partials(out)
        except BaseException:
            lock.release()
            raise
        return cls(out, stage, False, lock)

    def reopen(self) -> None:
        """Continue a complete stage, which is incomplete then."""
        self._lock = hold_folder(self.path)
        (self.path / "manifest.json").unlink()
        self.is_complete = False

    @property
    def journal(self) -> Journal:
        return Journal(self.path / "items.jsonl")

    def items(self) -> Iterator[ItemRecord]:
        """Yield the outcomes in the journal; an item that was tried again has several."""
        return self.journal.read_as(read_item)

    def finish(self, outputs: Iterable[Path], tally: Tally, **facts: Any) -> None:
        """Write the manifest, which completes the stage; raises NothingKept if no item was kept.

        Args:
            outputs: Files inside the folder; for a folder with many files, its checksum file.
            facts: Further JSON-able facts for the manifest.
        """
        tally.check()
        if not tally.kept:
            raise self.nothing_kept(tally)
        files = [
            Output(path=str(path.relative_to(self.path)), bytes=path.stat().st_size, sha256=sha256_file(path))
            for path in sorted(outputs)
        ]
        seconds = round(time.monotonic() - self.started_s, 3)
        manifest = Manifest(stage=self.stage, outputs=files, counts=tally, seconds=seconds, **facts)
        write_model(self.path / "manifest.json", manifest, MANIFEST_FORMAT)
        if self._lock is not None:
            self._lock.release()
        log.info("%s: %s, %.1f s", self.stage, tally, seconds)

    def nothing_kept(
        self, tally: Tally, *, expected: str | None = None, where: Path | None = None, fix: str | None = None
    ) -> NothingKept:
        """Return the error of a stage that kept nothing, with its counts and its first failure.

        where: The file that shows the cause; None: the folder of the stage.
        """
        got = str(tally)
        path = self.path / "failures.jsonl"
        failures = read_failures(path) if path.exists() else []
        if failures:
            got += f"; the first failure: {failures[0].message}"
        if fix is None:
            fix = "fix the causes listed in failures.jsonl and items.jsonl, or choose other settings and another --out"
        what = f"{self.stage} kept nothing, so the next stage has no input"
        return NothingKept(what, where=where or self.path, got=got, expected=expected, fix=fix)


def _is_complete(out: Path, record: StageRecord, *, retries: bool) -> bool:
    """Return whether a folder with a manifest has nothing to do; raise if it holds other work or lacks outputs."""
    manifest = read_manifest(out)
    _check_same(out, record)
    if retries and manifest.counts.failed:
        return False
    _check_outputs_exist(out, manifest)
    if (out / LOCK).exists():  # a kill has left it, unless it is held or the disk is read-only
        with contextlib.suppress(ResumeError, StorageError):
            hold_folder(out).release()
    return True


def _prepare_resume(out: Path, record: StageRecord, begun: Collection[str]) -> None:
    """Prepare a folder for new work or a resume; raises ResumeError if it holds other work or foreign files."""
    if not (out / "stage.json").exists():
        # A kill during the write of the record leaves its partial file.
        if any(entry.name != LOCK and not entry.match(".stage.json.*.partial") for entry in out.iterdir()):
            problem = "the output directory contains files that cosfly did not write"
            raise ResumeError(problem, where=out, fix="choose an empty --out")
    elif _holds_work(out, begun):
        _check_same(out, record)
    else:
        # An attempt that finished nothing may be repeated with other settings. Its stage.json stays until the new one
        # is written: without it, the other files would look foreign after a kill.
        for name in begun:
            path = out / name
            if name == "stage.json":
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)


def _holds_work(out: Path, begun: Collection[str]) -> bool:
    """Return whether a stage folder holds finished items or products, not only records of failures."""
    if any(not isinstance(item, Failed) for item in Journal(out / "items.jsonl").read_as(read_item)):
        return True
    for path in out.rglob("*"):
        parts = path.relative_to(out).parts
        is_partial = any(part.endswith(".partial") for part in parts)
        if parts[0] not in (*begun, LOCK) and not is_partial and path.is_file():
            return True
    return False


def _check_same(out: Path, record: StageRecord) -> None:
    """Raise ResumeError if `record` does not agree with the record of the work in a folder."""
    previous = read_stage_record(out)
    before = flattened(previous.config) | {"seed": previous.seed}
    after = flattened(record.config) | {"seed": record.seed}
    differences = []
    for key in sorted(before.keys() | after.keys(), key=lambda key: (key == "seed", key)):  # the seed last
        if before.get(key) != after.get(key):
            differences.append(f"{key} was {shown(before.get(key))}, is {shown(after.get(key))}")
    for name in sorted(previous.inputs.keys() | record.inputs.keys()):
        old = previous.inputs.get(name)
        new = record.inputs.get(name)
        if old is None or new is None or old.sha256 != new.sha256:
            differences.append(f"the input {name} ({new.path if new else 'none'}) has changed")
    for name, digest in previous.package_files.items():
        if record.package_files.get(name, digest) != digest:
            differences.append(f"the {name} has changed")
    if differences:
        what = "the folder contains results made with other settings or inputs"
        fix = "choose another --out, or restore the previous settings and inputs"
        raise ResumeError(what, where=out, got="; ".join(differences), fix=fix)
    if previous.code_version != record.code_version:
        log.warning(
            "%s: cosfly %s resumes a stage that cosfly %s started", out, record.code_version, previous.code_version
        )


def _digest(path: Path) -> str:
    """Return one digest for a file or for the files of a folder."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return sha256_bytes("".join(f"{file.name} {sha256_file(file)}\n" for file in files if file.is_file()).encode())


def flattened(config: Any, prefix: str = "") -> dict[str, Any]:
    """Return all values of nested objects by their dotted paths."""
    if not isinstance(config, dict) or not config:
        return {prefix: config}
    values: dict[str, Any] = {}
    for key, value in config.items():
        values |= flattened(value, f"{prefix}.{key}".removeprefix("."))
    return values


def _check_outputs_exist(out: Path, manifest: Manifest) -> None:
    for entry in manifest.outputs:
        path = inside(out, entry.path)
        if not path.is_file() or path.stat().st_size != entry.bytes:
            what = "an output file of a finished stage is missing or has another size"
            fix = f"remove {out} and run the stage again"
            raise VerifyError(what, where=path, expected=f"{entry.bytes} bytes", fix=fix)


# --- digests of products ----------------------------------------------------------------------------------------------


def fingerprint(path: Path) -> str:
    """Return one digest for an input: a file's bytes, a stage's list of products, or a tree's trajectory files."""
    if not path.exists():
        fix = "check the path, or run the stage that writes this file or folder"
        raise InputError("there is no such file or folder", where=path, fix=fix)
    if not path.is_dir():
        return sha256_file(path)  # raises for a pipe or a device
    if manifest := _record(path, "manifest.json"):
        return sha256_bytes(dump_json(manifest.get("outputs", [])).encode())
    digest = hashlib.sha256()
    for file in files_named(path, TRACK_FILE):
        digest.update(f"{file.relative_to(path)} {sha256_file(file)}\n".encode())
    return digest.hexdigest()


def folder_digests(folder: Path) -> dict[str, str]:
    """Return the sha256 of each file of a track by its name; those in `checksums.sha256` are not computed again."""
    digests = read_checksums(folder) if (folder / CHECKSUMS).is_file() else {}
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        if name != CHECKSUMS and name not in digests and path.is_file():
            digests[name] = sha256_file(path)
    return digests


def recorded_digests(folder: Path) -> dict[str, str]:
    """Return the sha256 of a finished stage's products by their paths; empty without a manifest of cosfly."""
    outputs = read_manifest(folder).outputs if _record(folder, "manifest.json") else []
    return {output.path: output.sha256 for output in outputs}


def digest_of(digests: Mapping[str, str]) -> str:
    """Return one digest for the files of a folder."""
    return sha256_bytes(checksum_lines(digests).encode())


# --- the inputs of a stage --------------------------------------------------------------------------------------------


def checked_inputs(inputs: Mapping[str, Path], audited: Collection[str] = ()) -> dict[str, StageInput]:
    """Check that the inputs of a stage are finished, unchanged and belong together; return their fingerprints.

    Args:
        inputs: Name -> file or folder. With several runs, names have the number of the run as a prefix: `2.data`.
        audited: Names of inputs whose files the stage itself compares with their records, one by one.
    """
    for name, path in inputs.items():
        log.debug("reads %s: %s", name, path)
        try:
            str(path).encode()
        except UnicodeEncodeError:
            problem = "the path of an input contains a name that is not UTF-8 text"
            raise InputError(problem, where=path, fix="rename the file or folder") from None
        if name not in audited:
            _check_finished(path)
    records = {name: StageInput(path=str(path), sha256=fingerprint(path)) for name, path in sorted(inputs.items())}
    for name, path in inputs.items():
        _check_belongs(name, path, inputs, records)
    return records


def _record(folder: Path, name: str) -> dict[str, Any] | None:
    """Return a record of cosfly as JSON; None for no file or one of another tool with the same name."""
    value = read_json(folder / name) if (folder / name).is_file() else None
    return value if isinstance(value, dict) and value.get("schema") == RECORDS[name] else None


def _stage_folder(path: Path) -> Path | None:
    """Return the folder of the stage that made an input: a folder itself, or the first or second parent of a file."""
    candidates = [path] if path.is_dir() else path.absolute().parents[:2]
    return next((folder for folder in candidates if any(_record(folder, name) for name in RECORDS)), None)


def record_of(product: Path) -> StageRecord | None:
    """Return the record of the stage that made a product; None if there is none."""
    folder = _stage_folder(product)
    return read_stage_record(folder) if folder is not None and _record(folder, "stage.json") else None


def _check_finished(path: Path) -> None:
    """Check that the stage of an input is complete, and that the file, or all files of the folder, are unchanged."""
    folder = _stage_folder(path)
    if folder is None or not path.exists():
        return
    for name in RECORDS:
        if not _record(folder, name):
            raise VerifyError(
                "the stage that makes this input is not finished or kept nothing, or its records are missing",
                where=path,
                got=f"no {name} in {folder}",
                expected="a finished stage",
                fix="run that stage again; to use its files without this check, copy them to an empty folder, and pass "
                "that folder",
            )
    name = os.path.relpath(path, folder)
    problems = list[str]()
    for output, digest in recorded_digests(folder).items():
        file = inside(folder, output)
        if path.is_dir() or output == name:
            if not file.is_file():
                problems.append(f"{file} is missing")
            elif sha256_file(file) != digest:
                problems.append(f"{file} has changed")
    if problems:
        more = f" and {len(problems) - NUM_NAMED} more" if len(problems) > NUM_NAMED else ""
        what = "files of this stage were changed after it finished"
        expected = "files with the digests that the stage recorded"
        fix = "restore the files or run the stage again; to use a file that you changed, copy it to an empty folder"
        raise VerifyError(what, where=folder, got="; ".join(problems[:NUM_NAMED]) + more, expected=expected, fix=fix)


def _check_belongs(name: str, path: Path, inputs: Mapping[str, Path], records: Mapping[str, StageInput]) -> None:
    """Check that an input was made from the other inputs of the same run, as far as its stage read them."""
    record = record_of(path)
    if record is None:
        return
    run = name.rpartition(".")[0]
    peers = {_role(other): other for other in inputs if other.rpartition(".")[0] == run}
    for role, peer in peers.items():
        sources = [entry for source, entry in record.inputs.items() if _role(source) == role]
        if sources and peer != name and all(entry.sha256 != records[peer].sha256 for entry in sources):
            what = f"{path.name} was made with another input `{role}`, or that input has changed since"
            expected = f"{sources[0].path}, unchanged since then"
            fix = f"pass the expected input, or run the stage that writes {path.name} again"
            raise VerifyError(what, where=path, got=str(inputs[peer]), expected=expected, fix=fix)


def _role(name: str) -> str:
    """Return the name of an input without the number of its run, the same in all stages."""
    role = name.rpartition(".")[2]
    return ROLES.get(role, role)
