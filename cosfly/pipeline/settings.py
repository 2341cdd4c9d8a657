"""The settings of a whole run, one section per stage, defined next to the stage; and explanations of them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

from pydantic import BaseModel, Field, model_validator

from caption.schema import CaptionConfig
from cosfly.closed_loop.settings import FlyConfig
from cosfly.inspection.settings import InspectConfig
from cosfly.maps.stage import MapsConfig
from cosfly.pedestrians.walkable import PedestriansConfig
from cosfly.pipeline.command_settings import CommandConfig
from cosfly.planners.contract import PlanConfig
from cosfly.render.settings import RenderConfig
from cosfly.runtime.config import Config, build
from cosfly.runtime.errors import ConfigError, CosflyError, nearest
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.seeding import rng_for
from cosfly.simplify.passes import SimplifyConfig
from cosfly.worldgen.stage import WorldConfig
from distill.inference.samples import InferConfig
from distill.prepare.dual_track import DualTrackConfig
from distill.prepare.stage import PrepareConfig
from distill.training.settings import TrainConfig
from release.build.config import ReleaseConfig

TOWN_NAME = re.compile(r"[A-Za-z0-9_-]{1,60}")
# Keywords of JSON Schema that explanations name.
LIMITS = ("enum", "const", "minimum", "exclusiveMinimum", "maximum", "exclusiveMaximum", "multipleOf", "examples")


class DistillConfig(Config):
    """Settings of students."""

    prepare: PrepareConfig = Field(default_factory=PrepareConfig, description="training set from captions")
    dual_track: DualTrackConfig = Field(default_factory=DualTrackConfig, description="windows over both tracks")
    train: TrainConfig = Field(default_factory=TrainConfig, description="LoRA training")
    infer: InferConfig = Field(default_factory=InferConfig, description="answers of the student")


class RunConfig(CommandConfig):
    """Everything that `cosfly run` needs, and the sections of all other commands."""

    maps: MapsConfig = Field(default_factory=MapsConfig, description="step 1: source of the map")
    simplify: SimplifyConfig = Field(default_factory=SimplifyConfig, description="step 2")
    pedestrians: PedestriansConfig = Field(default_factory=PedestriansConfig, description="step 3")
    plan: PlanConfig = Field(default_factory=PlanConfig, description="step 4")
    render: RenderConfig = Field(default_factory=RenderConfig, description="step 5")
    inspect: InspectConfig = Field(default_factory=InspectConfig, description="step 6")
    caption: CaptionConfig = Field(default_factory=CaptionConfig, description="step 7")
    release: ReleaseConfig = Field(default_factory=ReleaseConfig, description="the published data set")
    fly: FlyConfig = Field(default_factory=FlyConfig, description="closed loop; not part of `cosfly run`")
    world: WorldConfig = Field(default_factory=WorldConfig, description="text to world; not part of `cosfly run`")
    distill: DistillConfig = Field(default_factory=DistillConfig, description="students; not part of `cosfly run`")

    @model_validator(mode="after")
    def _towns_are_valid(self) -> RunConfig:
        run_checks((partial(self._check_town, name) for name in self.towns), "towns")
        return self

    def _check_town(self, name: str) -> None:
        if not TOWN_NAME.fullmatch(name) or name == "release":
            expected = "1 to 60 letters, digits, underscores and hyphens, but not `release`"
            raise ConfigError("a town cannot have this name", where="towns", got=name, expected=expected)
        self.of_town(name)

    def all_towns(self) -> dict[str, RunConfig]:
        """Return the settings of each town's run; empty for a run without towns."""
        return {name: self.of_town(name) for name in self.towns}

    def of_town(self, name: str) -> RunConfig:
        """Return the settings of one town's run.

        Its seed derives from the run's seed and the town's name; its weather seed is the run's plus the town's index.
        """
        changes = self.towns[name]
        if "towns" in changes:
            fix = "move these towns to the top-level section `towns`"
            raise ConfigError(
                "the settings of a town cannot have a section `towns`", where=f"towns.{name}.towns", fix=fix
            )
        seed = int(rng_for(self.seed, "run", name).integers(2**31))
        shared = self.model_dump(mode="json", exclude={"towns", "maps"}) | {"name": name, "seed": seed}
        if self.render.weather_seed >= 0:  # otherwise the first trajectories of all towns have one sky
            shared["render"]["weather_seed"] += list(self.towns).index(name)
        other_changes = {section: value for section, value in changes.items() if section != "maps"}
        maps = _named_maps(changes.get("maps", {}), name)
        return build(RunConfig, _merged(self, shared, other_changes) | {"maps": maps}, f"towns.{name}")


def _named_maps(maps: Any, town: str) -> Any:
    """Return a town's section `maps`, in which the map has the town's name unless it has one; `build` checks it."""
    if not isinstance(maps, dict):
        return maps
    source = maps.get("source", "synthetic")
    maps = {**maps, "source": source}
    source_settings = maps.get(source, {}) if isinstance(source, str) else {}
    if isinstance(source_settings, dict):
        maps[source] = {"name": town} | source_settings
    return maps


def _merged(group: Config, settings: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of a group with changes applied; a mapping that is a value, such as shares, is replaced."""
    result = dict(settings)
    for name, value in changes.items():
        subgroup = getattr(group, name, None)
        if isinstance(subgroup, Config) and isinstance(value, dict):
            value = _merged(subgroup, settings[name], value)
        result[name] = value
    return result


def run_checks(checks: Iterable[Callable[[], object]], where: str) -> None:
    """Run all checks; raise the error of the one that fails, or one error for all that fail."""
    problems = list[CosflyError]()
    for check in checks:
        try:
            check()
        except CosflyError as error:
            problems.append(error)
    if len(problems) > 1:
        raise ConfigError.of_all([str(problem) for problem in problems], where=where)
    if problems:
        raise problems[0]


# --- explanations -----------------------------------------------------------------------------------------------------


class Setting(NamedTuple):
    """One setting, or a group of settings."""

    name: str  # with its sections, such as `plan.altitude_max_m`
    value: Any  # can be written as JSON; None for a group
    kind: str  # the allowed values in the words of JSON Schema; empty for a group
    meaning: str


def explain(cfg: BaseModel, section: str | None = None) -> list[Setting]:
    """Return all settings in order, a group before its members; or those of one section, or one setting."""
    schema = type(cfg).model_json_schema()
    settings = list(_explain(schema, schema["$defs"], cfg.model_dump(mode="json"), ""))
    if section is None:
        return settings
    selected = [s for s in settings if s.name == section or s.name.startswith(f"{section}.")]
    if not selected:
        what = f"there is no section or setting of this name{nearest(section, [setting.name for setting in settings])}"
        expected = "a section such as plan, a setting such as plan.muco, or the file or name of a configuration"
        raise ConfigError(what, got=section, expected=expected)
    return selected


def changed(cfg: BaseModel, section: str | None = None) -> list[Setting]:
    """Return the settings that differ from their defaults; raises the errors of `explain`."""
    defaults = {setting.name: setting.value for setting in explain(type(cfg)())}
    settings = explain(cfg, section)
    return [setting for setting in settings if setting.kind and setting.value != defaults.get(setting.name)]


def _explain(
    group: Mapping[str, Any], models: Mapping[str, Any], values: Mapping[str, Any], above: str
) -> Iterator[Setting]:
    """Yield the settings of a group.

    Args:
        group: Its schema.
        models: Schemas by name.
        values: Its values.
        above: Its name and a dot.
    """
    for name, field in group["properties"].items():
        meaning = field.get("description", "")
        model = _referenced(field, models)
        if "properties" in model:
            yield Setting(above + name, None, "", meaning)
            yield from _explain(model, models, values[name], f"{above}{name}.")
        else:
            yield Setting(above + name, values[name], _kind_of(field, models), meaning)


def _kind_of(field: Mapping[str, Any], models: Mapping[str, Any]) -> str:
    """Return the allowed values in the words of JSON Schema: `number, exclusiveMinimum 0`, `string, enum a | b`."""
    field = {**_referenced(field, models), **field}
    kind = field.get("format") or field.get("type")
    if not kind:
        kind = " or ".join(_kind_of(option, models) for option in field.get("anyOf", []))
    members = field.get("prefixItems") or [field.get("items") or field.get("additionalProperties")]
    member_kinds = [_kind_of(member, models) for member in members if isinstance(member, dict)]
    if member_kinds:
        kind += f" of {', '.join(member_kinds)}"
    words = [kind or "any"]
    for name in LIMITS:
        if name in field:
            limit = field[name]
            words.append(f"{name} {' | '.join(map(str, limit)) if isinstance(limit, list) else limit}")
    return ", ".join(words)


def _referenced(field: Mapping[str, Any], models: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the schema of the model that a field refers to; empty if it refers to none."""
    return models.get(field.get("$ref", "").rpartition("/")[2], {})


def nested(settings: list[Setting]) -> dict[str, Any]:
    """Return the values as nested groups, as in a configuration file."""
    values: dict[str, Any] = {}
    for setting in settings:
        *above, last = setting.name.split(".")
        group = values
        for name in above:
            group = group.setdefault(name, {})
        group[last] = setting.value if setting.kind else {}
    return values


def as_lines(settings: list[Setting]) -> Iterator[str]:
    """Yield lines for a terminal: `name = value`, then the meaning and the allowed values."""
    for setting in settings:
        if setting.kind:
            yield f"  {setting.name} = {dump_json(setting.value)}\n      {setting.meaning} [{setting.kind}]"
        else:
            yield f"\n{setting.name}: {setting.meaning}"
