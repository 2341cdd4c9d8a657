"""The settings that all commands share, and a model per command that adds the sections which the command uses.

It imports no stage: a command loads only the settings of its own sections.
"""

from __future__ import annotations

import importlib
from collections.abc import Collection
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, create_model, model_validator

from cosfly.runtime.config import Config
from cosfly.runtime.io import LinkedPath
from cosfly.runtime.limits import num_cpus
from cosfly.runtime.pool import Watch
from cosfly.runtime.ray_engine import ALL_ROOM, RayConfig

SECTIONS = {  # section -> its model
    "maps": "cosfly.maps.stage:MapsConfig",
    "simplify": "cosfly.simplify.passes:SimplifyConfig",
    "pedestrians": "cosfly.pedestrians.walkable:PedestriansConfig",
    "plan": "cosfly.planners.contract:PlanConfig",
    "render": "cosfly.render.settings:RenderConfig",
    "inspect": "cosfly.inspection.settings:InspectConfig",
    "caption": "caption.schema:CaptionConfig",
    "release": "release.build.config:ReleaseConfig",
    "fly": "cosfly.closed_loop.settings:FlyConfig",
    "world": "cosfly.worldgen.stage:WorldConfig",
    "distill": "cosfly.pipeline.settings:DistillConfig",
}


class CommandConfig(Config):
    """The settings that all commands share."""

    name: str = Field("run", pattern=r"^[\w-][\w. -]*$", description="name; `cosfly run` writes to runs/<name>")
    seed: int = Field(0, description="seed; every random choice derives from it, the stage and the item")
    workers: int = Field(
        0, ge=0, description="worker processes; 0: one per core, or as many as the Ray cluster has room for"
    )
    engine: Literal["local", "ray"] = Field(
        "local", description="local: workers on this machine; ray: workers on the nodes of a Ray cluster"
    )
    ray: RayConfig = Field(default_factory=RayConfig, description="the cluster of engine ray")
    item_limit_s: float | None = Field(
        None,
        ge=0,
        description="seconds without progress (in rendering: without a new frame) after which a worker is ended and "
        "its item is tried again, at most twice; null: the larger of 600 and 20 times the usual time; 0: no limit",
    )
    max_failed: int = Field(0, ge=0, description="failed items that are accepted; with more, the command exits with 1")
    roi: Path | None = Field(None, description="region for the pedestrians (roi_polygon.json); none: the whole map")
    follow_links: bool = Field(False, description="follow symbolic links out of the run, tree, release or meshes")
    towns: dict[str, dict[str, Any]] = Field(
        {},
        description="towns of one data set, by name, with the settings that differ from the shared ones; each town is "
        "a run in a folder of its name, and one release contains all. `maps` of a town replaces the shared section. "
        "Empty: one town",
    )

    def opened(self, path: Path) -> Path:
        """Return a path of a command; with `follow_links`, readers follow the links below it."""
        return LinkedPath(path) if self.follow_links else path

    @model_validator(mode="after")
    def _address_is_used(self) -> CommandConfig:
        if self.ray.address and self.engine != "ray":
            raise ValueError(f"ray.address is {self.ray.address}, but engine is {self.engine}; add --engine ray")
        return self


def config_with(sections: Collection[str]) -> type[CommandConfig]:
    """Return the model of a command that uses these sections."""
    fields: dict[str, Any] = {}
    for name in sections:
        module, _, attribute = SECTIONS[name].partition(":")
        model = getattr(importlib.import_module(module), attribute)
        fields[name] = (model, Field(default_factory=model))
    return create_model("CommandConfig", __base__=CommandConfig, **fields)


def worker_options(cfg: CommandConfig) -> dict[str, Any]:
    """Return the arguments that all stages with items take: `workers` and `watch`."""
    cluster = cfg.ray if cfg.engine == "ray" else None
    workers = cfg.workers or (num_cpus() if cluster is None else ALL_ROOM)
    return {"workers": workers, "watch": Watch(cluster, cfg.item_limit_s)}
