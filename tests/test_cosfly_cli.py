"""The command line and its settings: what a person reads when something is wrong, exit codes, the nearest name."""

import logging
import sys
from pathlib import Path

import pytest
from pydantic import BaseModel

from cosfly import cli
from cosfly.cli.options import Job, resolve
from cosfly.cli.run import print_run
from cosfly.llm.protocol import base_url
from cosfly.pipeline.runs import estimate
from cosfly.pipeline.settings import RunConfig, explain, nested
from cosfly.runtime.config import load
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.json_io import write_json
from cosfly.runtime.run_dir import Dropped, Kept, StageFolder, Tally


@pytest.fixture(autouse=True)
def _own_log():
    root = logging.getLogger()
    before = root.handlers[:], root.level
    yield
    root.handlers[:], root.level = before


def answer(capfd, monkeypatch, *words: str) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["cosfly", *words])
    with pytest.raises(SystemExit) as end:
        cli.main()
    return int(end.value.code or 0), capfd.readouterr().err


def test_errors_are_one_line_and_exit_1(capfd, monkeypatch, tmp_path, subtests):
    monkeypatch.chdir(tmp_path)
    for name in ("taken", "town.csv"):
        (tmp_path / name).write_text("a file")
    for folder in ("stage", "deep/stage"):
        write_json(tmp_path / folder / "stage.json", {})
    write_json(tmp_path / "released/dataset/release.json", {})
    (tmp_path / "zero.json").symlink_to("/dev/zero")
    (tmp_path / "quickstart").mkdir()  # hides the configuration of its name from nobody
    assert resolve(Path("quickstart"), None).name == "quickstart"
    no_file = "maps={source: boxes, boxes: {path: none.csv}}"
    of_one_stage = ("stage: the output directory contains the output of a single stage", "choose another --out")
    for words, parts in (
        (("config", "check", "quikstart"), ("quikstart", "did you mean 'quickstart'", "simworld")),
        (("config", "check", "quickstart", "--set", "a..b=1"), ("--set", "a..b=1", "key=value")),
        (("config", "check", "quickstart", "--set", no_file), ("does not exist", "maps.boxes", "none.csv")),
        (("simplify", "--map", "nope.json", "--out", "x"), ("nope.json", "no such file")),
        (("simplify", "--map", "town.csv", "--out", "x"), ("town.csv", "cosfly maps --source boxes")),
        (("maps", "--out", "/proc/x"), ("/proc/x", "cannot be written", "--out")),
        (("maps", "--out", "taken/inside"), ("taken", "cannot be written", "--out")),
        (("run", "stage"), ("stage: this folder is not", "no run.yaml", "a run directory, or one of")),
        (("config", "check", "deep/stage"), ("deep/stage: this folder is not", "no run.yaml", "quickstart")),
        (("view", "town", "--out", "x"), ("town", "the directory of rendered tracks does not exist", "check the path")),
        (("view", "released", "--out", "x"), ("released/dataset", "a release has no page", "datasets.load_dataset")),
        (("simplify", "--map", "zero.json", "--out", "x"), ("zero.json", "a device", "a regular file")),
        (("caption", "prompts", "--export", "taken"), ("taken", "cannot be written", "--out")),
        (("run", "quickstart", "--out", "stage"), of_one_stage),
        (("run", "quickstart", "--out", "stage", "--dry-run"), of_one_stage),
    ):
        with subtests.test(words=words):
            status, error = answer(capfd, monkeypatch, *words)
            line = error.splitlines()[-1]
            assert status == 1
            assert line.startswith("error: ")
            assert [part for part in parts if part not in line] == []


def test_a_folder_with_the_name_of_a_section_does_not_hide_its_settings(capfd, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "caption").mkdir()  # as in the repository
    status, _ = answer(capfd, monkeypatch, "config", "show", "--describe", "caption")
    assert status == 0


def test_failed_items_make_the_command_exit_1_unless_the_settings_accept_them(capfd, tmp_path):
    write_json(tmp_path / "product", {})
    stage = StageFolder(tmp_path, "plan", is_complete=False)
    stage.finish([tmp_path / "product"], Tally(input=6, kept=3, dropped={"short": 2}, failed={"no_path": 1}))
    with pytest.raises(InputError, match=r"some items failed.*no_path 1.*at most 0.*max_failed=1"):
        Job(RunConfig()).finish(tmp_path / "product", tmp_path)
    Job(RunConfig(max_failed=1)).finish(tmp_path / "product", tmp_path)
    assert capfd.readouterr().out.count("product") == 2


def test_the_items_of_a_stage_that_is_not_complete_are_so_far(capfd, tmp_path):
    (tmp_path / "run.yaml").write_text("seed: 1\n")
    stage = StageFolder(tmp_path / "render", "render", is_complete=False)
    write_json(stage.path / "stage.json", {})
    with stage.journal as journal:
        for record in (Kept(id="a"), Kept(id="b"), Dropped(id="c", reason="short")):
            journal.append(record.model_dump())
    print_run(tmp_path)
    shown = " ".join(capfd.readouterr().out.split())
    assert "2 kept, 1 dropped (short 1) of 3 so far, " in shown
    assert " of 40 " in shown
    frames = {row.name: row.count for row in estimate(RunConfig(), tmp_path)}
    assert frames["render"] == round(frames["inspect"] * 37 / 40)


def test_every_form_of_an_address_leads_to_one_root():
    roots = {
        "http://h:8000": "http://h:8000/v1",
        "http://h:8000/v1/chat/completions": "http://h:8000/v1",
        "https://h/v1beta/openai": "https://h/v1beta/openai",
        "https://h/api/v3/": "https://h/api/v3",
    }
    assert {url: base_url(url) for url in roots} == roots


def test_defaults_then_file_then_overrides(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text("seed: 3\nplan: {altitude_min_m: 13}\n")
    assert load(RunConfig, None).plan.altitude_min_m == RunConfig().plan.altitude_min_m != 13.0
    assert (load(RunConfig, file).seed, load(RunConfig, file).plan.altitude_min_m) == (3, 13.0)
    assert load(RunConfig, file, ["plan.altitude_min_m=14"]) == RunConfig.model_validate(
        {"seed": 3, "plan": {"altitude_min_m": 14}}
    )


def test_bad_overrides_and_files(tmp_path):
    for override in ("novalue", "=3", "seed=[", "seed.x=1"):
        with pytest.raises(ConfigError):
            load(RunConfig, None, [override])
    file = tmp_path / "c.yaml"
    for text, words in (
        ("[1, 2]", "not a mapping"),
        ("a: [", "not valid YAML"),
        (f"seed: {':'.join('1' * 200)}.0", "not valid YAML"),  # a sexagesimal number beyond float
        (f"seed: 0x{'F' * 5_000}", "not valid YAML"),
        (f"seed: 1{'0' * 400}", "not valid YAML"),
        ('name: "\\UFFFFFFFF"', "not valid YAML"),
    ):
        file.write_text(text)
        with pytest.raises(ConfigError, match=words):
            load(RunConfig, file)
    file.write_text("seed: 3\n")  # right by itself
    with pytest.raises(ConfigError, match=r"c\.yaml with --set: plan: the value is not a group of settings, got 3"):
        load(RunConfig, file, ["plan=3"])
    with pytest.raises(ConfigError, match=r"nowhere\.yaml.*No such file"):
        load(RunConfig, tmp_path / "nowhere.yaml")


def test_a_setting_that_is_not_there_is_told_its_place_or_its_neighbours():
    for given, words in (
        ("altitude_max_m=40", r"altitude_max_m: unknown setting \(did you mean 'plan\.altitude_max_m'\?\)"),
        ("render.altitude_max_m=40", r"render\.altitude_max_m: .*\(did you mean 'plan\.altitude_max_m'\?\)"),
        (
            "endpoint.json_schema=false",
            r"did you mean 'caption\.endpoint' or 'world\.endpoint' or 'distill\.infer\.endpoint'\?",
        ),
        ("plan.wokers=2", r"plan\.wokers: unknown setting"),
        ("towns={a: {sed: 1}, b: {sed: 2}}", r"towns\.a: sed: unknown.*towns\.b: sed: unknown"),
        ("render.fovs_deg=60", r"render\.fovs_deg: the value is not a list, got 60; write \[60\]"),
    ):
        with pytest.raises(ConfigError, match=words):
            load(RunConfig, None, [given])
    with pytest.raises(ConfigError, match=r"plan\.gimbal\.xyz: unknown setting \(the settings here are bandwidth_hz, "):
        load(RunConfig, None, ["plan.gimbal.xyz=3"])
    with pytest.raises(ConfigError, match=r"did you mean 'plan\.muco'"):
        explain(RunConfig(), "plan.mucco")


def test_every_setting_is_explained_once_with_its_value():
    cfg = RunConfig()

    def names(group: BaseModel, above: str) -> list[str]:
        found = []
        for name in type(group).model_fields:
            value = getattr(group, name)
            found += [above + name, *(names(value, f"{above}{name}.") if isinstance(value, BaseModel) else [])]
        return found

    explained = explain(cfg)
    assert [setting.name for setting in explained] == names(cfg, "")
    assert all(setting.meaning for setting in explained)
    assert nested(explained) == cfg.model_dump(mode="json")
