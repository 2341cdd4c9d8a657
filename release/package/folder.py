"""The folder that is published: finished shards under their names, and the records beside them."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cosfly.errors import VerifyError
from cosfly.reading.files import sha256_file
from cosfly.work.store import write_bytes, write_checksums
from release.card.croissant import CROISSANT, render_croissant
from release.card.render import render_card
from release.columns import SplitName
from release.record import ReleaseRecord, Shard, content_digest, shard_path, write_record

DATASET, PARTS = "dataset", "parts"  # in the folder of the stage: what gets published, and shards on the way there


@dataclass(frozen=True)
class Finished:
    """A shard that is written, and where it stands until the release has its name."""

    split: SplitName
    path: Path
    rows: int
    bytes: int
    sha256: str


def check_parts(shards: Sequence[Finished], out: Path) -> None:
    """See that what was finished, also by an earlier run, is there; `out` is the folder of the stage.

    Raises:
        VerifyError: it is not.
    """
    for shard in shards:
        if not shard.path.is_file() or shard.path.stat().st_size != shard.bytes:
            raise VerifyError(
                "a shard that was finished before is missing or has another size", where=shard.path,
                expected=f"{shard.bytes} bytes", fix=f"remove {out} and run again",
            )  # fmt: skip


def name_shards(finished: Sequence[Finished], folder: Path) -> list[Shard]:
    """Put shards under their names in the release: linked, so that no byte moves and a kill costs nothing."""
    digest = content_digest((shard.split, shard.sha256) for shard in finished)
    counts, numbers = Counter(shard.split for shard in finished), Counter[str]()
    (folder / "data").mkdir()
    shards = []
    for shard in finished:
        path = shard_path(shard.split, digest, numbers[shard.split], counts[shard.split])
        numbers[shard.split] += 1
        try:
            os.link(shard.path, folder / path)
        except OSError:  # the file system has no links
            shutil.copyfile(shard.path, folder / path)
        shards.append(Shard(path=path, split=shard.split, rows=shard.rows, bytes=shard.bytes, sha256=shard.sha256))
    return shards


def write_records(folder: Path, record: ReleaseRecord) -> None:
    """Write release.json, the card, croissant.json and the checksums beside the shards."""
    write_record(folder / "release.json", record)
    write_bytes(folder / "README.md", render_card(record).encode())
    write_bytes(folder / CROISSANT, render_croissant(record).encode())
    digests = {shard.path: shard.sha256 for shard in record.shards}
    for name in ("release.json", "README.md", CROISSANT):
        digests[name] = sha256_file(folder / name)
    write_checksums(folder, digests)
