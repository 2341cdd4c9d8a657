"""A release to a repository of a hub. Nothing travels before it is verified, and nothing without being told to.

The token is the library's own affair (`HF_TOKEN`, or `hf auth login`): nothing here reads, keeps or prints it.
"""

from __future__ import annotations

import contextlib
import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from cosfly.errors import ConfigError, EnvironmentMissing, InputError, TeacherError, VerifyError
from cosfly.products.shown_captions import CaptionReader
from cosfly.work.locations import without_secrets
from cosfly.work.store import CHECKSUMS, read_checksums
from cosfly.work.worker_pool import Watch
from release.export.source import SHARD_NAME, open_release
from release.sign import SIGNATURE, is_signed
from release.verify.findings import Verified
from release.verify.verify import Level, verify

REPO = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9_][\w.-]{0,95}", re.ASCII)
MOST_FILE_BYTES = 50_000_000_000  # the hub's limit of a file
MOST_ENTRIES = 10_000  # and of a folder
FILES_A_COMMIT = 50  # it recommends less than 100
log = logging.getLogger(__name__)

LOGIN = "log in with `hf auth login`, or set HF_TOKEN to a token that may write"


@dataclass(frozen=True)
class Parcel:
    """What goes, and what does not. files: name -> bytes, shards first; stays: files of the folder that are not of the
    release.
    """

    folder: Path
    files: dict[str, int]
    digests: dict[str, str]
    stays: list[str]

    @property
    def num_bytes(self) -> int:
        return sum(self.files.values())


def check_name(repo: str) -> None:
    """Check that a repository has a name that a hub takes."""
    if not REPO.fullmatch(repo) or ".." in repo or "--" in repo or repo.endswith(".git"):
        raise ConfigError(
            "not a name of a repository",
            where="--repo",
            got=repo,
            expected="OWNER/NAME of letters, digits, '-', '_' and '.'",
        )


def pack(folder: Path) -> Parcel:
    """Tell what of a release folder would go to a repository."""
    folder = open_release(folder).folder
    digests = read_checksums(folder)
    names = [*sorted(digests, key=lambda name: (SHARD_NAME.fullmatch(name) is None, name)), CHECKSUMS]
    names += [SIGNATURE] if is_signed(folder) else []
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        raise InputError("not a whole release", where=folder, got=f"missing: {', '.join(missing)[:200]}")
    files = {name: (folder / name).stat().st_size for name in names}
    large = [f"{name} ({size / 1e9:.1f} GB)" for name, size in files.items() if size > MOST_FILE_BYTES]
    if large or len(files) > MOST_ENTRIES:
        raise InputError(
            "a hub takes no such release", where=folder, got=", ".join(large)[:300] or f"{len(files):,} files",
            expected=f"files of at most {MOST_FILE_BYTES / 1e9:.0f} GB, at most {MOST_ENTRIES:,} of them",
            fix="build it again with another release.shard_mb",
        )  # fmt: skip
    found = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())
    return Parcel(folder, files, digests, sorted(set(found) - set(names)))


def verified(parcel: Parcel, level: Level, *, reader: CaptionReader, workers: int, watch: Watch) -> Verified:
    """Verify what would go."""
    report = verify(parcel.folder, level=level, workers=workers, watch=watch, reader=reader)
    if not report.is_ok:
        raise VerifyError(
            "this release does not verify, and does not go out", where=parcel.folder, got=str(report)[:1000],
            fix="mend it: `cosfly release verify` says what is wrong",
        )  # fmt: skip
    return report


def push(parcel: Parcel, repo: str, *, private: bool = True) -> str:
    """Send a parcel to a data-set repository, which is made if there is none: the shards first, the card and the
    records last.

    What is there already, with the same sha256, is not sent again, so the same command goes on after a break.

    Args:
        repo: `OWNER/NAME`. private: of a repository that is made; one that is there stays as it is.
    Returns:
        the repository's address.
    """
    try:
        from huggingface_hub import CommitOperationAdd, HfApi, constants
    except ImportError:
        raise EnvironmentMissing(
            "huggingface_hub is not installed", fix="pip install 'cosfly[remote]' huggingface_hub"
        ) from None
    api = HfApi()
    with _hub_errors(repo, constants.ENDPOINT):
        owner = api.whoami()["name"]
        address = str(api.create_repo(repo, repo_type="dataset", private=private, exist_ok=True))
        there = {
            entry.rfilename: entry.lfs.sha256 if entry.lfs else None
            for entry in api.dataset_info(repo, files_metadata=True).siblings or []
        }
        names = [name for name in parcel.files if there.get(name) != parcel.digests.get(name, "")]
        shards = [name for name in names if SHARD_NAME.fullmatch(name)]
        records = [name for name in names if name not in shards]
        log.info(
            "push as %s: %d of %d files are there already", owner, len(parcel.files) - len(names), len(parcel.files)
        )
        parts = [shards[begin : begin + FILES_A_COMMIT] for begin in range(0, len(shards), FILES_A_COMMIT)]
        for part in [*parts, records]:  # a card never names a shard that is not there yet
            operations = [CommitOperationAdd(name, str(parcel.folder / name)) for name in part]
            what = "records and card" if part is records else f"{len(part)} shards"
            api.create_commit(repo, operations, repo_type="dataset", commit_message=f"A cosfly release: {what}")
            log.info("push: %s arrived", what)  # the library shows the bytes meanwhile
        arrived = {entry.rfilename: entry.size for entry in api.dataset_info(repo, files_metadata=True).siblings or []}
    wrong = [name for name, size in parcel.files.items() if arrived.get(name) != size]
    if wrong:
        raise TeacherError(
            "the hub does not show what was sent", where=repo, got=", ".join(wrong)[:300],
            expected="the files with their sizes", fix="run the same command again",
        )  # fmt: skip
    if others := [name for name in arrived if SHARD_NAME.fullmatch(name) and name not in parcel.files]:
        log.warning(
            "%s: %d shards of another release are still there, which the card does not name: %s; "
            "remove them on the hub if nobody needs them",
            repo, len(others), ", ".join(sorted(others)[:3]),
        )  # fmt: skip
    return without_secrets(address)


@contextlib.contextmanager
def _hub_errors(repo: str, endpoint: str) -> Iterator[None]:
    """Turn what the library raises of a hub into one line; none of these texts holds the token."""
    from huggingface_hub import errors

    # HTTPError of whichever client this version of the library uses
    client: type[Exception] = errors.HfHubHTTPError.__bases__[0]  # type: ignore[assignment]
    where = f"{without_secrets(endpoint)}: {repo}"
    try:
        yield
    except errors.HFValidationError as error:
        raise ConfigError("not a name of a repository", got=repo, expected="OWNER/NAME", fix=str(error)[:200]) from None
    except errors.OfflineModeIsEnabled:
        raise TeacherError("the library is told to stay offline", where=where, fix="unset HF_HUB_OFFLINE") from None
    except errors.LocalTokenNotFoundError:
        raise TeacherError("nobody is logged in", where=where, fix=LOGIN) from None
    except errors.HfHubHTTPError as error:
        status = error.response.status_code if error.response is not None else 0
        fix = LOGIN if status in (401, 403) else "run the same command again; what arrived is not sent twice"
        raise TeacherError("the hub refuses", where=where, got=f"HTTP {status}", fix=fix) from None
    except (client, ConnectionError, TimeoutError) as error:
        raise TeacherError(
            "the hub cannot be reached, or broke off", where=where, got=type(error).__name__,
            fix="run the same command again; what arrived is not sent twice",
        ) from None  # fmt: skip
    except ValueError as error:
        raise TeacherError(
            "the hub does not take it, or does not speak its protocol", where=where, got=str(error)[:200]
        ) from None
