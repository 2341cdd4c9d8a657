"""The settings of a whole run: one section for each stage, which stands with the stage."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from caption.schema import CaptionConfig
from cosfly.closed_loop.settings import FlyConfig
from cosfly.inspection.settings import InspectConfig
from cosfly.maps.stage import MapsConfig
from cosfly.pedestrians.walkable import PedestriansConfig
from cosfly.planners.contract import PlanConfig
from cosfly.render.settings import RenderConfig
from cosfly.runtime.config import Config, build
from cosfly.runtime.errors import ConfigError
from cosfly.runtime.io import LinkedPath
from cosfly.runtime.pool import Watch
from cosfly.runtime.ray_engine import ALL_ROOM, RayConfig
from cosfly.runtime.seeding import rng_for
from cosfly.simplify.passes import SimplifyConfig
from cosfly.worldgen.settings import WorldConfig
from distill.evaluation.compare import ReportConfig
from distill.evaluation.stage import EvaluateConfig
from distill.inference.stage import InferConfig
from distill.prepare.dual_track import DualTrackConfig
from distill.prepare.stage import PrepareConfig
from distill.training.settings import TrainConfig
from release.package.config import ReleaseConfig

TOWN_NAME = re.compile(r"[A-Za-z0-9_-]{1,60}")


class DistillConfig(Config):
    """Settings of the student's four steps."""

    prepare: PrepareConfig = Field(default_factory=PrepareConfig, description="captions to a training set")
    dual_track: DualTrackConfig = Field(default_factory=DualTrackConfig, description="windows over both tracks")
    train: TrainConfig = Field(default_factory=TrainConfig, description="LoRA training")
    infer: InferConfig = Field(default_factory=InferConfig, description="answers of the student")
    evaluate: EvaluateConfig = Field(default_factory=EvaluateConfig, description="scores")
    report: ReportConfig = Field(default_factory=ReportConfig, description="students side by side")


class RunConfig(Config):
    """Everything that `cosfly run` needs; each stage's settings stand with the stage."""

    name: str = Field(
        "run", pattern=r"^[\w-][\w. -]*$", description="name of the run; `cosfly run` writes to runs/<name>"
    )
    seed: int = Field(0, description="every random choice derives from it, the stage and the item; 0 is a seed")
    workers: int = Field(
        0,
        ge=0,
        description="worker processes; 0 takes one per core, of a Ray cluster as many as its nodes have room for",
    )
    engine: Literal["local", "ray"] = Field(
        "local", description="where the workers of stages are: processes of this machine, or on the nodes of `ray`"
    )
    ray: RayConfig = Field(default_factory=RayConfig, description="the cluster of engine ray")
    item_limit_s: float | None = Field(
        None,
        ge=0,
        description="seconds that an item may take without getting on (a flight: without a new frame), then its worker "
        "is ended and the item tried again, twice; null for 600 or 20 times what items take, whichever is more; "
        "0 for no limit",
    )
    max_failed: int = Field(
        0, ge=0, description="failed items that are accepted; more make the command exit 1, at its end"
    )
    roi: Path | None = Field(
        None, description="region of interest for the pedestrians (a roi_polygon.json of yours); none: the whole map"
    )
    follow_links: bool = Field(
        False,
        description="follow symbolic links that lead out of the run, tree, release or folder of meshes they stand in",
    )
    towns: dict[str, dict[str, Any]] = Field(
        {},
        description="towns of one data set: name -> the settings that differ there; each is a run in a folder of its "
        "name, and one release is made of all. `maps` of a town stands for itself. None: one town, as the settings "
        "below say",
    )
    maps: MapsConfig = Field(default_factory=MapsConfig, description="step 1, where the boxes come from")
    simplify: SimplifyConfig = Field(default_factory=SimplifyConfig, description="step 2")
    pedestrians: PedestriansConfig = Field(default_factory=PedestriansConfig, description="step 3")
    plan: PlanConfig = Field(default_factory=PlanConfig, description="step 4")
    render: RenderConfig = Field(default_factory=RenderConfig, description="step 5")
    inspect: InspectConfig = Field(default_factory=InspectConfig, description="step 6")
    caption: CaptionConfig = Field(default_factory=CaptionConfig, description="step 7")
    release: ReleaseConfig = Field(default_factory=ReleaseConfig, description="the published data set")
    fly: FlyConfig = Field(default_factory=FlyConfig, description="a student flies; not part of `cosfly run`")
    world: WorldConfig = Field(default_factory=WorldConfig, description="text to world; not part of `cosfly run`")
    distill: DistillConfig = Field(default_factory=DistillConfig, description="students; not part of `cosfly run`")

    def opened(self, path: Path) -> Path:
        """Return a path that a command was given as one whose links are followed, if they are."""
        return LinkedPath(path) if self.follow_links else path

    @model_validator(mode="after")
    def _address_is_used(self) -> RunConfig:
        if self.ray.address and self.engine != "ray":
            raise ValueError(f"ray.address is {self.ray.address}, but engine is {self.engine}: --engine ray")
        return self

    @model_validator(mode="after")
    def _towns_can_be(self) -> RunConfig:
        problems = list[ConfigError]()
        for name in self.towns:
            try:
                if not TOWN_NAME.fullmatch(name) or name == "release":
                    expected = "letters, digits, _ and -, and not 'release'"
                    raise ConfigError(f"a town cannot be called {name!r}", where="towns", expected=expected)
                self.of_town(name)
            except ConfigError as error:
                problems.append(error)
        if len(problems) > 1:
            raise ConfigError.of_all([str(problem) for problem in problems], where="towns")
        if problems:
            raise problems[0]
        return self

    def of_town(self, name: str) -> RunConfig:
        """Return the settings of one town's run. Its seed derives from the run's and its name; its map has its name.

        Raises:
            ConfigError: what is set for it cannot be; names the town and the setting.
        """
        changes = self.towns[name]
        if "towns" in changes:
            raise ConfigError("a town has no towns", where=f"towns.{name}.towns", fix="list them side by side")
        maps = {"source": "synthetic"} | _mapping(changes.get("maps", {}), f"towns.{name}.maps")
        source = str(maps["source"])
        maps[source] = {"name": name} | _mapping(maps.get(source, {}), f"towns.{name}.maps.{source}")
        seed = int(rng_for(self.seed, "run", name).integers(2**31))
        shared = self.model_dump(mode="json", exclude={"towns", "maps"}) | {"name": name, "seed": seed}
        others = {setting: value for setting, value in changes.items() if setting != "maps"}
        return build(RunConfig, merged(self, shared, others) | {"maps": maps}, f"towns.{name}")


def _mapping(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError("not a group of settings", where=where, got=repr(value)[:80])
    return value


def merged(group: Config, settings: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return a group's settings with the changes in them; a mapping that is one value, as shares are, is replaced."""
    result = dict(settings)
    for name, value in changes.items():
        within = getattr(group, name, None)
        if isinstance(within, Config) and isinstance(value, dict):
            value = merged(within, settings[name], value)
        result[name] = value
    return result


def worker_options(cfg: RunConfig) -> dict[str, Any]:
    """Return the arguments that all stages with items take: how many workers, where, and when one counts as stalled."""
    cluster = cfg.ray if cfg.engine == "ray" else None
    workers = cfg.workers or (len(os.sched_getaffinity(0)) if cluster is None else ALL_ROOM)
    return {"workers": workers, "watch": Watch(cluster, cfg.item_limit_s)}
