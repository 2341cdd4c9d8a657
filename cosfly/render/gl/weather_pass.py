"""What weather adds to the default renderer: its uniforms, the map of street lamps, rain over the picture, the glow of lights.

Programs of other than fair weather are made with what the weather needs (`programs`): who asks for no weather pays nothing for it. Nothing here writes depth, kinds or ids.
"""

from __future__ import annotations

import zlib
from typing import Any

import cv2
import numpy as np

from cosfly.products.weather import WeatherParams
from cosfly.render.contract import MAX_BOX_ID, PosedPerson
from cosfly.render.gl import lamps as street_lamps
from cosfly.render.gl.atmosphere import light_direction, uniforms
from cosfly.render.gl.parts import Parts
from cosfly.render.gl.programs import set_uniform

SOFT_M, FAINT = 0.25, 0.02  # from such a border on a shadow is drawn soft; a sun of less light throws none
LAMP_UNIT, DEPTH_UNIT = 2, 3
WIND = (0.07, 0.03)  # m to the side for each m that a drop falls
GLOW_FROM, GLOW_SHRINK = (
    208,
    4,
)  # levels that shine beyond their place; the glow is computed in a picture so many times smaller
GLOW_WIDTHS_PX = ((5.0, 0.22), (19.0, 0.16))  # of a picture of 1280 px: width, share


def defines(params: WeatherParams) -> str:
    """Say what a weather's programs must know, as preprocessor lines: a CPU runs both sides of every branch, so what is not needed is left out."""
    values = uniforms(params)
    casts = float(values["sun_light"].max()) > FAINT
    needs = {
        "WEATHER": True, "WET": values["wetness"] > 0.0, "LIT": values["lights_on"] > 0.0, "SHADOWS": casts,
        "SOFT": casts and values["penumbra_m"] > SOFT_M,
    }  # fmt: skip
    return "".join(f"#define {name}\n" for name, is_needed in needs.items() if is_needed)


class WeatherPass:
    """The weather of a flight on one GL context."""

    def __init__(self, context: Any, color: Any, depth: Any, rain_program: Any, num_others: int) -> None:
        self._context = context
        self._depth, self._rain_program = depth, rain_program
        self._rain = context.vertex_array(rain_program, [])
        self._over_color = context.framebuffer([color])
        self._lamps = np.zeros((0, 3))
        self._lamp_map = context.texture((street_lamps.MAP_PX, street_lamps.MAP_PX), 2, dtype="f4")
        self._lamp_map.repeat_x = self._lamp_map.repeat_y = False
        self._lamp_area = np.zeros(4)
        self._num_others = num_others
        self.values: dict[str, Any] = {}
        self.sun_direction = np.zeros(3)

    def prepare(
        self, params: WeatherParams, parts: Parts, unseen_lamps: np.ndarray, middle: np.ndarray, half_m: float
    ) -> None:
        """Get ready for a flight over a square round `middle`, relative to the zero of the parts, whose lamps are lit and mirrored in
        puddles. unseen_lamps: (n, 3), of those that only throw light."""
        self._lamps = street_lamps.lamps_of(parts)
        lit = np.concatenate([self._lamps, unseen_lamps])
        self.values, self.sun_direction = uniforms(params), light_direction(params)
        near = lit[(np.abs(lit[:, :2] - middle[:2]) < half_m + street_lamps.REACH_M).all(axis=1)]
        light, self._lamp_area = street_lamps.lamp_map(near, middle, half_m)
        self._lamp_map.write(light.tobytes())

    @property
    def has_lights(self) -> bool:
        return bool(self.values["lights_on"] > 0.0)

    def frame_values(self, eye: np.ndarray, camera_pose: np.ndarray, person: PosedPerson | None) -> dict[str, Any]:
        """Give the uniforms of one frame: those of the flight, those of the lamps near the camera, and where drops fall."""
        lamps, count = street_lamps.nearest_lamps(self._lamps, eye)
        # Drops fall anew in each frame, and in the same places when it is drawn again.
        hip_m = np.zeros(3) if person is None else np.asarray(person.hip_m, dtype=np.float64)
        seen = np.ascontiguousarray(camera_pose, dtype=np.float64).tobytes() + hip_m.tobytes()
        return {
            **self.values, "rain_phase": zlib.crc32(seen) % 9973 / 9973.0, "sun_direction": self.sun_direction, "lamp_area": self._lamp_area, "lamp_map": LAMP_UNIT, "lamps": lamps.T,
            "num_lamps": count if self.has_lights and self.values["wetness"] > 0.0 else 0,
            "lowest_other": MAX_BOX_ID - self._num_others + 1, "highest_other": MAX_BOX_ID,
        }  # fmt: skip

    def use(self) -> None:
        self._lamp_map.use(LAMP_UNIT)

    def draw_rain(self, frame_values: dict[str, Any]) -> None:
        """Draw the drops over the colours of a finished frame; frame_values: its uniforms, the camera's among them."""
        if self.values["precipitation"] <= 0.0:
            return
        context = self._context
        self._over_color.use()
        context.enable_only(context.BLEND)
        context.blend_func = context.SRC_ALPHA, context.ONE_MINUS_SRC_ALPHA
        self._depth.use(DEPTH_UNIT)
        for name, value in {**frame_values, "wind": np.array(WIND), "depth_map": DEPTH_UNIT}.items():
            set_uniform(self._rain_program, name, value)
        self._rain.render(vertices=3)

    def glowing(self, rgb: np.ndarray) -> np.ndarray:
        """Let lights shine beyond their place, (h, w, 3) uint8: by night, and more in wet air."""
        if not self.has_lights:
            return rgb
        small = cv2.resize(rgb, None, fx=1 / GLOW_SHRINK, fy=1 / GLOW_SHRINK, interpolation=cv2.INTER_AREA)
        bright = np.maximum(small.astype(np.float32) - GLOW_FROM, 0.0) * (255.0 / (255.0 - GLOW_FROM))
        hazy = 1.0 - float(np.exp(-60.0 * self.values["fog"][0]))
        glow = np.zeros_like(bright)
        for width_px, share in GLOW_WIDTHS_PX:
            sigma = width_px * (1.0 + hazy) * rgb.shape[1] / 1280.0 / GLOW_SHRINK
            glow += share * (1.0 + 1.5 * hazy) * cv2.GaussianBlur(bright, (0, 0), max(sigma, 0.3))
        wide = cv2.resize(
            np.clip(self.values["lights_on"] * glow, 0.0, 255.0).astype(np.uint8),
            rgb.shape[1::-1],
            interpolation=cv2.INTER_LINEAR,
        )
        return cv2.add(rgb, wide)
