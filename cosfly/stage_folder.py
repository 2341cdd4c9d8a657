"""The folder of one stage, and the tally of its items.

A stage folder tells its own story: `stage.json` is written first (settings, inputs, seed, code version), `items.jsonl` grows
while items are finished, `failures.jsonl` and `manifest.json` are written last. A manifest means: complete.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import cosfly
from cosfly.errors import ResumeError, StorageError, VerifyError
from cosfly.journal import Journal
from cosfly.store import check_schema, fingerprint, inside, read_json, remove_partials, sha256_file, write_json

log = logging.getLogger(__name__)

Resume = Literal["never", "if-same", "force"]

STAGE_SCHEMA, MANIFEST_SCHEMA, VERSION = "cosfly.stage", "cosfly.manifest", "1.0"


@dataclass
class Tally:
    """What became of a stage's items. kept + dropped + failed + unfinished = input, always."""

    num_input: int = 0
    kept: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    failed: dict[str, int] = field(default_factory=dict)

    @property
    def num_dropped(self) -> int:
        return sum(self.dropped.values())

    @property
    def num_failed(self) -> int:
        return sum(self.failed.values())

    def check(self) -> None:
        """Assert that nothing was lost: a tally that does not add up is a bug of ours, not of the input."""
        total = self.kept + self.num_dropped + self.num_failed
        assert total == self.num_input, f"{total} outcomes for {self.num_input} items: {self}"

    def as_dict(self) -> dict:
        return {
            "input": self.num_input,
            "kept": self.kept,
            "dropped": dict(sorted(self.dropped.items())),
            "failed": dict(sorted(self.failed.items())),
        }

    def __str__(self) -> str:
        text = f"{self.kept} kept"
        for word, reasons in (("dropped", self.dropped), ("failed", self.failed)):
            if reasons:
                listed = ", ".join(f"{reason} {count}" for reason, count in sorted(reasons.items()))
                text += f", {sum(reasons.values())} {word} ({listed})"
        return f"{text} of {self.num_input}"


class StageFolder:
    """One stage's output folder, opened for one set of settings and inputs.

    `open` writes `stage.json`; `finish` writes `manifest.json`. If the folder is already complete for the same settings and
    inputs, and no item failed, `is_complete` is true and the stage has nothing to do.
    """

    def __init__(self, path: Path, stage: str, is_complete: bool) -> None:
        self.path, self.stage, self.is_complete = path, stage, is_complete
        self.started_s = time.monotonic()

    @classmethod
    def open(
        cls, out: Path, stage: str, *, config: dict, inputs: dict[str, Path], seed: int, resume: Resume = "if-same"
    ) -> StageFolder:
        """Start or continue a stage.

        Args:
            config: the stage's resolved settings, JSON-able.
            inputs: name -> file or folder that the stage reads.
            resume: `never` refuses a folder that holds work; `if-same` continues only with equal settings, inputs and seed;
                `force` continues with the finished items in spite of a difference, which stays on record.
        Raises:
            ResumeError: the folder holds work that may not be continued; names what differs.
        """
        record = {
            "schema": STAGE_SCHEMA,
            "schema_version": VERSION,
            "stage": stage,
            "config": config,
            "seed": seed,
            "inputs": {name: {"path": str(path), "sha256": fingerprint(path)} for name, path in sorted(inputs.items())},
            "code_version": cosfly.__version__,
        }
        stage_file, manifest_file = out / "stage.json", out / "manifest.json"
        if out.exists() and not out.is_dir():
            raise StorageError("the output folder is a file", where=out, fix="choose another --out")
        if stage_file.exists() and not _holds_work(out):
            # An attempt that ended before anything was finished binds nobody to its settings.
            for name in ("stage.json", "items.jsonl", "failures.jsonl"):
                (out / name).unlink(missing_ok=True)
        elif stage_file.exists():
            _continue(out, record, resume)
        elif out.is_dir() and any(out.iterdir()):
            raise ResumeError(
                "the output folder holds files that are not cosfly's", where=out, fix="choose an empty --out"
            )
        is_complete = manifest_file.exists()
        if is_complete:
            manifest = check_schema(read_json(manifest_file), MANIFEST_SCHEMA, VERSION, manifest_file)
            if manifest["counts"]["failed"]:
                manifest_file.unlink()  # failed items are tried again; the others stand in the journal
                is_complete = False
            else:
                _check_outputs_exist(out, manifest)
        if not is_complete:
            write_json(stage_file, record)
            remove_partials(out)
        return cls(out, stage, is_complete)

    @property
    def journal(self) -> Journal:
        return Journal(self.path / "items.jsonl")

    def finish(self, outputs: Iterable[Path], tally: Tally, **extra: Any) -> None:
        """Write the manifest: the stage is complete.

        Args:
            outputs: files inside the folder; of a folder with many files, give its checksum file.
            extra: further JSON-able facts for the manifest, for instance counts.
        """
        tally.check()
        listed = [
            {"path": str(path.relative_to(self.path)), "bytes": path.stat().st_size, "sha256": sha256_file(path)}
            for path in sorted(outputs)
        ]
        seconds = round(time.monotonic() - self.started_s, 3)
        manifest = {
            "schema": MANIFEST_SCHEMA,
            "schema_version": VERSION,
            "stage": self.stage,
            "outputs": listed,
            "counts": tally.as_dict(),
            **extra,
            "seconds": seconds,
        }
        write_json(self.path / "manifest.json", manifest)
        log.info("%s: %s, %.1f s", self.stage, tally, seconds)

    def manifest(self) -> dict:
        """Read the manifest of a complete stage."""
        return check_schema(
            read_json(self.path / "manifest.json"), MANIFEST_SCHEMA, VERSION, self.path / "manifest.json"
        )


def _continue(out: Path, record: dict, resume: Resume) -> None:
    """See whether the work that stands in a folder may be continued as `record` says, and note in it what differs."""
    found = check_schema(read_json(out / "stage.json"), STAGE_SCHEMA, VERSION, out / "stage.json")
    if resume == "never":
        raise ResumeError("the folder already holds work", where=out, fix="choose another --out, or --resume if-same")
    differences = _differences(found, record)
    if differences and resume == "if-same":
        raise ResumeError(
            "the folder holds work made with other settings or inputs",
            where=out,
            got="; ".join(differences),
            fix="choose another --out, restore the setting, or --resume force to keep the finished items all the same",
        )
    if differences:
        record["resumed_with_other"] = [*found.get("resumed_with_other", []), *differences]
        (out / "manifest.json").unlink(missing_ok=True)
    elif "resumed_with_other" in found:
        record["resumed_with_other"] = found["resumed_with_other"]
    if found.get("code_version") != record["code_version"]:
        log.warning("%s: continued by version %s, begun by %s", out, record["code_version"], found.get("code_version"))


def _holds_work(out: Path) -> bool:
    """Tell whether a stage folder holds anything that was finished, and not only the records of failures."""
    if any(record["status"] != "failed" for record in Journal(out / "items.jsonl").read()):
        return True
    records = {out / name for name in ("stage.json", "items.jsonl", "failures.jsonl")}
    return any(
        path not in records
        for path in out.rglob("*")
        if path.is_file() and not any(part.endswith(".partial") for part in path.relative_to(out).parts)
    )


def _differences(found: dict, wanted: dict) -> list[str]:
    """Say which settings, inputs or seed differ, one phrase each."""
    before, after = _flat(found.get("config", {})), _flat(wanted["config"])
    changed = [
        f"{key} was {before.get(key)!r}, is {after.get(key)!r}"
        for key in sorted(before.keys() | after.keys())
        if before.get(key) != after.get(key)
    ]
    if found.get("seed") != wanted["seed"]:
        changed.append(f"seed was {found.get('seed')}, is {wanted['seed']}")
    for name in sorted(found.get("inputs", {}).keys() | wanted["inputs"].keys()):
        old, new = found.get("inputs", {}).get(name, {}), wanted["inputs"].get(name, {})
        if old.get("sha256") != new.get("sha256"):
            changed.append(f"the input {name} ({new.get('path', 'none')}) has changed")
    return changed


def _flat(config: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(config, dict) or not config:
        return {prefix: config}
    flat: dict[str, Any] = {}
    for key, value in config.items():
        flat.update(_flat(value, f"{prefix}.{key}" if prefix else str(key)))
    return flat


def _check_outputs_exist(out: Path, manifest: dict) -> None:
    for entry in manifest.get("outputs", []):
        path = inside(out, entry["path"])
        if not path.is_file() or path.stat().st_size != entry["bytes"]:
            raise VerifyError(
                "the manifest calls this stage complete, but a product is missing or has another size",
                where=path,
                expected=f"{entry['bytes']} bytes",
                fix=f"remove {out} and run the stage again",
            )
