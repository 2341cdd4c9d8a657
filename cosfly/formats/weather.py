"""Weather and time of day: the paper's presets, six parameters, and the record in a track's files (app:weather)."""

from typing import Annotated, Literal

from pydantic import Field

from cosfly.runtime.config import Config
from cosfly.runtime.json_io import Record

WeatherMode = Literal["fixed", "random_per_path", "by_weight"]
SkyKind = Literal[
    "day_dry", "day_rain", "day_fog", "dusk_dry", "dusk_rain", "dusk_fog", "night_dry", "night_rain", "night_fog"
]  # fmt: skip
SUN_IS_DOWN_DEG = -3.0  # altitude of the sun; on the horizon it still lights walls
DAY_FROM_DEG = 10.0  # altitude of the sun; below is dusk or dawn
Percent = Annotated[float, Field(strict=True, ge=0, le=100)]
Metres = Annotated[float, Field(strict=True, gt=0)]
Altitude = Annotated[float, Field(strict=True, ge=-90, le=90)]
Azimuth = Annotated[float, Field(strict=True, ge=0, lt=360)]


class WeatherPreset(Config):
    """The four parameters of the air."""

    cloudiness: Percent = Field(description="share of the sky that clouds cover, percent")
    precipitation: Percent = Field(description="strength of the rain, percent")
    fog_density: Percent = Field(description="thickness of the fog, percent")
    fog_distance: Metres = Field(description="distance at which fog begins, m")


class TimePreset(Config):
    """The two parameters of the sun."""

    sun_altitude_angle: Altitude = Field(description="height of the sun over the horizon, degrees; negative is night")
    sun_azimuth_angle: Azimuth = Field(description="compass direction of the sun, degrees clockwise from north")


class WeatherParams(TimePreset, WeatherPreset):  # in this order, so that the air comes first
    """All six parameters (tab:weather_params_fields)."""


class WeatherRecord(Record):
    """`weather` of `trajectory.json` and `meta.json` (tab:weather_meta); flights without weather have none."""

    mode: WeatherMode
    weather_name: str = Field(min_length=1)
    tod_name: str = Field(min_length=1)
    params: WeatherParams


# tab:weather_presets: cloudiness, precipitation, fog_density, fog_distance
_PARAMETERS = {
    "clear": (5, 0, 0, 60), "fair": (20, 0, 0, 60), "partly_cloudy": (40, 0, 0, 60), "cloudy": (70, 0, 0, 60),
    "overcast": (95, 0, 0, 60),
    "drizzle": (50, 15, 10, 50), "light_rain": (60, 30, 5, 50), "medium_rain": (80, 60, 15, 30),
    "heavy_rain": (95, 90, 25, 20),
    "thin_fog": (30, 0, 30, 30), "mist": (50, 0, 50, 20), "dense_fog": (70, 0, 80, 10),
    "smog": (60, 0, 60, 15), "dust_haze": (70, 0, 70, 12), "snow_haze": (90, 0, 40, 20),
}  # fmt: skip
WEATHERS = {
    name: WeatherPreset(**dict(zip(WeatherPreset.model_fields, row, strict=True))) for name, row in _PARAMETERS.items()
}
# tab:tod_presets
TIMES = {
    name: TimePreset(sun_altitude_angle=altitude, sun_azimuth_angle=azimuth)
    for name, altitude, azimuth in (("morning", 15, 90), ("noon", 75, 180), ("dusk", 0, 270), ("night", -30, 0))
}


def preset_token(text: str) -> str:
    """Return the name of a preset as the tables here spell it: `Heavy rain` is `heavy_rain`."""
    return text.strip().lower().replace(" ", "_").replace("-", "_")


def resolved(weather: WeatherPreset, time: TimePreset) -> WeatherParams:
    """Return the parameters of a weather and a time of day as one record."""
    return WeatherParams(**weather.model_dump(), **time.model_dump())


def sky_kind(params: WeatherParams) -> str:
    """Return the SkyKind of parameters, also for presets of a user."""
    light = "dusk" if params.sun_altitude_angle < DAY_FROM_DEG else "day"
    if params.sun_altitude_angle <= SUN_IS_DOWN_DEG:
        light = "night"
    if params.precipitation:
        return f"{light}_rain"
    return f"{light}_fog" if params.fog_density else f"{light}_dry"
