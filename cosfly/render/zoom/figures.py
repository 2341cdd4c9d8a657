"""The study's pictures: flights by levels of zoom (fig:zoom_demo), and optical beside digital zoom (fig:zoom_fidelity)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from cosfly.look.topview import add_caption
from cosfly.products.frames import level_name, rgb_bytes
from cosfly.render.contract import Renderer
from cosfly.render.flight import FlightScript, draw_frame
from cosfly.render.zoom.fidelity import compare
from cosfly.render.zoom.study import ZoomStudyConfig, at_level, camera_of, optical_and_digital, ready

MOST_FLIGHTS = 4
TILE_WIDTH_PX, PANEL_WIDTH_PX = 480, 960
BOX_COLOR = (255, 40, 40)


def draw_levels(renderer: Renderer, shown: Sequence[tuple[FlightScript, int]], cfg: ZoomStudyConfig) -> bytes:
    """Draw one frame of up to four flights, a row each, at every level, widest first; a PNG.

    Args:
        shown: flights, and which of their frames.
    """
    rows = []
    picked = np.unique(np.linspace(0, len(shown) - 1, min(len(shown), MOST_FLIGHTS)).round().astype(int))
    for script, i in (shown[k] for k in picked.tolist()):
        ready(renderer, script)
        tiles = []
        for fov in cfg.levels_deg:
            drawn = at_level(script, camera_of(cfg, fov))
            frame, seen = draw_frame(renderer, drawn, i, script.perturbed.poses, cfg.visible_threshold)
            rgb = frame.rgb.copy()
            if seen.view.in_view:
                x0, y0, x1, y1 = seen.view.bbox_px.round().astype(int).tolist()
                cv2.rectangle(rgb, (x0, y0), (x1, y1), (255, 214, 10), max(1, cfg.width_px // 640))
            size = "" if not seen.view.in_view else f", target {x1 - x0} x {y1 - y0} px"
            tiles.append(add_caption(_scaled(rgb, TILE_WIDTH_PX), f"{level_name(fov)} {fov:g} deg{size}"))
        rows.append(np.hstack(tiles))
    return rgb_bytes(np.vstack(rows))


def draw_fidelity(renderer: Renderer, script: FlightScript, i: int, cfg: ZoomStudyConfig) -> bytes:
    """Draw the widest picture with the part that is enlarged most, the digital enlargements of it, and what a longer lens shows; a PNG."""
    ready(renderer, script)
    wide = at_level(script, camera_of(cfg, cfg.levels_deg[0]))
    rgb = draw_frame(renderer, wide, i, script.perturbed.poses, 0.0)[0].rgb.copy()
    most = max(cfg.magnifications)
    optical, digital = optical_and_digital(renderer, script, i, cfg)[f"{most:g}"]
    (width, height), half = (cfg.width_px, cfg.height_px), 0.5 / most
    corner, other = (round(width * (0.5 - half)), round(height * (0.5 - half))), (round(width * (0.5 + half)), round(height * (0.5 + half)))  # fmt: skip
    cv2.rectangle(rgb, corner, other, BOX_COLOR, max(2, width // 400))
    panels = [(rgb, f"{cfg.levels_deg[0]:g} deg, 1.0x")]
    for kernel, picture in digital.items():
        found = compare(picture, optical)
        panels.append((picture, f"digital {most:g}x, {kernel}: {found.psnr_db:.1f} dB, SSIM {found.ssim:.2f}, sharpness {found.sharpness:.2f}"))  # fmt: skip
    panels.append((optical, f"optical {most:g}x"))
    tiles = [add_caption(_scaled(picture, PANEL_WIDTH_PX), title) for picture, title in panels]
    return rgb_bytes(np.vstack([np.hstack(tiles[:2]), np.hstack(tiles[2:])]))


def _scaled(rgb: np.ndarray, width_px: int) -> np.ndarray:
    height_px = max(1, round(width_px * rgb.shape[0] / rgb.shape[1]))
    method = cv2.INTER_AREA if rgb.shape[1] > width_px else cv2.INTER_NEAREST
    return cv2.resize(rgb, (width_px, height_px), interpolation=method)
