"""Which weather and time of day a flight has: preset pools, modes, the seed formula (app:weather)."""

from __future__ import annotations

import math
import random
import secrets
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Literal

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

# Extinction per m at 100 percent; dense fog (80) leaves 5 % of what stands 60 m away.
FOG_AT_FULL, FOG_POWER = 0.10, 2.4
RAIN_EXTINCTION = 0.0045  # per m of the heaviest rain: a visibility of some 700 m
# Of clothes against the ground in clear air (CIE76), and how it goes with the light that is left: measured.
STRONGEST_CONTRAST, CONTRAST_POWER = 75.0, 1.75
LIT_KINDS = tuple(KINDS[name] for name in ("Poles", "Roads", "Sidewalks"))  # lamps hang there, or stand along them
DEFAULT_SEED = 20260423  # of the paper's production runs (app:weather:coverage)
MOST_SEED = 2**31  # of a seed that is drawn


class WeatherConfig(Config):
    """The settings of weather. Off by default, as in the paper: pictures are of `look`, without a record."""

    weather_mode: Literal["off", "fixed", "random_per_path", "by_weight"] = Field(
        "off",
        description="off: sun and air as `look` says; fixed: weather_name and tod_name for every flight; "
        "random_per_path: each trajectory draws both by weather_seed and its index, its two tracks alike, every preset "
        "as likely; by_weight: the trajectories of a town together have the shares of sky_shares",
    )
    sky_shares: dict[SkyKind, Annotated[float, Field(ge=0)]] = Field(
        {"day_dry": 70, "day_rain": 9, "day_fog": 6, "dusk_dry": 7, "dusk_rain": 2, "night_dry": 6},
        description="shares of mode by_weight; they need not add up to one. dusk: the sun is lower than "
        "10 degrees, night: -3 or lower; rain: some precipitation, fog: fog density "
        "without it, dry: neither. Presets of one kind are equally likely",
    )
    weather_name: str | None = Field(None, description="preset of the weather in mode fixed", examples=[*WEATHERS])
    tod_name: str | None = Field(None, description="preset of the time of day in mode fixed", examples=[*TIMES])
    weather_pool: MayDiffer[Path | None] = Field(
        None, description="YAML file with weather presets of yours in the place of the 15 that ship"
    )
    tod_pool: MayDiffer[Path | None] = Field(
        None, description="YAML file with times of day of yours in the place of the 4 that ship"
    )
    weather_seed: int = Field(
        DEFAULT_SEED,
        description="seed of random_per_path and by_weight; a negative one draws a seed, another for every run, which "
        "the records tell",
    )

    @field_validator("weather_mode", mode="before")
    @classmethod
    def _mode_as_written(cls, mode: Any) -> Any:
        """YAML reads `off` as false; flags may have hyphens."""
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
            if name is not None and pool is None:
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
        """Return the settings that decide what is made. Without weather none of them does."""
        unused = {"off": {*WeatherConfig.model_fields}, "by_weight": set[str]()}.get(self.weather_mode, {"sky_shares"})
        return {name: value for name, value in super().recorded().items() if name not in unused}

    def pool_files(self) -> dict[str, Path]:
        """Return the files of presets, which are inputs of the stage."""
        files = {"weather_pool": self.weather_pool, "tod_pool": self.tod_pool}
        return {name: path for name, path in files.items() if path is not None}


class WeatherPool(Config):
    """A file of weather presets: each has all four knobs."""

    presets: dict[str, WeatherPreset] = Field(
        min_length=1, description="name -> cloudiness, precipitation, fog_density, fog_distance"
    )


class TimePool(Config):
    """A file of times of day: each has both knobs."""

    presets: dict[str, TimePreset] = Field(min_length=1, description="name -> sun_altitude_angle, sun_azimuth_angle")


@dataclass(frozen=True)
class Pools:
    """The presets to choose from, in the order that seeds count in."""

    weathers: Mapping[str, WeatherPreset]
    times: Mapping[str, TimePreset]

    def of_kind(self) -> dict[str, list[tuple[str, str]]]:
        """Return the pairs of weather and time of each kind of sky."""
        pairs = {(a, b): sky_kind(resolved(self.weathers[a], self.times[b])) for a in self.weathers for b in self.times}
        return {kind: [pair for pair, own in pairs.items() if own == kind] for kind in dict.fromkeys(pairs.values())}


def read_pools(cfg: WeatherConfig) -> Pools:
    """Read the files of presets that the settings name, or take the paper's."""
    errors: list[ConfigError] = []
    pools: list[Any] = [WEATHERS, TIMES]
    own: Any = ((cfg.weather_pool, WeatherPool, "weather_name"), (cfg.tod_pool, TimePool, "tod_name"))
    for i, (path, model, field) in enumerate(own):
        if path is None:
            continue
        try:
            given, name = build(model, read_yaml(path), path).presets, getattr(cfg, field)
            pools[i] = {preset_token(name): knobs for name, knobs in given.items()}
            if len(pools[i]) < len(given):
                raise ConfigError("two presets have one name", where=path, got=", ".join(given))
            if name is not None and (problems := _unknown(name, pools[i], field)):
                raise ConfigError("; ".join(problems), where=path)
        except ConfigError as error:
            errors.append(error)
    if errors:
        raise errors[0] if len(errors) == 1 else ConfigError("; ".join(map(str, errors)), where="weather presets")
    found = Pools(*pools)
    lacking = [kind for kind, share in cfg.sky_shares.items() if share and kind not in found.of_kind()]
    if cfg.weather_mode == "by_weight" and lacking:
        got, fix = f"a share of {', '.join(lacking)}", "leave it out, or add presets to the pools"
        raise ConfigError("no presets of a kind of sky", where="render.sky_shares", got=got, fix=fix)
    return found


def _unknown(name: str, presets: Mapping[str, Any], field: str) -> list[str]:
    """Return what is wrong with the name of a preset, nothing where there is such a one."""
    if preset_token(name) in presets:
        return []
    return [f"{field}: unknown preset {name!r}{nearest(preset_token(name), presets)}; there are {', '.join(presets)}"]


def path_seed(weather_seed: int, path_index: int) -> int:
    """Return the seed of one trajectory (eq:weather_seed)."""
    return weather_seed * 1_000_003 + path_index * 7_919 + 11


def drawn_seed() -> int:
    """Draw a seed that nothing repeats: what a negative `weather_seed` asks for."""
    return secrets.randbelow(MOST_SEED)


def weather_of(cfg: WeatherConfig, pools: Pools, path_index: int) -> WeatherRecord | None:
    """Return the weather of a trajectory, None where the mode is off. `weather_seed` is not negative."""
    if cfg.weather_mode == "off":
        return None
    if cfg.weather_mode == "fixed":
        names = preset_token(str(cfg.weather_name)), preset_token(str(cfg.tod_name))
    elif cfg.weather_mode == "by_weight":
        names = next(islice(_to_quota(cfg, pools), path_index, None))
    else:
        assert cfg.weather_seed >= 0, "`run` settles it"
        # Of Python's generators only `random()` has a sequence that is promised to stay for a seed.
        rng = random.Random(path_seed(cfg.weather_seed, path_index))
        names = _drawn(pools.weathers, rng), _drawn(pools.times, rng)
    params = resolved(pools.weathers[names[0]], pools.times[names[1]])
    return WeatherRecord(mode=cfg.weather_mode, weather_name=names[0], tod_name=names[1], params=params)


def dark_flights(cfg: WeatherConfig, num_flights: int, read_map: Callable[[], BoxMap]) -> list[int]:
    """Return the numbers of the flights on whose pictures nobody sees anything: by night, on a map without lamps.

    Args:
        read_map: asked only where a flight is by night. A drawn `weather_seed` is not known before: then there is none.
    """
    if cfg.weather_mode == "off" or cfg.weather_seed < 0:
        return []
    pools = read_pools(cfg)
    skies = [weather_of(cfg, pools, number) for number in range(num_flights)]
    by_night = [k for k, sky in enumerate(skies) if sky and sky_kind(sky.params).startswith("night")]
    return by_night if by_night and not read_map().is_any_of(set(LIT_KINDS)).any() else []


def fog_extinction(params: WeatherParams) -> float:
    """What fog and rain take from a colour, per m."""
    rain = params.precipitation / 100.0
    return float(FOG_AT_FULL * (params.fog_density / 100.0) ** FOG_POWER + RAIN_EXTINCTION * rain**1.5)


def fog_hides(sky: WeatherRecord | None, distance_m: float) -> bool:
    """Return whether a sky takes so much of the colours at a distance that nobody can be made out there."""
    thick = 0.0 if sky is None else fog_extinction(sky.params) * max(0.0, distance_m - sky.params.fog_distance)
    return math.exp(-CONTRAST_POWER * thick) * STRONGEST_CONTRAST < LEGIBLE_CONTRAST


def _to_quota(cfg: WeatherConfig, pools: Pools) -> Iterator[tuple[str, str]]:
    """Yield weather and time of trajectory 0, 1, ...; those of a trajectory do not depend on the ones after it."""
    # Pairs of one kind stand next to each other, so kinds have their quota as pairs do. Tokens have no blanks.
    of_kind = pools.of_kind()
    shares = {kind: share / len(of_kind[kind]) for kind, share in cfg.sky_shares.items() if share}
    weights = {f"{kind} {weather} {time}": shares[kind] for kind in shares for weather, time in of_kind[kind]}
    for name in draw_to_quota(weights, rng_for(cfg.weather_seed, "render", "skies")):
        _, weather, time = name.split(" ")
        yield weather, time


def _drawn(presets: Mapping[str, Any], rng: random.Random) -> str:
    return list(presets)[int(rng.random() * len(presets))]


# --- coverage ---------------------------------------------------------------------------------------------------------


def coverage_of(cfg: WeatherConfig, drawn: Iterable[tuple[str, str]]) -> dict[str, Any]:
    """Count trajectories by weather, time of day, both and kind, beside what is expected (app:weather:coverage)."""
    pools, pairs = read_pools(cfg), Counter(drawn)
    num = pairs.total()
    by = {name: dict.fromkeys(presets, 0) for name, presets in vars(pools).items()}
    for (weather, time), count in pairs.items():
        by["weathers"][weather] += count
        by["times"][time] += count
    uniform = {name: round(num / len(presets), 2) for name, presets in vars(pools).items()}
    asked = {kind: round(num * share / sum(cfg.sky_shares.values()), 2) for kind, share in cfg.sky_shares.items()}
    return {
        "trajectories": num,
        **by,
        "kinds": {kind: sum(pairs[pair] for pair in found) for kind, found in pools.of_kind().items()},
        "pairs": [[weather, time, count] for (weather, time), count in sorted(pairs.items())],
        "expected": {"kinds": asked} if cfg.weather_mode == "by_weight" else uniform,
    }


def told_coverage(told: Mapping[str, Any]) -> str:
    """Say in a line how much of the presets the trajectories of a run have."""
    seen = {name: sum(count > 0 for count in told[name].values()) for name in ("weathers", "times")}
    of = {name: len(told[name]) for name in seen}
    return (
        f"{told['trajectories']} trajectories in {seen['weathers']} of {of['weathers']} weathers, "
        f"{seen['times']} of {of['times']} times of "
        f"day, {len(told['pairs'])} of {of['weathers'] * of['times']} pairs"
        + "".join(f", {count} {kind}" for kind, count in told["kinds"].items() if count)
    )
