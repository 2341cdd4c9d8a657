"""Signatures of releases: keys of openssl and ssh-keygen, what a forger can do, and what a fetched release still
tells."""

from __future__ import annotations

import base64
import logging
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from typer.testing import CliRunner

pytest.importorskip("cryptography")

from cosfly.cli import app
from cosfly.errors import InputError, VerifyError
from cosfly.reading.documents import read_json
from cosfly.work.config import build as build_config
from cosfly.work.store import CHECKSUMS, read_checksums, sha256_bytes, write_checksums, write_json
from release.sign import PASSPHRASE, SIGNATURE, read_private_key, read_public_key, sign
from release.transfer.push import pack
from release.transfer.stage import Selection
from release.transfer.stage import run as get
from release.verify.findings import Verified
from release.verify.verify import verify

SECRET = "correct horse"


@pytest.fixture(scope="module")
def keys(tmp_path_factory) -> Path:
    """Pairs as users make them: NAME and NAME.pub, of openssl and of ssh-keygen, plain and encrypted, and one of
    RSA."""
    folder = tmp_path_factory.mktemp("keys")
    for tool in ("openssl", "ssh-keygen"):
        if shutil.which(tool) is None:
            pytest.skip(f"no {tool}")
    lock = ["-aes256", "-pass", f"pass:{SECRET}"]
    for name, kind, more in (("pem", "ed25519", []), ("pem_locked", "ed25519", lock), ("rsa", "rsa", [])):
        call("openssl", "genpkey", "-algorithm", kind, *more, "-out", name, cwd=folder)
        unlock = ["-passin", f"pass:{SECRET}"] if more else []
        call("openssl", "pkey", "-in", name, *unlock, "-pubout", "-out", f"{name}.pub", cwd=folder)
    for name, word in (("ssh", ""), ("ssh_locked", SECRET)):
        call("ssh-keygen", "-q", "-t", "ed25519", "-N", word, "-C", "me", "-f", name, cwd=folder)
    return folder


def call(*command: str, cwd: Path) -> None:
    subprocess.run(command, cwd=cwd, check=True, capture_output=True)


@pytest.fixture
def dataset(dataset, tmp_path) -> Path:
    """A copy that may be changed."""
    return shutil.copytree(dataset, tmp_path / "dataset")


def findings(dataset: Path, key: Path | None, level: str = "structure") -> set[str]:
    return errors(verify(dataset, level=level, public_key=None if key is None else read_public_key(key)))


def errors(report: Verified) -> set[str]:
    return {issue.code for issue in report.issues if issue.severity == "error"}


def test_what_both_tools_write_signs_and_verifies(keys, dataset, monkeypatch):
    monkeypatch.setenv(PASSPHRASE, SECRET)
    for name in ("pem", "pem_locked", "ssh", "ssh_locked"):
        sign(dataset, read_private_key(keys / name))
        assert findings(dataset, keys / f"{name}.pub") == set(), name
        for other in {"pem", "ssh"} - {name}:
            assert findings(dataset, keys / f"{other}.pub") == {"signature"}, (name, other)


def test_openssl_alone_checks_a_signature(keys, dataset, tmp_path):
    sign(dataset, read_private_key(keys / "pem"))
    (tmp_path / "sig").write_bytes(base64.b64decode(read_json(dataset / SIGNATURE)["signature"]))
    call(
        "openssl", "pkeyutl", "-verify", "-pubin", "-inkey", str(keys / "pem.pub"), "-rawin",
        "-in", CHECKSUMS, "-sigfile", str(tmp_path / "sig"), cwd=dataset,
    )  # fmt: skip


def test_keys_that_will_not_do_are_named_and_never_quoted(keys, monkeypatch, tmp_path, caplog):
    monkeypatch.delenv(PASSPHRASE, raising=False)
    (tmp_path / "junk").write_bytes(b"-----BEGIN PRIVATE KEY-----\nSECRETSECRET\n-----END PRIVATE KEY-----\n")
    (tmp_path / "empty").write_bytes(b"")
    cases = [
        (read_private_key, keys / "rsa", "another kind"), (read_public_key, keys / "rsa.pub", "another kind"),
        (read_private_key, keys / "pem.pub", "other key of the pair"),
        (read_private_key, keys / "ssh.pub", "other key of the pair"),
        (read_public_key, keys / "pem", "other key of the pair"),
        (read_public_key, keys / "ssh", "other key of the pair"),
        (read_private_key, keys / "pem_locked", PASSPHRASE), (read_private_key, keys / "ssh_locked", PASSPHRASE),
        (read_private_key, tmp_path / "junk", "cannot read"), (read_public_key, tmp_path / "junk", "other key"),
        (read_private_key, tmp_path / "empty", "cannot read"), (read_public_key, tmp_path / "empty", "cannot read"),
        (read_private_key, tmp_path / "none", "none"), (read_public_key, tmp_path, "a folder"),
    ]  # fmt: skip
    for read, path, words in cases:
        with pytest.raises(InputError) as caught:
            read(path)
        assert words in str(caught.value), path
        assert "SECRET" not in str(caught.value).replace(PASSPHRASE, "")
    monkeypatch.setenv(PASSPHRASE, "wrong horse")
    for name in ("pem_locked", "ssh_locked"):
        with pytest.raises(InputError, match="does not open") as caught:
            read_private_key(keys / name)
        assert "horse" not in str(caught.value) + caplog.text


def test_a_private_key_that_others_may_read_is_warned_of(keys, tmp_path, caplog):
    shutil.copy(keys / "pem", tmp_path / "key")
    for mode, is_open in ((0o600, False), (0o640, True), (0o644, True)):
        os.chmod(tmp_path / "key", mode)
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            read_private_key(tmp_path / "key")
        assert ("chmod 600" in caplog.text) is is_open


def test_a_forger_who_makes_every_checksum_right_is_found(keys, dataset, tmp_path):
    """What was changed, and what level structure says then, with the key and without."""
    sign(dataset, read_private_key(keys / "pem"))
    shard = next((dataset / "data").glob("*.parquet"))

    def reseal(folder: Path) -> None:
        digests = read_checksums(folder)
        write_checksums(folder, {name: sha256_bytes((folder / name).read_bytes()) for name in digests})

    def change_card(folder: Path) -> None:
        (folder / "README.md").write_text("another card")
        reseal(folder)

    def change_shard(folder: Path) -> None:  # of the same size, and under the old list
        path = folder / "data" / shard.name
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(bytes(data))

    def of_own_key(folder: Path) -> None:
        change_card(folder)
        sign(folder, read_private_key(keys / "ssh"))

    def claim_key(folder: Path) -> None:  # a signature of his own under the name of the maker's key
        maker = read_json(folder / SIGNATURE)["public_key"]
        of_own_key(folder)
        write_json(folder / SIGNATURE, read_json(folder / SIGNATURE) | {"public_key": maker})

    changes = {
        "nothing": (lambda folder: None, set()),
        "card": (change_card, {"signature", "card"}),
        "shard": (change_shard, {"checksum"}),
        "own key": (of_own_key, {"signature", "card"}),
        "claimed key": (claim_key, {"signature", "card"}),
        "no signature": (lambda folder: (folder / SIGNATURE).unlink(), {"signature"}),
        "not JSON": (lambda folder: (folder / SIGNATURE).write_bytes(b"{"), {"signature"}),
        "no base64": (lambda f: write_json(f / SIGNATURE, read_json(f / SIGNATURE) | {"signature": "A" * 87 + "!"}),
         {"signature"}),
        "list gone": (lambda folder: (folder / CHECKSUMS).unlink(), {"signature", "checksum", "missing"}),
    }  # fmt: skip
    for name, (change, wanted) in changes.items():
        folder = shutil.copytree(dataset, tmp_path / name.replace(" ", "_"))
        change(folder)
        assert findings(folder, keys / "pem.pub") - {"digest"} == wanted, name


def test_the_report_tells_of_a_signature_that_was_not_checked(keys, dataset):
    assert "signature: not signed" in verify(dataset, level="structure").facts
    sign(dataset, read_private_key(keys / "pem"))
    report = verify(dataset, level="structure")
    assert report.is_ok
    assert any("signed, the key was not checked" in fact for fact in report.facts)


def test_nothing_is_signed_that_is_not_what_its_list_says(keys, dataset):
    (dataset / "README.md").write_text("another card")
    with pytest.raises(VerifyError, match=r"README\.md"):
        sign(dataset, read_private_key(keys / "pem"))
    assert not (dataset / SIGNATURE).exists()


def test_a_signature_travels_with_the_whole_release_and_not_with_a_part(keys, dataset, tmp_path):
    sign(dataset, read_private_key(keys / "pem"))
    assert SIGNATURE in pack(dataset).files
    whole = get(Selection(), str(dataset), tmp_path / "whole")
    assert findings(whole, keys / "pem.pub") == set()
    part = get(build_config(Selection, {"splits": ["train"]}, "test"), str(dataset), tmp_path / "part")
    report = verify(part, level="structure", public_key=read_public_key(keys / "pem.pub"))
    assert errors(report) == {"signature"}
    assert "part" in str(report)
    assert findings(part, None) == set()


def test_the_commands(keys, dataset, tmp_path):
    run = CliRunner().invoke
    common = [str(dataset), "--level", "structure", "--workers", "0"]
    made = run(app, ["release", "sign", *common, "--key", str(keys / "ssh")])
    assert made.exit_code == 0, made.output
    assert made.output.rstrip().endswith(SIGNATURE)
    good = run(app, ["release", "verify", *common, "--public-key", str(keys / "ssh.pub")])
    assert good.exit_code == 0, good.output
    assert "signed with the key that was given" in good.output
    bad = run(app, ["release", "verify", *common, "--public-key", str(keys / "pem.pub")])
    assert bad.exit_code == 1
    assert "another key" in bad.output
    (dataset / "README.md").write_text("another card")
    refused = run(app, ["release", "sign", *common, "--key", str(keys / "ssh")])
    assert refused.exit_code == 1
    assert "nothing was signed" in refused.output
    tree = run(app, ["release", "verify", str(tmp_path), "--public-key", str(keys / "ssh.pub")])
    assert tree.exit_code == 1
