"""The writing of shards: whatever the size of the writes and whatever the file system can, the file holds them and the
digest is theirs."""

from __future__ import annotations

import errno
import hashlib
import os

import pytest

from cosfly.work.store import atomic_file
from release.package import rows
from release.package.rows import BLOCK, NUM_BLOCKS, HashedFile


@pytest.mark.parametrize("direct", [rows.DIRECT, 0], ids=["past the page cache", "through it"])
@pytest.mark.parametrize(
    "sizes",
    [[], [1], [BLOCK], [BLOCK - 1, 1, 1], [3, 4096, 2 * BLOCK + 5], [BLOCK // 3] * (3 * NUM_BLOCKS + 1)],
    ids=str,
)
def test_a_file_holds_what_was_written_and_the_digest_is_of_that(tmp_path, monkeypatch, sizes, direct):
    monkeypatch.setattr(rows, "DIRECT", direct)
    parts = [os.urandom(size) for size in sizes]
    with atomic_file(tmp_path / "shard") as file, HashedFile(file) as hashed:
        for part in parts:
            assert hashed.write(part) == len(part)
        assert hashed.tell() == sum(sizes)
        size, digest = hashed.finish()
    data = b"".join(parts)
    assert (tmp_path / "shard").read_bytes() == data
    assert (size, digest) == (len(data), hashlib.sha256(data).hexdigest())


def test_a_file_system_that_asks_for_more_than_whole_pages_gets_the_same_bytes(tmp_path, monkeypatch):
    write, set_direct, told, refused = os.write, rows._set_direct, [], []

    def told_direct(number, wanted):
        told.append(wanted)
        return set_direct(number, wanted)

    def picky(number, data):
        if told[-1]:
            refused.append(len(data))
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        return write(number, data)

    monkeypatch.setattr(rows, "_set_direct", told_direct)
    data = os.urandom(BLOCK + 7)
    with atomic_file(tmp_path / "shard") as file, HashedFile(file) as hashed:
        if not hashed._is_direct:
            pytest.skip("this file system writes through the page cache alone")
        monkeypatch.setattr(rows.os, "write", picky)
        hashed.write(data)
        hashed.finish()
    assert refused == [BLOCK]
    assert (tmp_path / "shard").read_bytes() == data


def test_a_full_disk_is_told_by_a_later_call():
    with open("/dev/full", "wb", buffering=0) as file, HashedFile(file) as hashed:
        hashed.write(bytes(BLOCK))
        with pytest.raises(OSError, match="No space left"):
            hashed.finish()
