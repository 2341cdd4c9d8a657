"""The folder of one stage: its records, its lock, and the inputs that it was made of.

`stage.json` is written first (settings, digests of inputs, seed, code version), `items.jsonl` grows while items are
finished, `failures.jsonl` and `manifest.json` are written last. A manifest means: complete. The digests find what was
changed, exchanged or mixed up; they are no signatures against somebody who changes the records too.
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
from typing import Annotated, Any, Literal
from weakref import WeakValueDictionary

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
    is_partial_of,
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
    read_object,
    validated,
    write_model,
)

LOCK = ".lock"


class FolderLock:
    """Holds a folder until it is released, or nobody refers to it any more, or the process ends."""

    def __init__(self, path: Path) -> None:
        self.path, self._lock = path, FileLock(path, timeout=0, thread_local=False)
        with storage_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                self._lock.acquire()
            except Timeout:
                fix = "wait for it or stop it, then run the same command again; or choose another --out"
                raise ResumeError("another process is at work in this folder", where=path.parent, fix=fix) from None
            except NotImplementedError:
                fix = "choose another --out"
                raise StorageError("the file system has no locks", where=path.parent, fix=fix) from None

    @property
    def is_held(self) -> bool:
        return self._lock.is_locked

    def release(self) -> None:
        """Release the folder and remove the file, so that a finished folder holds products only."""
        if self._lock.is_locked:
            with contextlib.suppress(OSError):
                self.path.unlink()  # while it is locked: a process that waits for this file then makes its own
            self._lock.release(force=True)

    def __enter__(self) -> FolderLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def __del__(self) -> None:
        self.release()


# A process may open a folder again while it still refers to the first lock, for example after an error in a notebook.
_held: WeakValueDictionary[Path, FolderLock] = WeakValueDictionary()


def hold_folder(folder: Path) -> FolderLock:
    """Lock a folder, which is created if needed.

    Raises:
        ResumeError: another process holds it.
        StorageError: the folder cannot be written to.
    """
    path = folder.resolve() / LOCK
    held = _held.get(path)
    if held is None or not held.is_held:
        held = _held[path] = FolderLock(path)
    return held


def remove_left_lock(folder: Path) -> None:
    """Remove the file that a kill left in a finished folder, unless it is held or the disk is read-only."""
    if (folder / LOCK).exists():
        with contextlib.suppress(ResumeError, StorageError):
            hold_folder(folder).release()


def is_held(folder: Path) -> bool:
    """Return whether a process holds a folder now."""
    lock = FileLock(folder / LOCK, timeout=0)
    try:
        if (folder / LOCK).is_file():
            lock.acquire()
            lock.release()
    except Timeout:
        return True
    except (OSError, NotImplementedError):
        return False
    return False


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


Resume = Literal["never", "if-same"]

# What stands in a folder before anything is finished.
BEGUN = ("stage.json", "items.jsonl", "failures.jsonl", EVENTS, "preflight.json")


# --- what became of the items -----------------------------------------------------------------------------------------


class Kept(_Record):
    """A line of `items.jsonl`: the item is done; `result` is the stage's own."""

    id: str
    status: Literal["kept"] = "kept"
    result: dict[str, Any] = {}
    seconds: float = 0.0


class Dropped(_Record):
    """A line of `items.jsonl`: the item is done, and a rule of the stage leaves it out."""

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


def result_of(record: Kept | Dropped, model: type[Model]) -> Model:
    """Return the result of an item, which may have been done by an earlier run, as the stage's own model."""
    return validated(model, record.result, f"items.jsonl: {record.id}: result")


_ITEM: TypeAdapter[ItemRecord] = TypeAdapter(Annotated[ItemRecord, Field(discriminator="status")])


def read_item(record: dict) -> ItemRecord:
    """Read a line of `items.jsonl`; one that cannot be used is a ValidationError."""
    return _ITEM.validate_python(record)


def write_failures(path: Path, failures: Iterable[Failed]) -> None:
    """Write `failures.jsonl`."""
    write_bytes(path, "".join(dump_json(f.model_dump(exclude={"status"})) + "\n" for f in failures).encode())


def read_failures(path: Path) -> list[Failed]:
    """Read `failures.jsonl`."""
    return [failure for _, failure in model_lines(path, Failed, what="record of failures", fix="run the stage first")]


class Tally(BaseModel):
    """What became of a stage's items. kept + dropped + failed = input, always."""

    input: int = 0
    kept: int = 0
    dropped: Counter[str] = Counter()
    failed: Counter[str] = Counter()

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


# --- what stands in the folder ----------------------------------------------------------------------------------------


class Manifest(BaseModel):
    """`manifest.json`: what a finished stage made. `facts` are what else the stage says of itself."""

    model_config = ConfigDict(extra="allow", frozen=True)

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
        """Start or continue a stage.

        Args:
            config: the stage's settings; those that are MayDiffer are not put on record.
            inputs: name -> file or folder that the stage reads.
            resume: `never` refuses a folder that holds work; `if-same` continues only with equal settings, inputs and
                seed.
            package_files: name -> file or flat folder of the package that decides what is made.
            audited: names of inputs that the stage itself holds against their records, item by item.
            begun: files and folders that the stage writes before anything is finished, beside those of every stage.
        """
        record = StageRecord(
            stage=stage,
            config=config.recorded(),
            seed=seed,
            inputs=checked_inputs(inputs, audited),
            code_version=cosfly.__version__,
            package_files={name: _digest(p) for name, p in sorted(package_files.items())},
        )
        for name, path in inputs.items():
            log.debug("%s: reads %s: %s", stage, name, path)
        if out.exists() and not out.is_dir():
            raise StorageError("the output folder is a file", where=out, fix="choose another --out")
        if (out / "manifest.json").exists() and (complete := cls._complete(out, record, resume)):
            return complete
        lock = hold_folder(out)
        try:
            refuse_links(out)
            _take_up(out, record, resume, (*BEGUN, *begun))
            # Failed items are tried again; the others stand in the journal.
            (out / "manifest.json").unlink(missing_ok=True)
            write_model(out / "stage.json", record, STAGE_FORMAT)
            remove_partials(out)
        except BaseException:
            lock.release()
            raise
        return cls(out, stage, False, lock)

    @classmethod
    def _complete(cls, out: Path, record: StageRecord, resume: Resume) -> StageFolder | None:
        """Return a folder that is complete as `record` says, which takes no lock; None where there is something to
        do."""
        manifest = read_manifest(out)
        _check_same(out, record, resume)
        if manifest.counts.failed:
            return None
        _check_outputs_exist(out, manifest)
        remove_left_lock(out)
        log.debug("%s: complete for the same settings and inputs: %s", record.stage, out)
        return cls(out, record.stage, True)

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
        """Yield the outcomes in the journal; an item that failed and was tried again has several.

        Raises:
            InputError: a line of the journal cannot be used.
        """
        return self.journal.read_as(read_item)

    def finish(self, outputs: Iterable[Path], tally: Tally, **facts: Any) -> None:
        """Write the manifest: the stage is complete.

        Args:
            outputs: files inside the folder; of a folder with many files, give its checksum file.
            facts: further JSON-able facts for the manifest.
        Raises:
            NothingKept: no item was kept. What was written stays, without a manifest.
        """
        tally.check()
        if not tally.kept:
            raise self.nothing_kept(tally)
        if lost := lost_steps(self.path):
            facts["lost_steps"] = lost
        manifest = Manifest(
            stage=self.stage,
            outputs=[
                Output(path=str(p.relative_to(self.path)), bytes=p.stat().st_size, sha256=sha256_file(p))
                for p in sorted(outputs)
            ],
            counts=tally,
            seconds=round(time.monotonic() - self.started_s, 3),
            **facts,
        )
        write_model(self.path / "manifest.json", manifest, MANIFEST_FORMAT)
        if self._lock is not None:
            self._lock.release()
        log.info("%s: %s, %.1f s", self.stage, tally, manifest.seconds)
        if lost:
            log.info("%s: %d steps of lost workers and failed items were done again, or left out", self.stage, lost)

    def nothing_kept(
        self, tally: Tally, *, expected: str | None = None, where: Path | None = None, fix: str | None = None
    ) -> NothingKept:
        """Return the error of a stage that has nothing for the next one: how often what happened, and the first
        failure.

        Args:
            where: what stands on disk and says why; else the stage's folder. fix: what to do, where more is known of
                it.
        """
        path = self.path / "failures.jsonl"
        failures = read_failures(path) if path.exists() else []
        return NothingKept(
            f"{self.stage} kept nothing, so there is nothing to go on with",
            where=where or self.path,
            got=f"{tally}; the first failure: {failures[0].message}" if failures else str(tally),
            expected=expected,
            fix=fix
            or "mend what failures.jsonl and items.jsonl there name, or change the settings and choose another --out",
        )


def _take_up(out: Path, record: StageRecord, resume: Resume, begun: Collection[str]) -> None:
    """Make what stands in a folder ready to be gone on with; ResumeError where it may not be."""
    if not (out / "stage.json").exists():
        # A kill may have come while the record was being written.
        if any(entry.name != LOCK and not is_partial_of("stage.json", entry) for entry in out.iterdir()):
            raise ResumeError(
                "the output folder holds files that are not cosfly's", where=out, fix="choose an empty --out"
            )
        return
    # An attempt that ended before anything was finished binds nobody to its settings.
    if not _holds_work(out, begun):
        # stage.json stays until the new one is written: without it a kill would leave what looks like foreign files.
        for path in (out / name for name in begun if name != "stage.json"):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        return
    _check_same(out, record, resume)


def _check_same(out: Path, record: StageRecord, resume: Resume) -> None:
    """Raise ResumeError where the work in a folder may not be continued as `record` says."""
    found = read_stage_record(out)
    if resume == "never":
        raise ResumeError("the folder already holds work", where=out, fix="choose another --out, or --resume if-same")
    if differences := _differences(found, record):
        raise ResumeError(
            "the folder holds work made with other settings or inputs",
            where=out,
            got="; ".join(differences),
            fix="choose another --out, or restore what differs",
        )
    if found.code_version != record.code_version:
        log.warning("%s: continued by version %s, begun by %s", out, record.code_version, found.code_version)


def _holds_work(out: Path, begun: Collection[str]) -> bool:
    """Return whether a stage folder holds anything that was finished, and not only the records of failures."""
    if any(not isinstance(item, Failed) for item in Journal(out / "items.jsonl").read_as(read_item)):
        return True
    files = (path.relative_to(out) for path in out.rglob("*") if path.is_file())
    return any(
        file.parts[0] not in (*begun, LOCK) and not any(part.endswith(".partial") for part in file.parts)
        for file in files
    )


def _differences(found: StageRecord, wanted: StageRecord) -> list[str]:
    """Return which settings, inputs or seed differ."""
    before, after = flattened(found.config), flattened(wanted.config)
    changed = [
        f"{key} was {before.get(key)!r}, is {after.get(key)!r}"
        for key in sorted(before.keys() | after.keys())
        if before.get(key) != after.get(key)
    ]
    if found.seed != wanted.seed:
        changed.append(f"seed was {found.seed}, is {wanted.seed}")
    for name in sorted(found.inputs.keys() | wanted.inputs.keys()):
        old, new = found.inputs.get(name), wanted.inputs.get(name)
        if old is None or new is None or old.sha256 != new.sha256:
            changed.append(f"the input {name} ({new.path if new else 'none'}) has changed")
    both = found.package_files.keys() & wanted.package_files.keys()
    changed += [
        f"the {name} changed" for name in sorted(both) if found.package_files[name] != wanted.package_files[name]
    ]
    return changed


def _digest(path: Path) -> str:
    """Return one digest for a file or for the files of a folder."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return sha256_bytes("".join(f"{file.name} {sha256_file(file)}\n" for file in files if file.is_file()).encode())


def flattened(config: Any, prefix: str = "") -> dict[str, Any]:
    """Name every value of nested objects by its dotted path."""
    if not isinstance(config, dict) or not config:
        return {prefix: config}
    flat: dict[str, Any] = {}
    for key, value in config.items():
        flat.update(flattened(value, f"{prefix}.{key}" if prefix else str(key)))
    return flat


def _check_outputs_exist(out: Path, manifest: Manifest) -> None:
    for entry in manifest.outputs:
        path = inside(out, entry.path)
        if not path.is_file() or path.stat().st_size != entry.bytes:
            raise VerifyError(
                "the manifest calls this stage complete, but a product is missing or has another size",
                where=path,
                expected=f"{entry.bytes} bytes",
                fix=f"remove {out} and run the stage again",
            )
