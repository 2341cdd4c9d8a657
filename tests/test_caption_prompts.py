"""Prompts of somebody's own."""

import json
from pathlib import Path

import pytest
from commands import invoke

from caption.schema import CaptionConfig
from caption.stage.stage import run
from caption.teachers.prompt_files import PROMPTS, export_prompts, own_prompts, shipped_prompts
from cosfly.formats.captions import OWN_PROMPTS, read_captions
from cosfly.runtime.errors import ConfigError, ResumeError
from specimens import make_playback_tree

OWN_LINE = "Costs $$5 & 100 %: you speak as a coast guard."


def export(folder: Path) -> Path:
    export_prompts(folder, shipped_prompts())
    return folder


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


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


def test_all_problems_are_told_at_once(tmp_path, caplog):
    folder = export(tmp_path / "mine")
    (folder / "hint_en.txt").unlink()
    (folder / "hints_en.txt").write_text("# version: 1\nx\n")
    (folder / "system_en.txt").write_bytes(b"\xff\xfe")
    (folder / "mirror_user.txt").write_text("# version: 1\n\n")
    with pytest.raises(ConfigError, match="5 to fix"):
        own_prompts(folder)
    told = "\n".join(record.message for record in caplog.records)
    assert "hints_en.txt: no prompt has this name (did you mean 'hint_en'?)" in told
    assert "hint_en.txt: the file is missing" in told
    assert "system_en.txt" in told
    assert "mirror_user.txt:2: the prompt is empty" in told
    with pytest.raises(ConfigError, match="no such folder"):
        own_prompts(tmp_path / "nowhere")


@pytest.mark.slow
def test_captions_are_asked_with_them_and_keep_them(tmp_path):
    """Another system text and another order of lines, which say the same things."""
    mine, tree, out = export(tmp_path / "mine"), make_playback_tree(tmp_path / "tree", 3, 14), tmp_path / "out"
    for name in ("system_en", "system_zh", "system_slots_en", "system_prose_en"):
        with (mine / f"{name}.txt").open("a", encoding="utf-8") as file:
            file.write(OWN_LINE + "\n")
    edit(mine / "user_en.txt", "Velocity: [$speed]", "SPEED [${speed}] 100 % $$1")
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
