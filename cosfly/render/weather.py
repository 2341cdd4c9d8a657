"""The weather and time of day of a trajectory: preset pools, modes and the seed formula (app:weather)."""

from __future__ import annotations

import random
import secrets
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice, product
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import Field, field_validator, model_validator

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

FOG_AT_FULL = 0.10  # extinction per m at a fog density of 100 percent
FOG_POWER = 2.4  # of the fog density: dense fog (80 percent) leaves 5 % of the colours 60 m away
RAIN_EXTINCTION = 0.0045  # extinction per m of the heaviest rain: a visibility of some 700 m
Preset = TypeVar("Preset", WeatherPreset, TimePreset)
DEFAULT_SEED = 20260423  # the seed of the paper's production runs (app:weather:coverage)


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
    weather_pool: MayDiffer[Path | None] = Field(None, description="YAML file that replaces the 15 weather presets")
    tod_pool: MayDiffer[Path | None] = Field(None, description="YAML file that replaces the 4 times of day")
    weather_seed: int = Field(
        DEFAULT_SEED,
        description="seed of random_per_path and by_weight; a negative value draws a seed, which is recorded",
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
            name = getattr(self, field)
            pool = getattr(self, pool_field)
            if name is None and self.weather_mode == "fixed":
                problems.append(f"weather_mode fixed needs {field}")
            if name is not None and self.weather_mode != "fixed":
                problems.append(f"{field} needs weather_mode fixed, but the mode is {self.weather_mode}")
            if pool is None:
                problems += _unknown(name, presets, field)
            if pool is not None and self.weather_mode == "off":
                problems.append(f"{pool_field} has no effect, because weather_mode is off")
        if not sum(self.sky_shares.values()) > 0:
            problems.append("sky_shares must add up to more than 0")
        if self.weather_mode != "by_weight" and self.sky_shares != type(self).model_fields["sky_shares"].default:
            problems.append(f"sky_shares needs weather_mode by_weight, but the mode is {self.weather_mode}")
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

    def pairs_by_kind(self) -> dict[str, list[tuple[str, str]]]:
        """Return the pairs of weather and time of each kind of sky."""
        pairs = defaultdict[str, list[tuple[str, str]]](list)
        for weather, time in product(self.weathers, self.times):
            pairs[sky_kind(resolved(self.weathers[weather], self.times[time]))].append((weather, time))
        return dict(pairs)


def read_pools(cfg: WeatherConfig) -> Pools:
    """Read the files of presets that the settings name, or return the paper's presets.

    Raises:
        ConfigError: If a file is malformed, lacks the named preset, or a kind with a share has no presets.
    """
    pools = Pools(
        weathers=_read_pool(cfg.weather_pool, PresetPool[WeatherPreset], WEATHERS, cfg.weather_name, "weather_name"),
        times=_read_pool(cfg.tod_pool, PresetPool[TimePreset], TIMES, cfg.tod_name, "tod_name"),
    )
    if cfg.weather_mode == "by_weight":
        kinds = pools.pairs_by_kind()
        if missing := [kind for kind, share in cfg.sky_shares.items() if share and kind not in kinds]:
            raise ConfigError(
                f"the weather and time pools have no presets for the kinds of sky {', '.join(missing)}",
                where="render.sky_shares",
                fix="remove these kinds of sky from render.sky_shares, or add presets for them to the pools",
            )
    return pools


def _read_pool(
    path: Path | None, model: type[PresetPool[Preset]], default: Mapping[str, Preset], name: str | None, field: str
) -> Mapping[str, Preset]:
    """Read a file of presets, or return the default; `field` is the setting that holds `name`."""
    if path is None:
        return default
    presets = build(model, read_yaml(path), path).presets
    pool = {preset_token(preset_name): preset for preset_name, preset in presets.items()}
    if len(pool) < len(presets):
        tokens = Counter(map(preset_token, presets))
        equal_names = [name for name in presets if tokens[preset_token(name)] > 1]
        what = "two presets have the same name; case, blanks and hyphens are ignored"
        raise ConfigError(what, where=path, got=", ".join(equal_names), fix="rename one of them")
    if problems := _unknown(name, pool, field):
        raise ConfigError("; ".join(problems), where=path)
    return pool


def _unknown(name: str | None, presets: Mapping[str, Any], field: str) -> list[str]:
    """Return the problem with a preset's name, in a list that is empty if the preset exists or no name is set."""
    if name is None or preset_token(name) in presets:
        return []
    hint = nearest(preset_token(name), presets)
    return [f"{field}: there is no preset {name!r}{hint}; choose one of {', '.join(presets)}"]


def path_seed(weather_seed: int, path_index: int) -> int:
    """Return the seed of one trajectory (eq:weather_seed)."""
    return weather_seed * 1_000_003 + path_index * 7_919 + 11


def random_seed() -> int:
    """Return a new random seed for a run with a negative `weather_seed`."""
    return secrets.randbelow(2**31)


def weather_of(cfg: WeatherConfig, pools: Pools, path_index: int) -> WeatherRecord | None:
    """Return the weather of one trajectory. For many trajectories `weathers_of` is faster."""
    return weathers_of(cfg, pools, [path_index])[path_index]


def weathers_of(cfg: WeatherConfig, pools: Pools, path_indices: Iterable[int]) -> dict[int, WeatherRecord | None]:
    """Return the weather of trajectories by path index, None where the mode is off. `weather_seed` is not negative."""
    indices = sorted(set(path_indices))
    if cfg.weather_mode == "off":
        return dict.fromkeys(indices)
    if cfg.weather_mode == "fixed":
        names = dict.fromkeys(indices, (preset_token(str(cfg.weather_name)), preset_token(str(cfg.tod_name))))
    elif cfg.weather_mode == "by_weight":
        # Each draw depends on the draws before it, but not on how many follow.
        drawn = list(islice(_draw_by_weight(cfg, pools), max(indices, default=-1) + 1))
        names = {index: drawn[index] for index in indices}
    else:
        assert cfg.weather_seed >= 0, "`run` replaces a negative seed"
        names = {index: _draw_evenly(pools, path_seed(cfg.weather_seed, index)) for index in indices}
    records: dict[int, WeatherRecord | None] = {}
    for index, (weather, time) in names.items():
        params = resolved(pools.weathers[weather], pools.times[time])
        records[index] = WeatherRecord(mode=cfg.weather_mode, weather_name=weather, tod_name=time, params=params)
    return records


def _draw_by_weight(cfg: WeatherConfig, pools: Pools) -> Iterator[tuple[str, str]]:
    """Yield the names of weather and time for path index 0, 1, ... without end, in the shares of the settings."""
    pairs_by_kind = pools.pairs_by_kind()
    weights: dict[str, float] = {}
    for kind, share in cfg.sky_shares.items():
        pairs = pairs_by_kind[kind] if share else []
        # The quota sorts its names. This prefix keeps the pairs of one kind adjacent, so that kinds meet their quota.
        weights |= {f"{kind} {weather} {time}": share / len(pairs) for weather, time in pairs}
    for name in draw_to_quota(weights, rng_for(cfg.weather_seed, "render", "skies")):
        _, weather, time = name.split(" ")  # tokens have no blanks
        yield weather, time


def _draw_evenly(pools: Pools, seed: int) -> tuple[str, str]:
    """Return the names of a weather and a time, each drawn with equal probability."""
    rng = random.Random(seed)
    # Of all its methods, Python guarantees the sequence for a seed only of `random()`.
    weather = list(pools.weathers)[int(rng.random() * len(pools.weathers))]
    time = list(pools.times)[int(rng.random() * len(pools.times))]
    return weather, time


def fog_extinction(params: WeatherParams) -> float:
    """Return the extinction of fog and rain, per m."""
    rain = params.precipitation / 100.0
    return float(FOG_AT_FULL * (params.fog_density / 100.0) ** FOG_POWER + RAIN_EXTINCTION * rain**1.5)
