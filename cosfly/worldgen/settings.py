"""Settings of `cosfly world`."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from cosfly.llm.budget import BudgetConfig
from cosfly.llm.client import EndpointConfig
from cosfly.runtime.config import Config, MayDiffer


class WorldConfig(Config):
    """A world from text."""

    prompt: str = Field("", description="what the world shall be, in plain English")
    name: str = Field("TextWorld", min_length=1, max_length=60, description="name of the world's map")
    planner: str | None = Field(None, description="URL of the language model that plans; empty: the embedded rules")
    endpoint: EndpointConfig = Field(
        default_factory=lambda: EndpointConfig(max_tokens=2048), description="how the language model is asked"
    )
    budget: MayDiffer[BudgetConfig] = Field(default_factory=BudgetConfig, description="what the planner may use up")
    cache: MayDiffer[Path | None] = Field(
        None, description="folder of the planner's answers, which are not asked again; none: `answers` beside the world"
    )
