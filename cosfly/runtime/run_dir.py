"""The directory of one stage: its lock, its records, and the inputs that it was made of.

`stage.json` is written first (settings, digests of inputs, seed, code version), `items.jsonl` grows while items are
finished, `failures.jsonl` and `manifest.json` are written last: a manifest means that the stage is complete. The
digests find what was changed, exchanged or mixed up; they are no signatures against somebody who changes records too.
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
from cosfly.runtime.errors import InputError, NothingKept, ResumeError, StorageError, VerifyError
from cosfly.runtime.events import EVENTS, lost_steps
from cosfly.runtime.io import (
    CHECKSUMS,
    checksum_lines,
    files_named,
    inside,
    read_checksums,
    refuse_links,
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
BEGUN = ("stage.json", "items.jsonl", "failures.jsonl", EVENTS, "preflight.json")  # there before anything is finished
ROLES = {"maps": "boxes", "map": "simplified"}  # a product that stages call by two names
NUM_NAMED = 5  # files that an error names

Resume = Literal["never", "if-same"]


# --- the lock ---------------------------------------------------------------------------------------------------------


class FolderLock(FileLock):
    """The system's lock on `.lock` in a folder, held until release, the last reference, or the end of the process."""

    def __enter__(self) -> Self:  # `hold_folder` has acquired it
        return self

    def release(self, force: bool = True) -> None:
        """Release the folder and remove the file, so that a finished folder holds products only."""
        if self.is_locked:
            with contextlib.suppress(OSError):
                os.unlink(self.lock_file)  # while it is locked: a process that waits for this file makes its own
            super().release(force)


def hold_folder(folder: Path) -> FolderLock:
    """Lock a folder, which is created if needed; ResumeError where another process holds it.

    A process may lock a folder again while it still refers to the first lock, as after an error in a notebook.
    """
    path = folder.resolve() / LOCK
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = FolderLock(path, timeout=0, thread_local=False, is_singleton=True)
        try:
            lock.acquire()
        except Timeout:
            fix = "wait for it or stop it, then run the same command again; or choose another --out"
            raise ResumeError("another process is at work in this folder", where=path.parent, fix=fix) from None
        except NotImplementedError:
            what = "the file system has no locks"
            raise StorageError(what, where=path.parent, fix="choose another --out") from None
    return lock


def is_held(folder: Path) -> bool:
    """Return whether another process holds a folder now."""
    try:
        if (folder / LOCK).is_file():
            FileLock(folder / LOCK, timeout=0).acquire().lock.release()
    except Timeout:
        return True
    except (OSError, NotImplementedError):
        pass
    return False


# --- records ----------------------------------------------------------------------------------------------------------


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True)


class StageInput(_Record):
    """A file or folder that a stage reads."""

    path: str
    sha256: str


class StageRecord(_Record):
    """`stage.json`: what the folder was started with.

    package_files: sha256 of data that ships with cosfly and may change with its version, such as prompts.
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


class Kept(_Record):
    """A line of `items.jsonl`: the item is done; `result` is the stage's own."""

    id: str
    status: Literal["kept"] = "kept"
    result: dict[str, Any] = {}
    seconds: float = 0.0


class Dropped(_Record):
    """A line of `items.jsonl`: the item is done, and a rule of the stage drops it."""

    id: str
    status: Literal["dropped"] = "dropped"
    result: dict[str, Any] = {}
    reason: str
    seconds: float = 0.0


class Failed(_Record):
    """A line of `items.jsonl`, and without its status of `failures.jsonl`: the item will be tried again."""

    id: str
    status: Literal["failed"] = "failed"
    code: str
    message: str


ItemRecord = Kept | Dropped | Failed
_ITEM: TypeAdapter[ItemRecord] = TypeAdapter(Annotated[ItemRecord, Field(discriminator="status")])
read_item = _ITEM.validate_python  # of a line of `items.jsonl`


def result_of(record: Kept | Dropped, model: type[Model]) -> Model:
    """Return the result of an item, which may have been done by an earlier run, as the stage's own model."""
    return validated(model, record.result, f"items.jsonl: {record.id}: result")


def write_failures(path: Path, failures: Iterable[Failed]) -> None:
    """Write `failures.jsonl`."""
    write_bytes(path, "".join(dump_json(f.model_dump(exclude={"status"})) + "\n" for f in failures).encode())


def read_failures(path: Path) -> list[Failed]:
    """Read `failures.jsonl`."""
    return [failure for _, failure in model_lines(path, Failed, what="record of failures", fix="run the stage first")]


class Tally(BaseModel):
    """The counts of a stage's items: kept + dropped + failed = input, always."""

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
        """Assert that nothing was lost: a tally that does not add up is a bug of ours, not of the input."""
        total = self.kept + self.dropped.total() + self.failed.total()
        assert total == self.input, f"{total} outcomes for {self.input} items: {self}"

    def __add__(self, other: Tally) -> Tally:
        return Tally(**{name: getattr(self, name) + getattr(other, name) for name in Tally.model_fields})

    @field_serializer("dropped", "failed")
    def _sorted(self, counts: Counter[str]) -> dict[str, int]:
        return dict(sorted(counts.items()))

    def __str__(self) -> str:
        text = f"{self.kept} kept"
        for word, reasons in (("dropped", self.dropped), ("failed", self.failed)):
            if reasons:
                listed = ", ".join(f"{reason} {count}" for reason, count in sorted(reasons.items()))
                text += f", {reasons.total()} {word} ({listed})"
        return f"{text} of {self.input}"


class Manifest(_Record, extra="allow"):
    """`manifest.json`: the products of a finished stage; `facts` are the stage's own."""

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
    """One stage's output folder, opened for one set of settings and inputs.

    `open` writes `stage.json`; `finish` writes `manifest.json`. If the folder is already complete for the same settings
    and inputs, and no item failed, `is_complete` is true and the stage has nothing to do.
    """

    def __init__(self, path: Path, stage: str, is_complete: bool, lock: FolderLock | None = None) -> None:
        self.path, self.stage, self.is_complete, self._lock = path, stage, is_complete, lock
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
        resume: Resume = "if-same",
        package_files: Mapping[str, Path] = MappingProxyType({}),
        audited: Collection[str] = (),
        begun: Collection[str] = (),
    ) -> StageFolder:
        """Start or resume a stage.

        Args:
            inputs: Name -> file or folder that the stage reads.
            resume: `never` refuses a folder that holds work; `if-same` wants equal settings, inputs and seed.
            package_files: Name -> file or flat folder of the package that decides what is made.
            audited: Names of inputs that the stage itself compares with their records, item by item.
            begun: Files and folders that the stage writes before anything is finished, next to those of every stage.
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
            raise StorageError("the output folder is a file", where=out, fix="choose another --out")
        if (out / "manifest.json").exists():
            manifest = read_manifest(out)
            _check_same(out, record, resume)
            if not manifest.counts.failed:
                _check_outputs_exist(out, manifest)
                if (out / LOCK).exists():  # left by a kill, unless it is held or the disk is read-only
                    with contextlib.suppress(ResumeError, StorageError):
                        hold_folder(out).release()
                log.debug("%s: complete for the same settings and inputs: %s", stage, out)
                return cls(out, stage, True)
        lock = hold_folder(out)
        try:
            refuse_links(out)
            _prepare_resume(out, record, resume, (*BEGUN, *begun))
            # Failed items are tried again; the others are in the journal.
            (out / "manifest.json").unlink(missing_ok=True)
            write_model(out / "stage.json", record, STAGE_FORMAT)
            remove_partials(out)
        except BaseException:
            lock.release()
            raise
        return cls(out, stage, False, lock)

    def reopen(self) -> None:
        """Make a complete stage one that has more to do."""
        self._lock = hold_folder(self.path)
        refuse_links(self.path)
        (self.path / "manifest.json").unlink()
        self.is_complete = False

    @property
    def journal(self) -> Journal:
        return Journal(self.path / "items.jsonl")

    def items(self) -> Iterator[ItemRecord]:
        """Yield the outcomes in the journal; an item that failed and was tried again has several."""
        return self.journal.read_as(read_item)

    def finish(self, outputs: Iterable[Path], tally: Tally, **facts: Any) -> None:
        """Write the manifest: the stage is complete. NothingKept where no item was kept; what was written stays.

        Args:
            outputs: Files inside the folder; of a folder with many files, its checksum file.
            facts: Further JSON-able facts for the manifest.
        """
        tally.check()
        if not tally.kept:
            raise self.nothing_kept(tally)
        if lost := lost_steps(self.path):
            facts["lost_steps"] = lost
        files = [
            Output(path=str(p.relative_to(self.path)), bytes=p.stat().st_size, sha256=sha256_file(p))
            for p in sorted(outputs)
        ]
        seconds = round(time.monotonic() - self.started_s, 3)
        manifest = Manifest(stage=self.stage, outputs=files, counts=tally, seconds=seconds, **facts)
        write_model(self.path / "manifest.json", manifest, MANIFEST_FORMAT)
        if self._lock is not None:
            self._lock.release()
        log.info("%s: %s, %.1f s", self.stage, tally, seconds)
        if lost:
            log.info("%s: %d steps of lost workers and failed items were repeated or skipped", self.stage, lost)

    def nothing_kept(
        self, tally: Tally, *, expected: str | None = None, where: Path | None = None, fix: str | None = None
    ) -> NothingKept:
        """Return the error of a stage that has nothing for the next one, with its counts and its first failure.

        where: The file that says why; None: the stage's folder.
        """
        path, got = self.path / "failures.jsonl", str(tally)
        if failures := read_failures(path) if path.exists() else []:
            got += f"; the first failure: {failures[0].message}"
        fix = fix or "fix what failures.jsonl and items.jsonl there name, or change settings and choose another --out"
        what = f"{self.stage} kept nothing, so the next stage has no input"
        return NothingKept(what, where=where or self.path, got=got, expected=expected, fix=fix)


def _prepare_resume(out: Path, record: StageRecord, resume: Resume, begun: Collection[str]) -> None:
    """Make a folder ready to be resumed; ResumeError where it may not be."""
    if not (out / "stage.json").exists():
        # A kill may have come while the record was being written.
        if any(entry.name != LOCK and not entry.match(".stage.json.*.partial") for entry in out.iterdir()):
            what = "the output folder holds files that are not cosfly's"
            raise ResumeError(what, where=out, fix="choose an empty --out")
    elif _holds_work(out, begun):
        _check_same(out, record, resume)
    else:  # An attempt that ended before anything was finished binds nobody to its settings.
        # stage.json stays until the new one is written: without it a kill would leave what looks like foreign files.
        for path in (out / name for name in begun if name != "stage.json"):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _holds_work(out: Path, begun: Collection[str]) -> bool:
    """Return whether a stage folder holds anything that was finished, and not only the records of failures."""
    if any(not isinstance(item, Failed) for item in Journal(out / "items.jsonl").read_as(read_item)):
        return True
    files = (path.relative_to(out).parts for path in out.rglob("*") if path.is_file())
    return any(
        parts[0] not in (*begun, LOCK) and not any(part.endswith(".partial") for part in parts) for parts in files
    )


def _check_same(out: Path, record: StageRecord, resume: Resume) -> None:
    """Raise ResumeError where the work in a folder may not be resumed as `record` says."""
    found = read_stage_record(out)
    if resume == "never":
        raise ResumeError("the folder already holds work", where=out, fix="choose another --out, or --resume if-same")
    before, after = (flattened(one.config) | {"seed": one.seed} for one in (found, record))
    differences = [
        f"{key} was {before.get(key)!r}, is {after.get(key)!r}"
        for key in sorted(before.keys() | after.keys(), key=lambda key: (key == "seed", key))
        if before.get(key) != after.get(key)
    ]
    for name in sorted(found.inputs.keys() | record.inputs.keys()):
        old, new = found.inputs.get(name), record.inputs.get(name)
        if old is None or new is None or old.sha256 != new.sha256:
            differences.append(f"the input {name} ({new.path if new else 'none'}) has changed")
    files = record.package_files
    differences += [f"the {name} changed" for name, own in found.package_files.items() if files.get(name, own) != own]
    if differences:
        what, fix = "the folder holds work made with other settings or inputs", "choose another --out, or restore them"
        raise ResumeError(what, where=out, got="; ".join(differences), fix=fix)
    if found.code_version != record.code_version:
        log.warning("%s: resumed by version %s, started by %s", out, record.code_version, found.code_version)


def _digest(path: Path) -> str:
    """Return one digest for a file or for the files of a folder."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return sha256_bytes("".join(f"{file.name} {sha256_file(file)}\n" for file in files if file.is_file()).encode())


def flattened(config: Any, prefix: str = "") -> dict[str, Any]:
    """Return every value of nested objects by its dotted path."""
    if not isinstance(config, dict) or not config:
        return {prefix: config}
    parts = (flattened(value, f"{prefix}.{key}".removeprefix(".")) for key, value in config.items())
    return {name: value for part in parts for name, value in part.items()}


def _check_outputs_exist(out: Path, manifest: Manifest) -> None:
    for entry in manifest.outputs:
        path = inside(out, entry.path)
        if not path.is_file() or path.stat().st_size != entry.bytes:
            what = "the manifest calls this stage complete, but a product is missing or has another size"
            fix = f"remove {out} and run the stage again"
            raise VerifyError(what, where=path, expected=f"{entry.bytes} bytes", fix=fix)


# --- digests of products ----------------------------------------------------------------------------------------------


def fingerprint(path: Path) -> str:
    """Return one digest for an input: a file's bytes, a stage's list of products, or a tree's trajectory files."""
    if not path.exists():
        fix = "check the path, or run the stage that makes it"
        raise InputError("there is no such file or folder", where=path, fix=fix)
    if not path.is_dir():
        return sha256_file(path)  # an error where it is a pipe or a device
    if manifest := _record(path, "manifest.json"):
        return sha256_bytes(dump_json(manifest.get("outputs", [])).encode())
    digest = hashlib.sha256()
    for file in files_named(path, TRACK_FILE):
        digest.update(f"{file.relative_to(path)} {sha256_file(file)}\n".encode())
    return digest.hexdigest()


def folder_digests(folder: Path) -> dict[str, str]:
    """Return the sha256 of each file of a track by its name: from `checksums.sha256` where it is listed there."""
    listed = read_checksums(folder) if (folder / CHECKSUMS).is_file() else {}
    found = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return listed | {name: sha256_file(folder / name) for name in found if name != CHECKSUMS and name not in listed}


def recorded_digests(folder: Path) -> dict[str, str]:
    """Return the sha256 of a finished stage's products by their paths; empty where there is no manifest of ours."""
    outputs = read_manifest(folder).outputs if _record(folder, "manifest.json") else []
    return {output.path: output.sha256 for output in outputs}


def digest_of(digests: Mapping[str, str]) -> str:
    """Return one digest for the files of a folder."""
    return sha256_bytes(checksum_lines(digests).encode())


# --- the inputs of a stage --------------------------------------------------------------------------------------------


def checked_inputs(inputs: Mapping[str, Path], audited: Collection[str] = ()) -> dict[str, StageInput]:
    """Return the fingerprints of what a stage reads, once it is known to be finished, unchanged and of one origin.

    Args:
        inputs: Name -> file or folder; of several runs with a number in front, as `2.data`.
        audited: Names of inputs whose files the stage itself compares with their records, one by one.
    """
    for name, path in inputs.items():
        log.debug("reads %s: %s", name, path)
        try:
            str(path).encode()
        except UnicodeEncodeError:
            what = "a name that is not UTF-8 text cannot be recorded"
            raise InputError(what, where=path, fix="rename it") from None
        if name not in audited:
            _check_finished(path)
    found = {name: StageInput(path=str(path), sha256=fingerprint(path)) for name, path in sorted(inputs.items())}
    for name, path in inputs.items():
        _check_belongs(name, path, inputs, found)
    return found


def _record(folder: Path, name: str) -> dict[str, Any] | None:
    """Return a record of ours as JSON; None where there is none: others write files of these names too."""
    value = read_json(folder / name) if (folder / name).is_file() else None
    return value if isinstance(value, dict) and value.get("schema") == RECORDS[name] else None


def _stage_folder(path: Path) -> Path | None:
    """Return the folder of the stage that made an input: itself, its parent or the parent's parent; None: not ours."""
    places = [path] if path.is_dir() else path.absolute().parents[:2]
    return next((place for place in places if any(_record(place, name) for name in RECORDS)), None)


def record_of(product: Path) -> StageRecord | None:
    """Return the record of the stage that made a product; None where there is none."""
    folder = _stage_folder(product)
    return read_stage_record(folder) if folder is not None and _record(folder, "stage.json") else None


def _check_finished(path: Path) -> None:
    """Compare an input with the manifest of its stage: a file with its line, a folder with all of them."""
    folder = _stage_folder(path)
    if folder is None or not path.exists():
        return
    for name in RECORDS:
        if not _record(folder, name):
            what, got = "the stage that makes this is not finished, or its records are gone", f"no {name} in {folder}"
            fix = "run that stage again; to use what is there as it is, copy it to a folder of its own"
            raise VerifyError(what, where=path, got=got, expected=f"{name} of that stage", fix=fix)
    name, wrong = os.path.relpath(path, folder), list[str]()
    for listed, digest in recorded_digests(folder).items():
        file = inside(folder, listed)
        if path.is_dir() or listed == name:
            if not file.is_file():
                wrong.append(f"{file} is missing")
            elif sha256_file(file) != digest:
                wrong.append(f"{file} has other bytes")
    if wrong:
        more = f" and {len(wrong) - NUM_NAMED} more" if len(wrong) > NUM_NAMED else ""
        what = "the files of this stage are not those that it finished"
        expected = "the files whose digests are in its records"
        fix = "put the files back or make them again; to use a file that you changed, copy it to a folder of its own"
        raise VerifyError(what, where=folder, got="; ".join(wrong[:NUM_NAMED]) + more, expected=expected, fix=fix)


def _check_belongs(name: str, path: Path, inputs: Mapping[str, Path], found: Mapping[str, StageInput]) -> None:
    """Check that each input which an input was made of, and which is given too, is the one given."""
    if (record := record_of(path)) is None:
        return
    front = name.rpartition(".")[0]
    peers = {_role(other): other for other in inputs if other.rpartition(".")[0] == front}
    for role, peer in peers.items():
        made_of = [(other, entry) for other, entry in record.inputs.items() if _role(other) == role]
        if made_of and peer != name and all(entry.sha256 != found[peer].sha256 for _, entry in made_of):
            wanted, entry = made_of[0]
            what, got = f"it was made of another input {wanted!r} than the one given with it", f"given: {inputs[peer]}"
            fix = f"give the two that belong together, or make {path.name} again"
            raise VerifyError(what, where=path, got=got, expected=f"{entry.path}, as it was then", fix=fix)


def _role(name: str) -> str:
    role = name.rpartition(".")[2]
    return ROLES.get(role, role)
