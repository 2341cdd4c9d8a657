"""The weather and time of day of a trajectory: preset pools, modes, the seed formula (app:weather)."""

from __future__ import annotations

import math
import random
import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import Field, field_validator, model_validator

from cosfly.formats.boxes import BoxMap
from cosfly.formats.frames import LEGIBLE_CONTRAST
from cosfly.formats.kinds import KINDS
from cosfly.formats.weather import (
    TIMES,
    WEATHERS,
    SkyKind,
    TimePreset,
    WeatherParams,
    WeatherPreset,
    WeatherRecord,
    preset_token,
    resolved,
    sky_kind,
)  # fmt: skip
from cosfly.runtime.config import Config, MayDiffer, build, read_yaml
from cosfly.runtime.errors import ConfigError, nearest
from cosfly.runtime.seeding import draw_to_quota, rng_for

# Extinction per m at 100 percent; dense fog (80) leaves 5 % of the colours 60 m away.
FOG_AT_FULL, FOG_POWER = 0.10, 2.4
RAIN_EXTINCTION = 0.0045  # per m of the heaviest rain: a visibility of some 700 m
# Of clothes against the ground in clear air (CIE76), and how it goes with the light that is left: measured.
STRONGEST_CONTRAST, CONTRAST_POWER = 75.0, 1.75
LIT_KINDS = {KINDS[name] for name in ("Poles", "Roads", "Sidewalks")}  # where lamps are
Preset = TypeVar("Preset", WeatherPreset, TimePreset)
DEFAULT_SEED = 20260423  # of the paper's production runs (app:weather:coverage)


class WeatherConfig(Config):
    """The settings of weather. Off by default, as in the paper."""

    weather_mode: Literal["off", "fixed", "random_per_path", "by_weight"] = Field(
        "off",
        description="off: sun and air of `look`; fixed: weather_name and tod_name for every trajectory; "
        "random_per_path: each trajectory draws both by weather_seed and its index, for its two tracks, with equal "
        "probability; by_weight: the trajectories of a town together have the shares of sky_shares",
    )
    sky_shares: dict[SkyKind, Annotated[float, Field(ge=0)]] = Field(
        {"day_dry": 70, "day_rain": 9, "day_fog": 6, "dusk_dry": 7, "dusk_rain": 2, "night_dry": 6},
        description="shares of mode by_weight; they need not add up to one. dusk: the sun is lower than "
        "10 degrees, night: -3 or lower; rain: some precipitation, fog: fog density "
        "without it, dry: neither. Presets of one kind are equally likely",
    )
    weather_name: str | None = Field(None, description="preset of the weather in mode fixed", examples=[*WEATHERS])
    tod_name: str | None = Field(None, description="preset of the time of day in mode fixed", examples=[*TIMES])
    weather_pool: MayDiffer[Path | None] = Field(None, description="YAML file of weather presets instead of the 15")
    tod_pool: MayDiffer[Path | None] = Field(None, description="YAML file of times of day instead of the 4")
    weather_seed: int = Field(
        DEFAULT_SEED,
        description="seed of random_per_path and by_weight; a negative one draws a seed, which is recorded",
    )

    @field_validator("weather_mode", mode="before")
    @classmethod
    def _mode_as_written(cls, mode: Any) -> Any:
        """Accept `off`, which YAML reads as false, and hyphens."""
        if mode is False:
            return "off"
        return mode.replace("-", "_") if isinstance(mode, str) else mode

    @model_validator(mode="after")
    def _settings_agree(self) -> WeatherConfig:
        problems = []
        for field, pool_field, presets in (("weather_name", "weather_pool", WEATHERS), ("tod_name", "tod_pool", TIMES)):
            name, pool = getattr(self, field), getattr(self, pool_field)
            if name is None and self.weather_mode == "fixed":
                problems.append(f"{field} is needed in weather_mode fixed")
            if name is not None and self.weather_mode != "fixed":
                problems.append(f"{field} is for weather_mode fixed, and the mode is {self.weather_mode}")
            if pool is None:
                problems += _unknown(name, presets, field)
            if pool is not None and self.weather_mode == "off":
                problems.append(f"{pool_field} is given, and weather_mode is off")
        if not sum(self.sky_shares.values()) > 0:
            problems.append("sky_shares must add up to more than 0")
        if self.weather_mode != "by_weight" and self.sky_shares != type(self).model_fields["sky_shares"].default:
            problems.append(f"sky_shares is for weather_mode by_weight, and the mode is {self.weather_mode}")
        if problems:
            raise ValueError("; ".join(problems))
        return self

    def recorded(self) -> dict[str, Any]:
        """Return the settings that affect the result: none of them without weather."""
        if self.weather_mode == "by_weight":
            return super().recorded()
        unused = set(WeatherConfig.model_fields) if self.weather_mode == "off" else {"sky_shares"}
        return {name: value for name, value in super().recorded().items() if name not in unused}

    def pool_files(self) -> dict[str, Path]:
        """Return the files of presets, which are inputs of the stage."""
        return {name: path for name in ("weather_pool", "tod_pool") if (path := getattr(self, name)) is not None}


class PresetPool(Config, Generic[Preset]):
    """A file of weather presets or times of day, each with all knobs."""

    presets: dict[str, Preset] = Field(min_length=1)


@dataclass(frozen=True)
class Pools:
    """The presets to choose from, in the order of the seeded choice."""

    weathers: Mapping[str, WeatherPreset]
    times: Mapping[str, TimePreset]

    def of_kind(self) -> dict[str, list[tuple[str, str]]]:
        """Return the pairs of weather and time of each kind of sky."""
        pairs = {(a, b): sky_kind(resolved(self.weathers[a], self.times[b])) for a in self.weathers for b in self.times}
        return {kind: [pair for pair, own in pairs.items() if own == kind] for kind in dict.fromkeys(pairs.values())}


def read_pools(cfg: WeatherConfig) -> Pools:
    """Read the files of presets that the settings name, or return the paper's presets."""
    pools: list[Any] = [WEATHERS, TIMES]
    weathers: Any = (cfg.weather_pool, PresetPool[WeatherPreset], "weather_name")
    times: Any = (cfg.tod_pool, PresetPool[TimePreset], "tod_name")
    for i, (path, model, field) in enumerate((weathers, times)):
        if path is None:
            continue
        given = build(model, read_yaml(path), path).presets
        pools[i] = {preset_token(name): knobs for name, knobs in given.items()}
        if len(pools[i]) < len(given):
            raise ConfigError("two presets have the same name", where=path, got=", ".join(given))
        if problems := _unknown(getattr(cfg, field), pools[i], field):
            raise ConfigError("; ".join(problems), where=path)
    found = Pools(*pools)
    lacking = [kind for kind, share in cfg.sky_shares.items() if share and kind not in found.of_kind()]
    if cfg.weather_mode == "by_weight" and lacking:
        got, fix = f"a share of {', '.join(lacking)}", "remove the share, or add presets of this kind to the pools"
        raise ConfigError("no preset belongs to a kind of sky", where="render.sky_shares", got=got, fix=fix)
    return found


def _unknown(name: str | None, presets: Mapping[str, Any], field: str) -> list[str]:
    """Return what is wrong with the name of a preset; an empty list if it exists, or none is given."""
    if name is None or preset_token(name) in presets:
        return []
    return [f"{field}: unknown preset {name!r}{nearest(preset_token(name), presets)}; there are {', '.join(presets)}"]


def path_seed(weather_seed: int, path_index: int) -> int:
    """Return the seed of one trajectory (eq:weather_seed)."""
    return weather_seed * 1_000_003 + path_index * 7_919 + 11


def random_seed() -> int:
    """Return a seed that no two runs share: what a negative `weather_seed` asks for."""
    return secrets.randbelow(2**31)


def weather_of(cfg: WeatherConfig, pools: Pools, path_index: int) -> WeatherRecord | None:
    """Return the weather of a trajectory, None where the mode is off. `weather_seed` is not negative."""
    if cfg.weather_mode == "off":
        return None
    if cfg.weather_mode == "fixed":
        names = [preset_token(str(name)) for name in (cfg.weather_name, cfg.tod_name)]
    elif cfg.weather_mode == "by_weight":
        # Pairs of one kind are adjacent, so that kinds meet their quota as pairs do. Tokens have no blanks.
        of_kind = pools.of_kind()
        shares = {kind: share / len(of_kind[kind]) for kind, share in cfg.sky_shares.items() if share}
        weights = {f"{kind} {weather} {time}": shares[kind] for kind in shares for weather, time in of_kind[kind]}
        drawn = draw_to_quota(weights, rng_for(cfg.weather_seed, "render", "skies"))  # none depends on their number
        _, *names = next(islice(drawn, path_index, None)).split(" ")
    else:
        assert cfg.weather_seed >= 0, "`run` draws one"
        # Python guarantees a stable sequence for a seed only of `random()`.
        rng = random.Random(path_seed(cfg.weather_seed, path_index))
        names = [list(presets)[int(rng.random() * len(presets))] for presets in (pools.weathers, pools.times)]
    params = resolved(pools.weathers[names[0]], pools.times[names[1]])
    return WeatherRecord(mode=cfg.weather_mode, weather_name=names[0], tod_name=names[1], params=params)


def dark_trajectories(cfg: WeatherConfig, num: int, read_map: Callable[[], BoxMap]) -> list[int]:
    """Return the numbers of the trajectories whose pictures are black: by night, on a map without lamps.

    Args:
        read_map: called only if a trajectory is by night. While `weather_seed` is still to be drawn, none is known.
    """
    if cfg.weather_mode == "off" or cfg.weather_seed < 0:
        return []
    pools = read_pools(cfg)
    skies = [weather_of(cfg, pools, number) for number in range(num)]
    by_night = [k for k, sky in enumerate(skies) if sky and sky_kind(sky.params).startswith("night")]
    return by_night if by_night and not read_map().is_any_of(LIT_KINDS).any() else []


def fog_extinction(params: WeatherParams) -> float:
    """Return the extinction of fog and rain, per m."""
    rain = params.precipitation / 100.0
    return float(FOG_AT_FULL * (params.fog_density / 100.0) ** FOG_POWER + RAIN_EXTINCTION * rain**1.5)


def fog_hides(sky: WeatherRecord | None, distance_m: float) -> bool:
    """Return whether fog and rain make a person illegible at a distance."""
    thick = 0.0 if sky is None else fog_extinction(sky.params) * max(0.0, distance_m - sky.params.fog_distance)
    return math.exp(-CONTRAST_POWER * thick) * STRONGEST_CONTRAST < LEGIBLE_CONTRAST
