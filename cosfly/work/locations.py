"""Folders that lie where fsspec reaches (s3://, gs://, sftp://, memory:// ...), worked on in a folder of this machine.

An input is fetched into a cache; what is here does not travel again. An output is a folder of the cache that is copied
out while a stage works: files first, then journals as they were before those files were listed, then manifests as they
were then. So what a journal out there names is there, and a manifest, the only commit, comes last. Of the other side
only this is asked: a file that was put can be listed, with its size.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import logging
import os
import re
import shutil
import socket
import threading
import time
import uuid
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast
from urllib.parse import urlsplit, urlunsplit

from pydantic import BaseModel

from cosfly.errors import CosflyError, EnvironmentMissing, InputError, ResumeError, StorageError
from cosfly.reading.files import read_bytes
from cosfly.work.folder_lock import LOCK, hold_folder
from cosfly.work.store import CHECKSUMS, DISK_FULL, inside, storage_errors, write_bytes

log = logging.getLogger(__name__)

CHAIN = re.compile(r"::(?![^\[]*\])")  # between the links of a chain, not within [::1]
HAS_NO_FOLDERS = {"s3", "s3a", "gs", "gcs", "az", "abfs", "memory"}
BATCH = 128  # files of one call, which go side by side where the library can
COPY_EVERY_S, MOST_SHARE = 10.0, 0.2  # a copy begins so often, and takes so much of the time at most
BEAT_S, STALE_S, SETTLE_S = 20.0, 120.0, 0.5  # of the mark that says who writes
MANIFEST = "manifest.json"

T = TypeVar("T")


def without_secrets(address: str) -> str:
    """Give an address without user, password, query and fragment; of a chain (`zip://x::https://...`) each link."""
    return "::".join(_plain(link) for link in CHAIN.split(address))


def _plain(link: str) -> str:
    if "://" not in link:  # a folder, or what is left of an address that is none
        return re.split("[?#]", link, maxsplit=1)[0].rpartition("@")[2]
    try:
        parts = urlsplit(link)
        host = parts.netloc.rpartition("@")[2]
    except ValueError:
        return f"{link.partition('://')[0]}://..."
    return urlunsplit((parts.scheme, host, parts.path, "", ""))


def opened(address: str) -> tuple[Any, str]:
    """Give the file system of an address, and the path in it."""
    shown = without_secrets(address)
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        fix = "pip install 'cosfly[remote]'"
        raise EnvironmentMissing("fsspec is not installed", where=shown, fix=fix) from None
    try:
        system, root = url_to_fs(address)
    except ImportError as error:
        fix = re.sub(r".*nstall ([\w.-]+) to .*", r"pip install \1", str(error))  # 'Install s3fs to access S3'
        raise EnvironmentMissing("what opens such addresses is not installed", where=shown, fix=fix) from None
    except Exception as error:  # each file system has its own; their words may hold the address
        got, expected = type(error).__name__, "what fsspec opens"
        raise InputError("no such address", where=shown, got=got, expected=expected) from None
    return system, str(root).rstrip("/")


_shown: dict[Path, str] = {}  # working folder -> address, of this process


def name_of(path: Path) -> str:
    """Give the name by which a record calls a path: what lies at a location its address, anything else itself."""
    for place in (path.absolute(), *path.absolute().parents):
        if place in _shown:
            return "/".join([_shown[place], *path.absolute().relative_to(place).parts])
    return str(path)


def path_of(name: str) -> Path:
    """Give the path that `name_of` gave a name, as far as this process works at that location."""
    for place, shown in reversed(_shown.items()):
        if f"{name}/".startswith(f"{shown}/"):
            return place / name.removeprefix(shown).lstrip("/")
    return Path(name)


class _Copy(NamedTuple):
    """A file that is the same on both sides. tag: what the other side calls its content, once it was asked."""

    size: int
    changed_ns: int
    tag: str = ""

    @classmethod
    def of(cls, path: Path, tag: str = "") -> _Copy:
        found = path.stat()
        return cls(found.st_size, found.st_mtime_ns, tag)


class _State(BaseModel):
    """What is known of a working folder. id: of the mark under which it was made or fetched."""

    id: str = ""
    files: dict[str, _Copy] = {}


class _Writer(BaseModel):
    """The mark beside a folder: who writes to it, or did last."""

    id: str
    host: str
    pid: int
    seen_s: float
    at_work: bool


class WorkingFolder:
    """A place at a location and its counterpart here, `local`; names are relative to the folders above the two."""

    def __init__(self, address: str, cache: Path, *, is_written: bool) -> None:
        self.shown, scheme = without_secrets(address).rstrip("/"), address.partition("://")[0].lower()
        if CHAIN.search(address) or scheme in ("http", "https"):
            what, fix = "commands work at no such address", "`cosfly release get` fetches a release from there"
            raise InputError(what, where=self.shown, expected="one as s3://BUCKET/FOLDER", fix=fix)
        self._system, root = opened(address)
        self._above, _, name = root.rpartition("/")
        if not self._above.strip("/") or "@" in root.split("/")[0]:
            what, expected = "not a place to work at", f"{scheme}://BUCKET/FOLDER, without a key"
            raise InputError(what, where=self.shown, expected=expected)
        self._has_folders = scheme not in HAS_NO_FOLDERS
        told = [self._system.storage_options.get(key) for key in ("host", "port", "endpoint_url", "client_kwargs")]
        told += [os.environ.get(key) for key in ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL")]
        server = f"{scheme}-{hashlib.sha256(repr(told).encode()).hexdigest()[:8]}"
        self._base = cache / ("written" if is_written else "read") / server / self._above.strip("/")
        self.local = inside(self._base, name)
        self._notes = cache / "notes" / hashlib.sha256(str(self.local).encode()).hexdigest()[:24]
        self._lock = hold_folder(self._notes)
        self._mark = f"{self._above}/.{name}.writer.json"
        self._state, self._lost = _State(), cast(CosflyError | None, None)
        if self.local.exists():
            with contextlib.suppress(InputError, ValueError):
                self._state = _State.model_validate_json(read_bytes(self._notes / "state.json"))
        self.num_sent = 0
        self._id, self._told_s = "", 0.0  # of our mark, once there is one; when it was written last
        _shown[self.local.absolute()] = self.shown

    def fetch(self, *, is_input: bool = True) -> None:
        """Make `local` what is there, of a file with its stage's records beside it; only what is new travels."""
        there = self._listed(self.local.name)
        if is_input and not there:
            raise InputError("there is nothing", where=self.shown, fix="check the address, and the bucket's name")
        if is_input and self.local.name in there:
            for name in ("stage.json", MANIFEST, CHECKSUMS):
                there |= self._listed(name)
        here = self._here()
        known = {name: (copy.size, copy.tag) for name, copy in self._state.files.items()}
        changed = {name for name, found in there.items() if name not in here or known.get(name) != found}
        wanted = sorted(changed | self._changed(here).keys() & there.keys())
        for begin in range(0, len(wanted), BATCH):
            batch = {name: inside(self._base, name) for name in wanted[begin : begin + BATCH]}
            paths = [f"{self._above}/{name}" for name in batch], [str(path) for path in batch.values()]
            for path in batch.values():
                with storage_errors(path):
                    path.parent.mkdir(parents=True, exist_ok=True)
            self._asked("cannot read", partial(self._system.get, *paths))
            self._beat()
            for name, path in batch.items():
                self._state.files[name] = got = _Copy.of(path, there[name][1])
                if got.size != there[name][0]:
                    raise StorageError("a file came with another size", where=f"{self.shown}: {name}", got=got.size)
        for name in here.keys() - there.keys():
            here[name].unlink()
        self._save()
        begun = {name.removesuffix("stage.json") for name in there if f"/{name}".endswith("/stage.json")}
        if is_input and (open_ones := sorted(name for name in begun if f"{name}{MANIFEST}" not in there)):
            log.warning("%s: not finished, as there is no %s: %s", self.shown, MANIFEST, ", ".join(open_ones)[:200])
        log.info("%s: %d files fetched, %d were here", self.shown, len(wanted), len(there) - len(wanted))

    def _listed(self, name: str) -> dict[str, tuple[int, str]]:
        """List the file of a name, or those below it: name -> size and tag."""
        top = f"{self._above}/{name}"

        def ask() -> dict[str, Any]:
            self._system.invalidate_cache()
            try:
                found = self._system.find(top, detail=True)
                return found if all(found.values()) else {top: self._system.info(top)}
            except FileNotFoundError:
                return {}

        listed = {}
        for full, info in self._asked("cannot list", ask).items():
            if info["type"] != "file" or full.endswith("/") or _is_passing(full):
                continue  # folders, links, and objects that stand for folders
            if os.path.normpath(full) != full or not f"{full}/".startswith(f"{top}/"):
                raise InputError("a name that leads elsewhere", where=self.shown, got=full, fix="remove it there")
            tag = info.get("ETag") or info.get("mtime") or info.get("created") or ""
            listed[full.removeprefix(f"{self._above}/")] = (info["size"], str(tag).strip('"'))
        return listed

    def take(self) -> None:
        """Become the one who writes there, and make `local` what is there, unless it is what is there and more."""
        found, is_ours = self._writer(), False
        if found is not None:
            is_ours, age_s = found.id == self._state.id, time.time() - found.seen_s
            got = f"process {found.pid} on {found.host}, {age_s:.0f} s ago"
            if found.at_work and not is_ours and age_s < STALE_S:
                fix = f"wait for it, or {STALE_S:.0f} s if it was killed; or choose another --out"
                raise ResumeError("another machine is at work there", where=self.shown, got=got, fix=fix)
            if found.at_work and not is_ours:
                log.warning("%s: taken over; no sign of life of %s", self.shown, got)
        self._id = self._state.id if is_ours else uuid.uuid4().hex
        self._tell()
        time.sleep(SETTLE_S)
        self._check_writer()
        if is_ours:  # nobody else wrote since: what is not there as it was sent goes anew, what is only there goes
            known, there = self._state.files, self._listed(self.local.name)
            same = {name for name, (size, _) in there.items() if name in known and known[name].size == size}
            self._state.files = {name: known[name] if name in same else _Copy(-1, 0) for name in there}
            return
        if unsent := self._changed(self._here()):
            aside = self._notes / f"aside-{time.time_ns()}"
            self.local.rename(aside)
            log.warning("%s went on elsewhere: %d files that were not sent are in %s", self.shown, len(unsent), aside)
        self._state = _State() if unsent else self._state
        self.fetch(is_input=False)
        self._state.id = self._id
        self._save()

    def _writer(self) -> _Writer | None:
        def ask() -> bytes:
            try:
                return self._system.cat_file(self._mark)
            except FileNotFoundError:
                return b""

        with contextlib.suppress(ValueError):
            return _Writer.model_validate_json(self._asked("cannot read", ask))
        return None

    def _check_writer(self) -> None:
        found = self._writer()
        if found is not None and found.id != self._id:
            got, fix = f"process {found.pid} on {found.host}", f"what was made here is in {self.local}"
            self._lost = ResumeError("another machine took over", where=self.shown, got=got, fix=fix)
        if self._lost is not None:
            raise self._lost

    def _beat(self) -> None:
        """Give a sign of life where one is due, also while many files travel."""
        if self._id and time.monotonic() - self._told_s >= BEAT_S:
            self._check_writer()
            self._tell()

    def _tell(self, *, at_work: bool = True) -> None:
        self._told_s = time.monotonic()
        mark = _Writer(id=self._id, host=socket.gethostname(), pid=os.getpid(), seen_s=time.time(), at_work=at_work)
        self._make_folders([self._mark])
        self._asked("cannot write", lambda: self._system.pipe_file(self._mark, mark.model_dump_json().encode()))

    @contextlib.contextmanager
    def at_work(self) -> Iterator[None]:
        """Copy out what is finished while the block runs, and all of it at its end, also where that is an error."""
        ended, is_done = threading.Event(), False
        thread = threading.Thread(target=self._copy_until, args=(ended,), daemon=True)
        thread.start()
        try:
            yield
            is_done = True
        finally:
            ended.set()
            thread.join()
            try:
                self._finish()
            except CosflyError as error:
                if is_done:
                    raise
                log.warning("%s", error)

    def _copy_until(self, ended: threading.Event) -> None:
        due_s, told = time.monotonic() + COPY_EVERY_S, ""
        while not ended.wait(min(COPY_EVERY_S, BEAT_S)) and self._lost is None:
            began_s = time.monotonic()
            try:
                self._beat()
                if began_s < due_s:
                    continue
                self.copy_out()
            except CosflyError as error:
                if str(error) != told:
                    told = str(error)
                    log.warning("%s; the work goes on, and is copied when that can be done", told)
            except OSError as error:  # a file that went while it was looked at
                log.debug("%s: the next copy takes it: %s", self.shown, error)
            due_s = began_s + max(COPY_EVERY_S, (time.monotonic() - began_s) / MOST_SHARE)

    def _finish(self) -> None:
        """Copy what is left, then compare the sizes of both sides; what came whole is the libraries' to see."""
        self._check_writer()
        self.copy_out()
        sent, there = self._state.files, self._listed(self.local.name)
        whole = {name for name, (size, _) in there.items() if name in sent and sent[name].size == size}
        self._state.files = {name: sent[name]._replace(tag=there[name][1]) for name in whole}
        self._save()
        if wrong := ", ".join(sorted(sent.keys() - whole)):
            fix = f"run the same command again; all of it is in {self.local}"
            raise StorageError("not there as it was sent", where=self.shown, got=wrong[:200], fix=fix)
        self._tell(at_work=False)
        log.info("%s: %d files sent, and compared", self.shown, self.num_sent)

    def copy_out(self) -> None:
        """Send what has changed. Journals and manifests are taken first and go last."""
        begun = self._here()
        manifests = {name: path for name, path in begun.items() if name.endswith(f"/{MANIFEST}")}
        journals = self._changed({name: path for name, path in begun.items() if name.endswith(".jsonl")})
        late = self._set_aside(journals | manifests)
        here = self._here()
        files = self._changed({name: path for name, path in here.items() if not _is_late(name)})
        gone = self._state.files.keys() - here.keys() - late.keys()
        touched = {str(place) for name in (*files, *journals, *gone) for place in Path(name).parents}
        self._remove({f"{place}/{MANIFEST}" for place in touched} | {name for name in gone if _is_late(name)})
        self._send(files)
        self._send({name: late[name] for name in journals})
        self._remove(gone)
        self._send(self._changed({name: late[name] for name in manifests}))
        self._save()

    def _set_aside(self, files: Mapping[str, Path]) -> dict[str, Path]:
        """Copy files as they are now, times too."""
        copies = {name: self._notes / "late" / str(number) for number, name in enumerate(files)}
        with storage_errors(self._notes):
            (self._notes / "late").mkdir(exist_ok=True)
            for name, copy in copies.items():
                shutil.copy2(files[name], copy)
        return copies

    def _here(self) -> dict[str, Path]:
        """List the files here, as `_listed` does; a file goes with those of its stem."""
        found = self.local.rglob("*") if self.local.is_dir() else self._base.glob(f"{glob.escape(self.local.stem)}.*")
        here = {path.relative_to(self._base).as_posix(): path for path in found if not path.is_symlink()}
        return {
            name: path for name, path in here.items() if path.is_file() and not any(map(_is_passing, Path(name).parts))
        }

    def _changed(self, files: Mapping[str, Path]) -> dict[str, Path]:
        """Give those that are not there as they are here."""
        known, changed = self._state.files, dict[str, Path]()
        for name, path in files.items():
            with contextlib.suppress(FileNotFoundError):
                if name not in known or known[name][:2] != _Copy.of(path)[:2]:
                    changed[name] = path
        return changed

    def _send(self, files: Mapping[str, Path]) -> None:
        """Send files: name -> the file with its bytes."""
        names = sorted(name for name, path in files.items() if path.is_file())
        for begin in range(0, len(names), BATCH):
            batch = names[begin : begin + BATCH]
            copies = {name: _Copy.of(files[name]) for name in batch}
            paths = [str(files[name]) for name in batch], [f"{self._above}/{name}" for name in batch]
            self._make_folders(paths[1])
            self._asked("cannot write", partial(self._system.put, *paths))
            self._beat()
            self._state.files |= copies
            self.num_sent += len(batch)

    def _make_folders(self, paths: Collection[str]) -> None:
        for folder in sorted({path.rpartition("/")[0] for path in paths} if self._has_folders else ()):
            self._asked("cannot write", partial(self._system.makedirs, folder, exist_ok=True))

    def _remove(self, names: Collection[str]) -> None:
        names = self._state.files.keys() & names

        def remove() -> None:
            with contextlib.suppress(FileNotFoundError):
                self._system.rm([f"{self._above}/{name}" for name in names])

        if names:
            self._asked("cannot remove", remove)
        for name in names:
            del self._state.files[name]

    def _save(self) -> None:
        write_bytes(self._notes / "state.json", self._state.model_dump_json().encode())

    def _asked(self, what: str, ask: Callable[[], T]) -> T:
        """Ask, and tell in our words of what breaks: those of libraries may hold a key. They try again themselves."""
        try:
            return ask()
        except Exception as error:  # every file system has its own
            why = error
        told = getattr(why.__cause__ or why, "response", None)  # of S3: with a code
        code = told.get("Error", {}).get("Code") if isinstance(told, dict) else None
        fix = f"run the same command again; finished work stays, in {self.local}"
        if isinstance(why, PermissionError) or "Credentials" in type(why).__name__:
            fix = f"check the key (of S3: AWS_ACCESS_KEY_ID, ~/.aws/credentials) and what it may do, then {fix}"
        elif isinstance(why, FileNotFoundError):
            fix = f"check that there is such a bucket or folder, then {fix}"
        elif getattr(why, "errno", 0) in DISK_FULL:
            what, fix = "the disk of this machine is full", f"free some space, or choose another --cache, then {fix}"
        raise StorageError(what, where=self.shown, got=str(code or type(why).__name__)[:60], fix=fix) from None


def _is_late(name: str) -> bool:
    """Tell whether a file says what else there is."""
    return name.endswith((".jsonl", f"/{MANIFEST}"))


def _is_passing(name: str) -> bool:
    """Tell whether a name is one of a moment: a lock, a temporary name, the mark of a writer."""
    name = name.rpartition("/")[2]
    return name == LOCK or (name.startswith(".") and name.endswith((".partial", ".writer.json")))
