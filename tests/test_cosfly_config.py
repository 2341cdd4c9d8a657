"""Settings: strict, all problems at once, the nearest name."""

import importlib

import pytest
from pydantic import BaseModel, Field

from cosfly.pipeline.command_settings import SECTIONS
from cosfly.pipeline.settings import RunConfig, explain, nested
from cosfly.runtime.config import Config, load
from cosfly.runtime.errors import ConfigError


class Inner(Config):
    altitude_m: float = Field(20.0, gt=0, description="")


class Outer(Config):
    seed: int = Field(0, description="")
    plan: Inner = Field(default_factory=Inner, description="")


def test_defaults_then_file_then_overrides(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text("seed: 3\nplan: {altitude_m: 30}\n")
    assert load(Outer, None).plan.altitude_m == 20.0
    assert load(Outer, file).plan.altitude_m == 30.0
    assert load(Outer, file, ["plan.altitude_m=40"]) == Outer(seed=3, plan=Inner(altitude_m=40))


def test_all_problems_at_once_with_the_nearest_name(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text("sed: 3\nplan: {altitud_m: 30, altitude_m: -1}\n")
    with pytest.raises(ConfigError) as caught:
        load(Outer, file)
    text = str(caught.value)
    for words in (
        "did you mean 'seed'",
        "plan.altitud_m: unknown setting (did you mean 'altitude_m'?)",
        "greater than 0",
        "3 to fix",
        "c.yaml",
    ):
        assert words in text


def test_what_is_wrong_in_towns_is_told_of_each():
    with pytest.raises(ConfigError, match=r"towns\.a: sed: unknown.*towns\.b: sed: unknown"):
        load(RunConfig, None, ["towns={a: {sed: 1}, b: {sed: 2}}"])


def test_bad_overrides_and_files(tmp_path):
    for override in ("novalue", "=3", "seed=[", "seed.x=1"):
        with pytest.raises(ConfigError):
            load(Outer, None, [override])
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
            load(Outer, file)
    file.write_text("seed: 3\n")  # right by itself
    with pytest.raises(ConfigError, match=r"c\.yaml with --set: plan: the value is not a group of settings, got 3"):
        load(Outer, file, ["plan=3"])
    with pytest.raises(ConfigError, match=r"nowhere\.yaml.*No such file"):
        load(Outer, tmp_path / "nowhere.yaml")


def test_a_setting_that_is_not_there_is_told_its_place_or_its_neighbours():
    for given, words in (
        ("altitude_max_m=40", r"altitude_max_m: unknown setting \(did you mean 'plan\.altitude_max_m'\?\)"),
        ("render.altitude_max_m=40", r"render\.altitude_max_m: .*\(did you mean 'plan\.altitude_max_m'\?\)"),
        ("endpoint.json_schema=false", r"did you mean 'caption\.endpoint' or 'distill\.infer\.endpoint'\?"),
        ("plan.wokers=2", r"plan\.wokers: unknown setting"),
        ("render.fovs_deg=60", r"render\.fovs_deg: the value is not a list, got 60; write \[60\]"),
    ):
        with pytest.raises(ConfigError, match=words):
            load(RunConfig, None, [given])
    with pytest.raises(ConfigError, match=r"plan\.xyz: unknown setting \(the settings here are altitude_m\)"):
        load(Outer, None, ["plan.xyz=3"])
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


def test_every_section_of_the_settings_is_a_model():
    for place in SECTIONS.values():
        module, name = place.split(":")
        assert issubclass(getattr(importlib.import_module(module), name), Config)
