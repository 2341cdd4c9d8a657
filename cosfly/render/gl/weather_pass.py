"""Weather in the default renderer: uniforms, the map of street lamps, rain over the picture, the glow of lights.

It has programs of its own (`programs`), so that fair weather costs nothing; depth, kinds and ids are unaffected.
"""

from __future__ import annotations

import zlib
from typing import Any

import cv2
import numpy as np

from cosfly.formats.weather import SUN_IS_DOWN_DEG, WeatherParams
from cosfly.render.contract import MAX_BOX_ID, PosedPerson
from cosfly.render.gl.parts import Parts
from cosfly.render.gl.programs import set_uniform
from cosfly.render.weather import fog_extinction

# --- atmosphere -------------------------------------------------------------------------------------------------------
# The six parameters of weather as uniforms of weather.glsl: colours and amounts of sun, sky, clouds and fog. Colours
# are linear and balanced for their exposure, as by an eye or a camera: a night is some twenty times darker than a day,
# not a million times. They are interpolated between the altitudes of the tables.

CLEAR_HAZE_M = 620.0  # air without fog, as in Look.haze_m
MOON = np.array([-0.35, -0.62, 0.70])  # towards the moon, the light while the sun is down
LOWEST_SUN_DEG = 2.5
MOON_DISC, SUN_DISC = 0.99993, 0.99955

SUN_ALTITUDES_DEG = (SUN_IS_DOWN_DEG, 0.0, 6.0, 15.0, 42.0, 75.0)
SUN_LIGHT = np.array([
    (0, 0, 0), (1.25, 0.50, 0.16), (1.9, 1.05, 0.50), (2.25, 1.70, 1.12), (2.35, 2.12, 1.75), (2.45, 2.28, 1.98),
])  # fmt: skip
MOON_LIGHT = np.array([0.050, 0.062, 0.090])
ALTITUDES_DEG = (-18.0, -6.0, 0.0, 6.0, 15.0, 42.0, 75.0)
# By altitude: RGB of the sky's and the ground's light, the horizon, the zenith and the glow around the sun; brightness
# of an overcast sky; exposure.
SKIES = np.array([
    (0.017, 0.023, 0.042, 0.01, 0.012, 0.018, 0.013, 0.018, 0.036, 0.002, 0.004, 0.013, 0, 0, 0, 0.03, 1.45),
    (0.1, 0.12, 0.2, 0.05, 0.05, 0.08, 0.2, 0.15, 0.19, 0.04, 0.06, 0.15, 0.5, 0.2, 0.1, 0.11, 1.3),
    (0.25, 0.25, 0.37, 0.15, 0.13, 0.14, 0.46, 0.34, 0.34, 0.12, 0.17, 0.36, 1.15, 0.46, 0.14, 0.33, 1.05),
    (0.36, 0.39, 0.5, 0.2, 0.18, 0.16, 0.66, 0.56, 0.5, 0.17, 0.28, 0.53, 0.9, 0.5, 0.22, 0.52, 0.98),
    (0.42, 0.48, 0.62, 0.24, 0.22, 0.19, 0.72, 0.73, 0.74, 0.17, 0.33, 0.61, 0.6, 0.45, 0.28, 0.72, 0.88),
    (0.48, 0.56, 0.68, 0.27, 0.25, 0.22, 0.66, 0.75, 0.84, 0.16, 0.34, 0.66, 0.5, 0.42, 0.3, 0.94, 0.78),
    (0.5, 0.58, 0.7, 0.29, 0.27, 0.24, 0.64, 0.75, 0.86, 0.15, 0.33, 0.67, 0.5, 0.43, 0.32, 1, 0.6),
])  # fmt: skip
# Hues of an overcast sky.
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


def uniforms(params: WeatherParams) -> dict[str, Any]:
    """Return the uniforms of a trajectory: name -> number or array. lights_on: of street lamps and windows, 0 to 1."""
    altitude = params.sun_altitude_angle
    cloud = params.cloudiness / 100.0
    rain = params.precipitation / 100.0
    extinction = fog_extinction(params)
    fogged = 1.0 - float(np.exp(-60.0 * extinction))  # of the sun's light and of the sky
    overcast = float(_step(0.55, 0.92, cloud))
    grey = max(overcast * 0.9 + 0.1 * cloud, fogged)
    direct = (1.0 - _step(0.25, 0.92, cloud)) * (1.0 - 0.92 * fogged) * (1.0 - 0.6 * rain)
    *colors, covered, exposure = (float(np.interp(altitude, ALTITUDES_DEG, column)) for column in SKIES.T)
    own_sky, own_ground, own_horizon, own_zenith, own_glow = np.reshape(colors, (5, 3))
    exposure *= 1.0 + (COVERED_EXPOSURE - 1.0) * overcast * _step(-4.0, 12.0, altitude)
    is_night = altitude <= SUN_IS_DOWN_DEG
    level = covered * (1.0 - 0.32 * rain)
    lit = float(1.0 - _step(0.33, 0.50, covered * (1.0 - 0.30 * rain)))
    city = CITY_GLOW * lit * max(cloud, fogged)
    sun = MOON_LIGHT
    if not is_night:
        sun = np.array([np.interp(altitude, SUN_ALTITUDES_DEG, column) for column in SUN_LIGHT.T])
    horizon = _mixed(own_horizon, COVERED_HORIZON * level, grey) + city
    zenith = _mixed(own_zenith, COVERED_ZENITH * level, grey) + 0.6 * city
    sky_light = _mixed(own_sky, COVERED_SKY * level, grey) + city
    glow = own_glow * (1.0 - grey)
    drop = exposure * (0.75 * sky_light + 0.55 * horizon) + lit * np.array([0.13, 0.115, 0.10])  # linear
    return {
        "sun_light": sun * direct,
        "sky_light": sky_light,
        "ground_light": _mixed(own_ground, COVERED_GROUND * level, grey) + 0.5 * city,
        "horizon": horizon,
        "zenith": zenith,
        "sun_glow": glow,
        "fog_color": _mixed(horizon, 0.5 * (horizon + zenith), 0.25) + 0.12 * glow,
        "fog": np.array([extinction, params.fog_distance]),
        "overcast": overcast,
        "cloudiness": cloud,
        "cloud_light": _mixed(1.15 * sky_light + 0.28 * sun * (1.0 - 0.6 * cloud), 1.1 * horizon, overcast),
        "cloud_shade": _mixed(0.95 * sky_light + 0.06 * sun, zenith, overcast),
        "wetness": float(_step(0.0, 0.45, rain)),
        "puddles": float(_step(0.1, 0.75, rain)),
        "lights_on": lit,
        "lamp_light": LAMP_LIGHT * lit,
        "disc_light": (np.array([0.9, 0.95, 1.0]) if is_night else 4.0 * sun) * (1.0 - fogged) * direct,
        "disc_size": MOON_DISC if is_night else SUN_DISC,
        "stars": (1.0 - grey) * float(_step(-4.0, -14.0, altitude)) * 0.8,
        "penumbra_m": 0.05 + 1.1 * float(_step(0.15, 0.85, cloud)),
        "haze_m": CLEAR_HAZE_M,
        "exposure": exposure,
        "precipitation": rain,
        "rain_color": np.clip(drop, 0.0, 1.0) ** (1.0 / 2.2),
    }


def _step(low: float, high: float, value: float) -> float:
    """Return the smooth step of GLSL; low may be above high."""
    t = float(np.clip((value - low) / (high - low), 0.0, 1.0))
    return t * t * (3.0 - 2.0 * t)


def _mixed(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    return a + (b - a) * share


# --- the light of lamps -----------------------------------------------------------------------------------------------

MAP_PX = 384
REACH_M = 45.0  # a lamp lights nothing beyond
CROWDED = 0.4  # several lamps in one place give less than their sum
FALL_M = 5.5  # height that the fall of the light is computed for, whatever the pole's
MOST_NEAR = 16  # lamps that puddles mirror, as in the shader


def lamp_map(lamps: np.ndarray, middle: np.ndarray, half_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute the light of lamps over a square.

    Args:
        lamps: (n, 3) m; middle: (2,) m; half_m: half the square's side.
    Returns:
        (MAP_PX, MAP_PX, 2) float32: light on the ground, about 1 under a lamp, and the height of the lamps that give
        it; (4,) low x, low y, 1 / side, 1 / side. The outermost pixels are dark, so that nothing beyond is lit.
    """
    low = middle[:2] - half_m
    pixel_m = 2.0 * half_m / MAP_PX
    light = np.zeros((MAP_PX, MAP_PX))
    height = np.zeros((MAP_PX, MAP_PX))
    reach_px = int(np.ceil(REACH_M / pixel_m))
    for x, y, z in lamps:
        column, row = (x - low[0]) / pixel_m - 0.5, (y - low[1]) / pixel_m - 0.5
        rows = slice(max(0, int(row) - reach_px), max(0, int(row) + reach_px + 1))
        columns = slice(max(0, int(column) - reach_px), max(0, int(column) + reach_px + 1))
        v, u = np.ogrid[rows.start : min(rows.stop, MAP_PX), columns.start : min(columns.stop, MAP_PX)]
        away = ((u - column) ** 2 + (v - row) ** 2) * pixel_m**2
        share = np.maximum((FALL_M**2 / (FALL_M**2 + away)) ** 1.5 - (FALL_M / REACH_M) ** 3, 0.0)
        light[rows, columns] += share
        height[rows, columns] += share * z
    lamp_height = np.where(light > 0.0, height / np.maximum(light, 1e-12), 0.0)
    light /= 1.0 + CROWDED * light
    light[[0, -1]] = light[:, [0, -1]] = 0.0
    side = 0.5 / half_m
    return np.stack([light, lamp_height], axis=-1).astype(np.float32), np.array([*low, side, side])


# --- one trajectory ---------------------------------------------------------------------------------------------------

SOFT_M = 0.25  # wider borders of shadows are drawn soft
FAINT = 0.02  # a fainter sun casts no shadow
LAMP_UNIT, DEPTH_UNIT = 2, 3  # texture units
WIND = (0.07, 0.03)  # m to the side for each m that a drop falls
GLOW_FROM = 208  # brighter levels glow
GLOW_SHRINK = 4  # the glow is computed in a picture this many times smaller
GLOW_WIDTHS_PX = ((5.0, 0.22), (19.0, 0.16))  # width in a picture of 1280 px, share


def defines(params: WeatherParams) -> str:
    """Return the preprocessor lines of a weather's programs.

    A CPU runs both sides of a branch, so code that is not needed is not compiled.
    """
    values = uniforms(params)
    casts = float(values["sun_light"].max()) > FAINT
    needs = {
        "WEATHER": True, "WET": values["wetness"] > 0.0, "LIT": values["lights_on"] > 0.0, "SHADOWS": casts,
        "SOFT": casts and values["penumbra_m"] > SOFT_M,
    }  # fmt: skip
    return "".join(f"#define {name}\n" for name, is_needed in needs.items() if is_needed)


class WeatherPass:
    """The weather of a trajectory on one GL context."""

    def __init__(self, context: Any, color: Any, depth: Any, rain_program: Any, num_others: int) -> None:
        self._context = context
        self._depth = depth
        self._rain_program = rain_program
        self._num_others = num_others
        self._rain = context.vertex_array(rain_program, [])
        self._over_color = context.framebuffer([color])
        self._lamp_map = context.texture((MAP_PX, MAP_PX), 2, dtype="f4")
        self._lamp_map.repeat_x = self._lamp_map.repeat_y = False
        self.values: dict[str, Any] = {}

    def prepare(
        self, params: WeatherParams, parts: Parts, unseen_lamps: np.ndarray, middle: np.ndarray, half_m: float
    ) -> None:
        """Compute uniforms and lamp light for a square around `middle`, relative to the origin of the parts.

        Lamps of the parts are lit and mirrored in puddles. unseen_lamps: (n, 3), lamps that only give light.
        """
        self._lamps = parts.lamps()
        self.sun_direction = light_direction(params)
        lit = np.concatenate([self._lamps, unseen_lamps])
        near = lit[(np.abs(lit[:, :2] - middle[:2]) < half_m + REACH_M).all(axis=1)]
        light, area = lamp_map(near, middle, half_m)
        self._lamp_map.write(light.tobytes())
        self.values = {
            **uniforms(params),
            "sun_direction": self.sun_direction,
            "lamp_area": area,
            "lamp_map": LAMP_UNIT,
            "lowest_other": MAX_BOX_ID - self._num_others + 1,
            "highest_other": MAX_BOX_ID,
            "wind": np.array(WIND),
            "depth_map": DEPTH_UNIT,
        }

    @property
    def has_lights(self) -> bool:
        return bool(self.values["lights_on"] > 0.0)

    def frame_values(self, eye: np.ndarray, camera_pose: np.ndarray, person: PosedPerson | None) -> dict[str, Any]:
        """Return the uniforms of one frame: the trajectory's, lamps near the camera, and the places of drops."""
        away = np.linalg.norm(self._lamps - eye, axis=1)
        rows = np.argsort(away, kind="stable")[:MOST_NEAR]
        rows = rows[away[rows] < 120.0]
        lamps = np.zeros((MOST_NEAR, 4), np.float32)  # places, and strength: far ones fade out
        lamps[: len(rows), :3] = self._lamps[rows]
        lamps[: len(rows), 3] = np.clip(1.6 - away[rows] / 75.0, 0.0, 1.0)
        # Drops differ from frame to frame, and are the same when a frame is drawn again.
        hip_m = np.zeros(3) if person is None else np.asarray(person.hip_m, dtype=np.float64)
        seen = np.ascontiguousarray(camera_pose, dtype=np.float64).tobytes() + hip_m.tobytes()
        return {
            **self.values,
            "rain_phase": zlib.crc32(seen) % 9973 / 9973.0,
            "lamps": lamps.T,
            "num_lamps": len(rows) if self.has_lights and self.values["wetness"] > 0.0 else 0,
        }

    def use(self) -> None:
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
        """Return the picture with the glow of lights, (h, w, 3) uint8: by night, and more in wet air."""
        if not self.has_lights:
            return rgb
        small = cv2.resize(rgb, None, fx=1 / GLOW_SHRINK, fy=1 / GLOW_SHRINK, interpolation=cv2.INTER_AREA)
        bright = np.maximum(small.astype(np.float32) - GLOW_FROM, 0.0) * (255.0 / (255.0 - GLOW_FROM))
        hazy = 1.0 - float(np.exp(-60.0 * self.values["fog"][0]))
        glow = np.zeros_like(bright)
        for width_px, share in GLOW_WIDTHS_PX:
            sigma = width_px * (1.0 + hazy) * rgb.shape[1] / 1280.0 / GLOW_SHRINK
            glow += share * (1.0 + 1.5 * hazy) * cv2.GaussianBlur(bright, (0, 0), max(sigma, 0.3))
        glow = np.clip(self.values["lights_on"] * glow, 0.0, 255.0).astype(np.uint8)
        return cv2.add(rgb, cv2.resize(glow, rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR))
