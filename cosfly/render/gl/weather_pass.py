"""Weather in the GL renderer: uniforms of the shaders, the light of street lamps, rain, and the glow of lights.

Only colours depend on weather; depth, kinds and ids do not. Weather has programs of its own (`programs`), so that
trajectories without weather are rendered as fast as before.
"""

from __future__ import annotations

import zlib
from typing import Any, NamedTuple

import cv2
import numpy as np

from cosfly.formats.weather import SUN_IS_DOWN_DEG, WeatherParams
from cosfly.render.contract import PosedPerson
from cosfly.render.gl.parts import Parts
from cosfly.render.gl.programs import set_uniform
from cosfly.render.weather import fog_extinction

# --- atmosphere -------------------------------------------------------------------------------------------------------
# The six parameters of weather become uniforms of weather.glsl: colours and amounts of sun, sky, clouds and fog.
# Colours are linear RGB, already adapted to the darkness as by an eye or a camera: a night is about twenty times darker
# than a day, not a million times. They are interpolated between the altitudes of the tables.

CLEAR_HAZE_M = 620.0  # air without fog, as in Look.haze_m
FOG_PATH_M = 60.0  # way through fog that decides how much light of sun and sky is lost
MOON = np.array([-0.35, -0.62, 0.70])  # direction towards the moon, which is the light while the sun is down
LOWEST_SUN_DEG = 2.5  # a lower sun would cast shadows without end
MOON_DISC, SUN_DISC = 0.99993, 0.99955  # cosine of the angular radius

SUN_ALTITUDES_DEG = (SUN_IS_DOWN_DEG, 0.0, 6.0, 15.0, 42.0, 75.0)
SUN_LIGHT = np.array([
    (0, 0, 0), (1.25, 0.50, 0.16), (1.9, 1.05, 0.50), (2.25, 1.70, 1.12), (2.35, 2.12, 1.75), (2.45, 2.28, 1.98),
])  # fmt: skip
MOON_LIGHT = np.array([0.050, 0.062, 0.090])
ALTITUDES_DEG = (-18.0, -6.0, 0.0, 6.0, 15.0, 42.0, 75.0)
# A row for each altitude, with the columns of ClearSky: three for each of its five colours, then its two numbers.
SKIES = np.array([
    (0.017, 0.023, 0.042, 0.01, 0.012, 0.018, 0.013, 0.018, 0.036, 0.002, 0.004, 0.013, 0, 0, 0, 0.03, 1.45),
    (0.1, 0.12, 0.2, 0.05, 0.05, 0.08, 0.2, 0.15, 0.19, 0.04, 0.06, 0.15, 0.5, 0.2, 0.1, 0.11, 1.3),
    (0.25, 0.25, 0.37, 0.15, 0.13, 0.14, 0.46, 0.34, 0.34, 0.12, 0.17, 0.36, 1.15, 0.46, 0.14, 0.33, 1.05),
    (0.36, 0.39, 0.5, 0.2, 0.18, 0.16, 0.66, 0.56, 0.5, 0.17, 0.28, 0.53, 0.9, 0.5, 0.22, 0.52, 0.98),
    (0.42, 0.48, 0.62, 0.24, 0.22, 0.19, 0.72, 0.73, 0.74, 0.17, 0.33, 0.61, 0.6, 0.45, 0.28, 0.72, 0.88),
    (0.48, 0.56, 0.68, 0.27, 0.25, 0.22, 0.66, 0.75, 0.84, 0.16, 0.34, 0.66, 0.5, 0.42, 0.3, 0.94, 0.78),
    (0.5, 0.58, 0.7, 0.29, 0.27, 0.24, 0.64, 0.75, 0.86, 0.15, 0.33, 0.67, 0.5, 0.43, 0.32, 1, 0.6),
])  # fmt: skip
# Colours of an overcast sky of brightness 1.
COVERED_SKY = np.array([0.82, 0.86, 0.92])
COVERED_GROUND = np.array([0.37, 0.37, 0.36])
COVERED_HORIZON = np.array([0.66, 0.69, 0.72])
COVERED_ZENITH = np.array([0.50, 0.53, 0.57])
CITY_GLOW = np.array([0.030, 0.021, 0.013])  # light of street lamps from low clouds and fog
COVERED_EXPOSURE = 1.4  # factor of an overcast sky by day
LAMP_LIGHT = np.array([0.42, 0.29, 0.16])


def light_direction(params: WeatherParams) -> np.ndarray:
    """Return the unit vector towards the light that casts shadows, (3,) world: the sun, or the moon at night."""
    if params.sun_altitude_angle <= SUN_IS_DOWN_DEG:
        return MOON / np.linalg.norm(MOON)
    altitude, azimuth = np.radians([max(params.sun_altitude_angle, LOWEST_SUN_DEG), params.sun_azimuth_angle])
    # A compass counts clockwise from north, +y; x is east.
    return np.array([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])


class ClearSky(NamedTuple):
    """The light of a sky without clouds and fog. Colours are (3,) linear RGB."""

    sky_light: np.ndarray
    ground_light: np.ndarray
    horizon: np.ndarray
    zenith: np.ndarray
    sun_glow: np.ndarray
    overcast_brightness: float  # of the sky if clouds cover it
    exposure: float

    @classmethod
    def at(cls, sun_altitude_deg: float) -> ClearSky:
        """Return the sky at an altitude of the sun."""
        *colors, brightness, exposure = (np.interp(sun_altitude_deg, ALTITUDES_DEG, column) for column in SKIES.T)
        sky_light, ground_light, horizon, zenith, sun_glow = np.reshape(colors, (5, 3))
        return cls(sky_light, ground_light, horizon, zenith, sun_glow, float(brightness), float(exposure))


def uniforms(params: WeatherParams) -> dict[str, Any]:
    """Return the uniforms of a trajectory: name -> number or array. Shares are 0 to 1."""
    sun_altitude_deg = params.sun_altitude_angle
    is_night = sun_altitude_deg <= SUN_IS_DOWN_DEG
    cloud_share = params.cloudiness / 100.0
    rain_share = params.precipitation / 100.0
    extinction_per_m = fog_extinction(params)
    fog_share = 1.0 - float(np.exp(-FOG_PATH_M * extinction_per_m))
    overcast = float(_step(0.55, 0.92, cloud_share))
    grey = max(overcast * 0.9 + 0.1 * cloud_share, fog_share)  # share of the overcast colours
    direct = (1.0 - _step(0.25, 0.92, cloud_share)) * (1.0 - 0.92 * fog_share) * (1.0 - 0.6 * rain_share)

    # Each colour is a mixture of that of the clear sky and that of the overcast one.
    clear = ClearSky.at(sun_altitude_deg)
    covered = clear.overcast_brightness * (1.0 - 0.32 * rain_share)
    lights_on = float(1.0 - _step(0.33, 0.50, clear.overcast_brightness * (1.0 - 0.30 * rain_share)))
    city_glow = CITY_GLOW * lights_on * max(cloud_share, fog_share)
    horizon = _mixed(clear.horizon, COVERED_HORIZON * covered, grey) + city_glow
    zenith = _mixed(clear.zenith, COVERED_ZENITH * covered, grey) + 0.6 * city_glow
    sky_light = _mixed(clear.sky_light, COVERED_SKY * covered, grey) + city_glow
    sun_glow = clear.sun_glow * (1.0 - grey)
    sun = MOON_LIGHT
    if not is_night:
        sun = np.array([np.interp(sun_altitude_deg, SUN_ALTITUDES_DEG, column) for column in SUN_LIGHT.T])
    exposure = clear.exposure * (1.0 + (COVERED_EXPOSURE - 1.0) * overcast * _step(-4.0, 12.0, sun_altitude_deg))
    drop = exposure * (0.75 * sky_light + 0.55 * horizon) + lights_on * np.array([0.13, 0.115, 0.10])  # linear RGB
    return {
        "sun_light": sun * direct,
        "sky_light": sky_light,
        "ground_light": _mixed(clear.ground_light, COVERED_GROUND * covered, grey) + 0.5 * city_glow,
        "horizon": horizon,
        "zenith": zenith,
        "sun_glow": sun_glow,
        "fog_color": _mixed(horizon, 0.5 * (horizon + zenith), 0.25) + 0.12 * sun_glow,
        "fog": np.array([extinction_per_m, params.fog_distance]),
        "overcast": overcast,
        "cloudiness": cloud_share,
        "cloud_light": _mixed(1.15 * sky_light + 0.28 * sun * (1.0 - 0.6 * cloud_share), 1.1 * horizon, overcast),
        "cloud_shade": _mixed(0.95 * sky_light + 0.06 * sun, zenith, overcast),
        "wetness": float(_step(0.0, 0.45, rain_share)),
        "puddles": float(_step(0.1, 0.75, rain_share)),
        "lights_on": lights_on,
        "lamp_light": LAMP_LIGHT * lights_on,
        "disc_light": (np.array([0.9, 0.95, 1.0]) if is_night else 4.0 * sun) * (1.0 - fog_share) * direct,
        "disc_size": MOON_DISC if is_night else SUN_DISC,
        "stars": (1.0 - grey) * float(_step(-4.0, -14.0, sun_altitude_deg)) * 0.8,
        "penumbra_m": 0.05 + 1.1 * float(_step(0.15, 0.85, cloud_share)),
        "haze_m": CLEAR_HAZE_M,
        "exposure": exposure,
        "precipitation": rain_share,
        "rain_color": np.clip(drop, 0.0, 1.0) ** (1.0 / 2.2),
    }


def _step(low: float, high: float, value: float) -> float:
    """Return the smooth step of GLSL; low may be above high."""
    t = float(np.clip((value - low) / (high - low), 0.0, 1.0))
    return t * t * (3.0 - 2.0 * t)


def _mixed(first: np.ndarray, second: np.ndarray, share_of_second: float) -> np.ndarray:
    return first + (second - first) * share_of_second


# --- the light of lamps -----------------------------------------------------------------------------------------------

MAP_PX = 384  # side of the map
REACH_M = 45.0  # a lamp lights nothing farther away
FALL_M = 5.5  # height above the ground from which the light of every lamp falls, whatever its own
CROWDED = 0.4  # several lamps in one place give less than their sum
MOST_NEAR = 16  # lamps that puddles mirror, as in the shader
MIRRORED_WITHIN_M = 120.0


def lamp_map(lamps_m: np.ndarray, middle_m: np.ndarray, half_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute the light of lamps over a square of the ground.

    Args:
        lamps_m: (n, 3).
        middle_m: (2,) middle of the square.
        half_m: half the square's side.

    Returns:
        (MAP_PX, MAP_PX, 2) float32: light on the ground, about 1 under a lamp, and the height of the lamps that give
        it. The outermost pixels are dark, so that nothing beyond is lit.
        (4,) area of the map: low x, low y, 1 / side, 1 / side.
    """
    low_m = middle_m[:2] - half_m
    pixel_m = 2.0 * half_m / MAP_PX
    light = np.zeros((MAP_PX, MAP_PX))
    light_times_height = np.zeros((MAP_PX, MAP_PX))
    reach_px = int(np.ceil(REACH_M / pixel_m))
    for x_m, y_m, z_m in lamps_m:
        column = (x_m - low_m[0]) / pixel_m - 0.5
        row = (y_m - low_m[1]) / pixel_m - 0.5
        rows = slice(max(0, int(row) - reach_px), max(0, int(row) + reach_px + 1))
        columns = slice(max(0, int(column) - reach_px), max(0, int(column) + reach_px + 1))
        v, u = np.ogrid[rows.start : min(rows.stop, MAP_PX), columns.start : min(columns.stop, MAP_PX)]
        squared_m2 = ((u - column) ** 2 + (v - row) ** 2) * pixel_m**2
        # The light falls with the cube of the distance to the lamp, and is 0 at REACH_M.
        lamp_light = np.maximum((FALL_M**2 / (FALL_M**2 + squared_m2)) ** 1.5 - (FALL_M / REACH_M) ** 3, 0.0)
        light[rows, columns] += lamp_light
        light_times_height[rows, columns] += lamp_light * z_m
    height_m = np.where(light > 0.0, light_times_height / np.maximum(light, 1e-12), 0.0)
    light /= 1.0 + CROWDED * light
    light[[0, -1]] = 0.0
    light[:, [0, -1]] = 0.0
    per_side = 0.5 / half_m
    return np.stack([light, height_m], axis=-1).astype(np.float32), np.array([*low_m, per_side, per_side])


# --- one trajectory ---------------------------------------------------------------------------------------------------

SOFT_M = 0.25  # a wider penumbra is drawn as a soft border of shadows
FAINT = 0.02  # a fainter sun casts no shadow
MIRROR_FULL, MIRROR_FADE_M = 1.6, 75.0  # the mirror image of a lamp has the strength full - distance / fade, at most 1
NUM_PHASES = 9973  # of the rain
LAMP_UNIT, DEPTH_UNIT = 2, 3  # texture units
WIND = (0.07, 0.03)  # metres east and north for each metre that a drop falls
GLOW_FROM = 208  # brighter levels glow
GLOW_SHRINK = 4  # the glow is computed in a picture this many times smaller
GLOWS = ((5.0, 0.22), (19.0, 0.16))  # width in a picture of 1280 px; share of the light


def defines(params: WeatherParams) -> str:
    """Return the preprocessor lines that leave out the shader code which a weather does not need.

    It is not a branch in the shader, because a CPU runs both sides of a branch.
    """
    values = uniforms(params)
    has_shadows = float(values["sun_light"].max()) > FAINT
    needs = {
        "WEATHER": True, "WET": values["wetness"] > 0.0, "LIT": values["lights_on"] > 0.0, "SHADOWS": has_shadows,
        "SOFT": has_shadows and values["penumbra_m"] > SOFT_M,
    }  # fmt: skip
    return "".join(f"#define {name}\n" for name, is_needed in needs.items() if is_needed)


class WeatherPass:
    """The weather of a trajectory on one GL context."""

    sun_direction: np.ndarray  # (3,) unit vector, set by `prepare`
    _lamps: np.ndarray  # (n, 3) that puddles mirror, set by `prepare`

    def __init__(self, context: Any, over_color: Any, depth: Any, rain_program: Any) -> None:
        self._context = context
        self._depth = depth
        self._rain_program = rain_program
        self._rain = context.vertex_array(rain_program, [])
        self._over_color = over_color
        self._lamp_map = context.texture((MAP_PX, MAP_PX), 2, dtype="f4")
        self._lamp_map.repeat_x = self._lamp_map.repeat_y = False
        self.values: dict[str, Any] = {}

    def prepare(
        self, params: WeatherParams, parts: Parts, unseen_lamps: np.ndarray, middle: np.ndarray, half_m: float
    ) -> None:
        """Compute the uniforms, and the light of lamps over a square around `middle`.

        Args:
            parts: Their lamps give light, and puddles mirror them.
            unseen_lamps: (n, 3), lamps that give light only. All places are in m, relative to the origin of the parts.
            middle, half_m: Middle, (3,), and half the side of the square.
        """
        self._lamps = parts.lamps()
        self.sun_direction = light_direction(params)
        lamps_m = np.concatenate([self._lamps, unseen_lamps])
        reaches_square = (np.abs(lamps_m[:, :2] - middle[:2]) < half_m + REACH_M).all(axis=1)
        light, area = lamp_map(lamps_m[reaches_square], middle, half_m)
        self._lamp_map.write(light.tobytes())
        self.values = {
            **uniforms(params),
            "sun_direction": self.sun_direction,
            "lamp_area": area,
            "lamp_map": LAMP_UNIT,
            "wind": np.array(WIND),
        }

    @property
    def has_lights(self) -> bool:
        return bool(self.values["lights_on"] > 0.0)

    def frame_values(self, eye: np.ndarray, camera_pose: np.ndarray, person: PosedPerson | None) -> dict[str, Any]:
        """Return the uniforms of one frame: those of the trajectory, lamps near the camera, the phase of the rain."""
        away_m = np.linalg.norm(self._lamps - eye, axis=1)
        nearest = np.argsort(away_m, kind="stable")[:MOST_NEAR]
        nearest = nearest[away_m[nearest] < MIRRORED_WITHIN_M]
        lamps = np.zeros((MOST_NEAR, 4), np.float32)  # place, and strength, which falls to 0 with the distance
        lamps[: len(nearest), :3] = self._lamps[nearest]
        lamps[: len(nearest), 3] = np.clip(MIRROR_FULL - away_m[nearest] / MIRROR_FADE_M, 0.0, 1.0)
        # The phase follows from the frame's content: drops differ between frames, but not when a frame is drawn again.
        hip_m = np.zeros(3) if person is None else np.asarray(person.hip_m, dtype=np.float64)
        content = np.ascontiguousarray(camera_pose, dtype=np.float64).tobytes() + hip_m.tobytes()
        return {
            **self.values,
            "rain_phase": zlib.crc32(content) % NUM_PHASES / NUM_PHASES,
            "lamps": lamps.T,
            "num_lamps": len(nearest) if self.has_lights and self.values["wetness"] > 0.0 else 0,
        }

    def use(self) -> None:
        """Bind the map of lamp light to its texture unit."""
        self._lamp_map.use(LAMP_UNIT)

    def draw_rain(self, values: dict[str, Any]) -> None:
        """Draw drops over the colours of a finished frame; values: its uniforms."""
        if self.values["precipitation"] <= 0.0:
            return
        context = self._context
        self._over_color.use()
        context.enable_only(context.BLEND)
        context.blend_func = context.SRC_ALPHA, context.ONE_MINUS_SRC_ALPHA
        self._depth.use(DEPTH_UNIT)
        for name, value in values.items():
            set_uniform(self._rain_program, name, value)
        self._rain.render(vertices=3)

    def glowing(self, rgb: np.ndarray) -> np.ndarray:
        """Return the picture with the glow of lights, (h, w, 3) uint8: at night, and more in fog."""
        if not self.has_lights:
            return rgb
        small = cv2.resize(rgb, None, fx=1 / GLOW_SHRINK, fy=1 / GLOW_SHRINK, interpolation=cv2.INTER_AREA)
        bright = np.maximum(small.astype(np.float32) - GLOW_FROM, 0.0) * (255.0 / (255.0 - GLOW_FROM))
        fog_share = 1.0 - float(np.exp(-FOG_PATH_M * self.values["fog"][0]))
        glow = np.zeros_like(bright)
        for width_px, share in GLOWS:
            sigma_px = width_px * (1.0 + fog_share) * rgb.shape[1] / 1280.0 / GLOW_SHRINK
            glow += share * (1.0 + 1.5 * fog_share) * cv2.GaussianBlur(bright, (0, 0), max(sigma_px, 0.3))
        glow = np.clip(self.values["lights_on"] * glow, 0.0, 255.0).astype(np.uint8)
        return cv2.add(rgb, cv2.resize(glow, rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR))
