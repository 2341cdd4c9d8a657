"""The folder of one stage and the records in it.

A stage folder tells its own story: `stage.json` is written first (settings, inputs, seed, code version), `items.jsonl`
grows while items are finished, `failures.jsonl` and `manifest.json` are written last. A manifest means: complete.
"""

from __future__ import annotations

import logging
import shutil
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, field_serializer

import cosfly
from cosfly.runtime.config import Config
from cosfly.runtime.documents import Model, model_lines, read_model, validated
from cosfly.runtime.errors import NothingKept, ResumeError, StorageError, VerifyError
from cosfly.runtime.files import sha256_file
from cosfly.runtime.folder_lock import LOCK, FolderLock, hold_folder, remove_left_lock
from cosfly.runtime.journal import Journal
from cosfly.runtime.provenance import (
    MANIFEST_FORMAT,
    STAGE_FORMAT,
    Output,
    StageRecord,
    checked_inputs,
    read_stage_record,
)
from cosfly.runtime.stage_events import EVENTS, lost_steps
from cosfly.runtime.store import (
    dump_json,
    inside,
    is_partial_of,
    refuse_links,
    remove_partials,
    sha256_bytes,
    write_bytes,
    write_model,
)

log = logging.getLogger(__name__)

Resume = Literal["never", "if-same"]

# What stands in a folder before anything is finished.
BEGUN = ("stage.json", "items.jsonl", "failures.jsonl", EVENTS, "preflight.json")


# --- what became of the items -----------------------------------------------------------------------------------------


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True)


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
