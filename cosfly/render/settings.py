"""The settings of rendering: camera, tracks, weather and files of the frames."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from cosfly.formats.frames import LEAST_FOV_DEG, MOST_FOV_DEG, DepthFormat, FrameFile, Look
from cosfly.formats.places import folder_name
from cosfly.render.camera import ZoomConfig
from cosfly.render.carla_backend import CarlaRenderConfig
from cosfly.render.perturbation import PerturbationConfig
from cosfly.render.unrealcv_backend import UnrealCvRenderConfig
from cosfly.render.weather import WeatherConfig
from cosfly.runtime.config import Distinct
from cosfly.runtime.png import LONGEST_SIDE_PX

SIMULATORS = ("carla", "unrealcv")


class RenderConfig(WeatherConfig):
    """Camera, tracks, weather and files of the frames."""

    backend: Literal["gl", "pyrender", "carla", "unrealcv"] = Field(
        "gl",
        description="renderer; gl is OpenGL without a window, on a GPU or the CPU; pyrender is a plain and slow "
        "cross-check; carla uses a running CARLA 0.9.16, unrealcv a running UnrealCV, such as SimWorld",
    )
    carla: CarlaRenderConfig = Field(CarlaRenderConfig(), description="server of backend carla")
    unrealcv: UnrealCvRenderConfig = Field(UnrealCvRenderConfig(), description="server of backend unrealcv")
    width_px: int = Field(1280, ge=16, le=LONGEST_SIDE_PX, description="image width, px")
    height_px: int = Field(720, ge=16, le=LONGEST_SIDE_PX, description="image height, px")
    fovs_deg: tuple[float, ...] = Field(
        (110.0, 90.0, 60.0, 30.0),
        min_length=1,
        description="zoom levels, as horizontal fields of view in degrees; each trajectory draws one level for both of "
        "its tracks",
    )
    zoom: ZoomConfig = Field(ZoomConfig(), description="changes of the level within a trajectory")
    town: str | None = Field(
        None,
        description="name of the town; null takes the map's. Its folder is named `Town_<name>`, unless the name begins "
        "with `Town`",
    )
    first_timestamp: int | None = Field(
        None,
        ge=0,
        description="trajectory k of the traces becomes trajectory_<first_timestamp + k>; null derives it from map, "
        "traces, seed and settings, so that other maps and runs have other ids",
    )
    tracks: Distinct[tuple[Literal["clean", "perturbed"], ...]] = Field(
        ("clean", "perturbed"), min_length=1, description="tracks to draw: clean (ORI) and perturbed (aug_001)"
    )
    perturbation: PerturbationConfig = Field(PerturbationConfig(), description="the perturbed track")
    look: Look = Field(Look(), description="sun and air of trajectories without weather")
    modalities: Distinct[tuple[FrameFile, ...]] = Field(
        ("rgb", "depth", "instance"), min_length=1, description="images to write; meta.json is always written"
    )
    depth_format: DepthFormat = Field(
        "png",
        description="png: float32 without loss in depth_float32.png, an eighth of the size; npy: depth.npy, as in the "
        "public layout",
    )
    path_index: int | None = Field(None, ge=0, description="draw only the trajectory of this index; null: all")
    frame_stride: int = Field(
        1,
        ge=1,
        le=100,
        description="draw every n-th pose. With pedestrians.dt_s 0.1: 1 gives frames at 10 Hz, 5 frames at 2 Hz",
    )
    visible_threshold: float = Field(
        0.1,
        ge=0,
        lt=1,
        description="a target is visible if more than this share of its box is unhidden and it has at least one pixel",
    )

    def recorded(self) -> dict[str, Any]:
        """Return the recorded settings, without those that are unused."""
        unused = {name for name in SIMULATORS if name != self.backend}
        unused |= {"path_index"} if self.path_index is None else set()
        return {name: value for name, value in super().recorded().items() if name not in unused}

    @field_validator("fovs_deg")
    @classmethod
    def _fovs_are_possible(cls, fovs: tuple[float, ...]) -> tuple[float, ...]:
        for fov in fovs:
            if not LEAST_FOV_DEG <= fov <= MOST_FOV_DEG:
                span = f"{LEAST_FOV_DEG} to {MOST_FOV_DEG} degrees"
                raise ValueError(f"every field of view must be from {span}, got {fov:g}")
        return fovs

    @model_validator(mode="after")
    def _weather_can_be_drawn(self) -> RenderConfig:
        if self.backend in SIMULATORS and self.look != Look():
            raise ValueError(f"render.look has no effect on the simulator `{self.backend}`; remove render.look")
        if self.weather_mode != "off" and self.backend in ("pyrender", "unrealcv"):
            raise ValueError(f"render.weather_mode must be off with {self.backend}; only gl and carla can draw weather")
        if self.weather_mode != "off" and self.look != Look():
            fix = "remove render.look (--set 'render.look={}'), or set render.weather_mode to off"
            raise ValueError(f"render.look cannot be combined with render.weather_mode {self.weather_mode}; {fix}")
        return self

    @field_validator("town")
    @classmethod
    def _town_is_a_name(cls, town: str | None) -> str | None:
        if town is not None and folder_name(town) != town:
            raise ValueError("a town name may have only letters, digits, '.', '-' and '_', and no dot at the start")
        return town
