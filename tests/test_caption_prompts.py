"""Prompts of somebody's own: exported, checked line by line, asked with, kept beside the captions, and followed by
students."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from commands import invoke
from specimens_distill import prepared
from teacher_server import TeacherServer

from caption.run.stage import run
from caption.schema import CaptionConfig
from caption.teachers.prompt_files import PROMPTS, export_prompts, own_prompts, shipped_prompts
from cosfly.chat.student_chat import write_taught
from cosfly.errors import ConfigError, ResumeError
from cosfly.products.captions import OWN_PROMPTS, read_captions
from distill.schema import open_split
from distill.training.stage import taught_by
from specimens import make_playback_tree

OWN_LINE = "Costs $$5 & 100 %: you speak as a coast guard."


def export(folder: Path) -> Path:
    export_prompts(folder, shipped_prompts())
    return folder


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    return make_playback_tree(tmp_path_factory.mktemp("tree"), 3, 14)


@pytest.fixture
def mine(tmp_path) -> Path:
    """Prompts with another system text and another order of lines, which say the same things."""
    folder = export(tmp_path / "mine")
    for name in ("system_en", "system_zh", "system_slots_en", "system_prose_en"):
        with (folder / f"{name}.txt").open("a", encoding="utf-8") as file:
            file.write(OWN_LINE + "\n")
    edit(folder / "user_en.txt", "Velocity: [$speed]", "SPEED [${speed}] 100 % $$1")
    return folder


def test_what_is_exported_is_what_ships(tmp_path):
    folder = tmp_path / "mine"
    result = invoke("caption prompts --export", folder)
    assert result.exit_code == 0, result.output
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == {p.name: p.read_bytes() for p in PROMPTS.glob("*.txt")}
    assert invoke("caption prompts --check", folder).exit_code == 0
    (folder / "user_zh.txt").unlink()  # as after a kill
    assert invoke("caption prompts --export", folder).exit_code == 0
    for name in ("user_en", "system_zh"):
        edit(folder / f"{name}.txt", "the" if name == "user_en" else "1", "2")
    (folder / "user_zh.txt").unlink()
    again = invoke("caption prompts --export", folder)
    assert not (folder / "user_zh.txt").exists()
    assert isinstance(again.exception, ConfigError)
    assert "got system_zh.txt, user_en.txt" in str(again.exception)


WRONG = [
    ("user_en", "$speed", "$speeed", r"user_en\.txt:3: unknown slot \$speeed \(did you mean 'speed'\?\)"),
    ("user_zh", "$pose", "", r"user_zh\.txt:\d: the slot \$pose is missing"),
    ("user_en", "$pictures", "", r"user_en\.txt:9: the slot \$pictures is missing"),
    ("system_zh", "# version: 1\n", "", r"system_zh\.txt:1: the first line must be '# version: '"),
    ("judge_user", "Record:", "It costs $5:", r"judge_user\.txt:5: a \$ that begins no slot; write \$\$"),
]


@pytest.mark.parametrize(("name", "old", "new", "told"), WRONG)
def test_each_wrong_slot_is_a_line_with_its_place(tmp_path, caplog, name, old, new, told):
    folder = export(tmp_path / "mine")
    edit(folder / f"{name}.txt", old, new)
    with pytest.raises(ConfigError, match=told):
        own_prompts(folder)
    assert any(re.search(told, record.message) for record in caplog.records)


def test_all_problems_are_told_at_once(tmp_path, caplog):
    folder = export(tmp_path / "mine")
    (folder / "hint_en.txt").unlink()
    (folder / "hints_en.txt").write_text("# version: 1\nx\n")
    (folder / "system_en.txt").write_bytes(b"\xff\xfe")
    (folder / "mirror_user.txt").write_text("# version: 1\n\n")
    with pytest.raises(ConfigError, match="5 to mend"):
        own_prompts(folder)
    told = "\n".join(record.message for record in caplog.records)
    assert "hints_en.txt: no prompt has this name (did you mean 'hint_en'?)" in told
    assert "hint_en.txt: the file is missing" in told
    assert "system_en.txt" in told
    assert "mirror_user.txt:2: the prompt is empty" in told
    with pytest.raises(ConfigError, match="no such folder"):
        own_prompts(tmp_path / "nowhere")


def test_captions_are_asked_with_them_and_keep_them(tree, mine, tmp_path):
    out = tmp_path / "out"
    product = run(CaptionConfig(prompts=mine), tree, out, workers=2)
    for caption in read_captions(product):
        assert caption.prompt["en"].system.endswith(OWN_LINE.replace("$$", "$"))
        assert caption.prompt["zh"].system.endswith(OWN_LINE.replace("$$", "$"))
        assert caption.prompt["en"].user.splitlines()[1].startswith("SPEED [0.0,")
        assert (
            caption.prompt["en"]
            .user.splitlines()[1]
            .endswith("100 % $1 m/s (the first frame has no earlier one and reads 0.0).")
        )
    assert {p.name: p.read_bytes() for p in (out / OWN_PROMPTS).iterdir()} == {
        p.name: p.read_bytes() for p in mine.iterdir()
    }
    listed = {entry["path"] for entry in json.loads((out / "manifest.json").read_text())["outputs"]}
    assert {f"{OWN_PROMPTS}/{p.name}" for p in mine.iterdir()} <= listed
    with pytest.raises(ResumeError, match="the prompts changed"):
        run(CaptionConfig(), tree, out)
    edit(mine / "hint_en.txt", "Hint:", "A hint:")
    with pytest.raises(ResumeError, match="the prompts changed"):
        run(CaptionConfig(prompts=mine), tree, out)


def test_a_teacher_is_sent_them(tree, mine, tmp_path):
    with TeacherServer(decision=lambda body: "track_straight") as server:
        cfg = {"teacher": server.url, "prompts": mine, "writing": "prose", "limit": 2, "endpoint": {"max_tries": 1}}
        run(CaptionConfig.model_validate(cfg), tree, tmp_path / "out")
        asked = [json.loads(body)["messages"] for body in server.bodies]
    own_line = OWN_LINE.replace("$$", "$")
    free = [messages for messages in asked if "SPEED [" in json.dumps(messages)]
    assert free
    assert all(own_line in messages[0]["content"].splitlines() for messages in free)


def test_training_sets_and_students_follow(tree, mine, tmp_path):
    captions = run(CaptionConfig(prompts=mine), tree, tmp_path / "out")
    prepared(tree, captions, tmp_path / "set", modalities=("rgb",))
    samples = list(open_split(tmp_path / "set", "train"))
    assert samples
    assert all(sample.prompt.system.endswith(OWN_LINE.replace("$$", "$")) for sample in samples)
    write_taught(tmp_path, taught_by(samples, 600))
    with TeacherServer(decision=lambda body: "hover") as server:
        asked = {
            "teacher": server.url, "repair": {"hard_conflict": "keep"}, "student": {"folder": tmp_path},
            "endpoint": {"max_tries": 1}, "limit": 1,
        }  # fmt: skip
        with pytest.raises(ConfigError, match=r"another version of the prompt.*caption\.prompts"):
            run(CaptionConfig.model_validate(asked), tree, tmp_path / "no")
        run(CaptionConfig.model_validate(asked | {"prompts": mine}), tree, tmp_path / "yes")
        assert OWN_LINE.replace("$$", "$") in json.loads(server.bodies[0])["messages"][0]["content"]
