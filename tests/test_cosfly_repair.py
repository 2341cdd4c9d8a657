"""Journals that hold what cannot be used: each says which line, and `--repair` sets it aside."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from cosfly.app.repair import repair
from cosfly.chat.answers import Answer, AnswerBook
from cosfly.cli import app
from cosfly.errors import InputError
from cosfly.work.journal import Journal
from cosfly.work.stage_folder import StageFolder
from specimens import make_playback_tree

ANSWER = {
    "key": "k", "sample_id": "a_ORI_frame_00004", "purpose": "free/0", "model": "m", "text": "t",
    "usage": {"prompt_tokens": 10, "completion_tokens": 2},
    "structured": "plain", "finish_reason": "stop", "latency_s": 1.0, "time": 5.0,
}  # fmt: skip
# Lines of answers that are whole and cannot be used; the fuzzer knows more of them. And the field that is named.
BROKEN_ANSWERS = [
    (ANSWER | {"usage": {"prompt_tokens": 10, "completion_tokens": 10**30}}, "usage.completion_tokens"),
    ({name: value for name, value in ANSWER.items() if name != "key"}, "key"),
    ({"totals": {"answers": 2, "prompt_tokens": -1, "completion_tokens": 4}}, "totals.prompt_tokens"),
]


def test_a_journal_of_answers_says_which_line_cannot_be_used_and_repair_sets_it_aside(tmp_path):
    for number, (record, field) in enumerate(BROKEN_ANSWERS):
        folder = tmp_path / str(number) / "answers"
        with Journal(folder / "a_ORI.jsonl") as journal:
            for line in (ANSWER, record, ANSWER | {"key": "l"}):
                journal.append(line)
        words = rf"a_ORI.jsonl:2: a line that cannot be used; got {field}: .*--repair"
        with pytest.raises(InputError, match=words) as caught:
            AnswerBook(folder)
        assert len(str(caught.value)) < 1000
        assert repair(folder.parent) == 1
        assert len((folder / "a_ORI.jsonl.aside").read_bytes().splitlines()) == 1
        with AnswerBook(folder) as book:
            assert book.totals == {"answers": 2, "prompt_tokens": 20, "completion_tokens": 4}
            assert book.get("a_ORI", "l") == Answer(**ANSWER | {"key": "l"})
        assert repair(folder.parent) == 0


def test_totals_that_have_counted_a_broken_answer_are_counted_anew(tmp_path):
    with Journal(tmp_path / "answers/a_ORI.jsonl") as journal:
        journal.append(ANSWER)
        journal.append(ANSWER | {"key": "l", "usage": {"prompt_tokens": 10**12, "completion_tokens": 1}})
        journal.append({"totals": {"answers": 2, "prompt_tokens": 10**12 + 10, "completion_tokens": 3}})
    with AnswerBook(tmp_path / "answers") as book, pytest.raises(InputError, match=":2: "):
        book.get("a_ORI", "k")
    assert repair(tmp_path) == 1
    assert AnswerBook(tmp_path / "answers").totals == {"answers": 1, "prompt_tokens": 10, "completion_tokens": 2}


def test_a_number_that_no_file_may_hold_makes_a_line_a_damaged_one(tmp_path):
    with Journal(tmp_path / "answers/a_ORI.jsonl") as journal:
        journal.append(ANSWER | {"usage": {"prompt_tokens": 10**400, "completion_tokens": 1}})
        journal.append(ANSWER | {"key": "l"})
    with AnswerBook(tmp_path / "answers") as book:
        assert book.totals["answers"] == 1
        assert book.get("a_ORI", "k") is None  # it is asked again
    assert repair(tmp_path) == 1


def test_damaged_lines_are_set_aside_too_and_links_are_left_alone(tmp_path):
    stage = tmp_path / "run/one town/plan"
    with Journal(stage / "items.jsonl") as journal:
        journal.append({"id": "a", "status": "kept"})
        journal.append({"id": "b", "status": "kept"})
    lines = (stage / "items.jsonl").read_bytes().splitlines(keepends=True)
    (stage / "items.jsonl").write_bytes(lines[0] + b"garbage\n" + lines[1] + b"0123456789abcdef {torn")
    elsewhere = tmp_path / "elsewhere.jsonl"
    elsewhere.write_bytes(b"garbage\n")
    (tmp_path / "run/render").mkdir()
    (tmp_path / "run/render/items.jsonl").symlink_to(elsewhere)
    private = tmp_path / "private/plan/items.jsonl"
    private.parent.mkdir(parents=True)
    private.write_bytes(b"garbage\n")
    (tmp_path / "run/another town").symlink_to(tmp_path / "private")
    (tmp_path / "run/render/answers").symlink_to(tmp_path)
    (tmp_path / "named").symlink_to(tmp_path / "run")
    assert repair(tmp_path / "named") == 2, "the folder that is named may be a link"
    assert private.read_bytes() == b"garbage\n"
    assert (stage / "items.jsonl").read_bytes() == b"".join(lines)
    assert (stage / "items.jsonl.aside").read_bytes() == b"garbage\n0123456789abcdef {torn\n"
    assert elsewhere.read_bytes() == b"garbage\n"
    assert repair(tmp_path / "nowhere") == 0


@pytest.mark.parametrize("record", [{}, {"id": "a", "status": "dropped"}], ids=["empty", "without a reason"])
def test_a_journal_of_items_says_which_line_cannot_be_used(tmp_path, record):
    with Journal(tmp_path / "items.jsonl") as journal:
        journal.append({"id": "a", "status": "kept"})
        journal.append(record)
    with pytest.raises(InputError, match=r"items.jsonl:2: a line that cannot be used; .*--repair"):
        list(StageFolder(tmp_path, "plan", False).items())
    assert repair(tmp_path) == 1
    assert [item.id for item in StageFolder(tmp_path, "plan", False).items()] == ["a"]


def test_the_same_command_with_repair_goes_on_and_opens_a_finished_stage(tmp_path):
    tree, out = make_playback_tree(tmp_path / "tree", 1, 14, with_augmented=False), tmp_path / "out"
    command = ["caption", "--data", str(tree), "--out", str(out), "--set", "caption.window.stride=3"]
    assert CliRunner().invoke(app, command).exit_code == 0
    manifest, whole = (out / "manifest.json").read_bytes(), (out / "captions.jsonl").read_bytes()
    assert CliRunner().invoke(app, [*command, "--repair"]).exit_code == 0
    assert (out / "manifest.json").read_bytes() == manifest  # nothing to repair
    with Journal(out / "items.jsonl") as journal:
        journal.append({"id": "a"})
    (out / "manifest.json").unlink()
    result = CliRunner().invoke(app, command)
    assert isinstance(result.exception, InputError), result.output
    assert "items.jsonl:2: a line that cannot be used" in str(result.exception)
    (out / "manifest.json").write_bytes(manifest)
    result = CliRunner().invoke(app, [*command, "--repair"])
    assert result.exit_code == 0, result.output
    assert "1 lines set aside" in result.output
    assert (out / "captions.jsonl").read_bytes() == whole
    assert (out / "manifest.json").read_bytes() != manifest  # it was opened again
