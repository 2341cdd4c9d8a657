"""The figure of a depth study: what is seen of the frame in each coding, where the errors lie, and a row of pixels from the side."""

from __future__ import annotations

import cv2
import numpy as np

from cosfly.look.frame_views import depth_colors
from cosfly.look.topview import INK, PAPER, Color, draw_line, draw_text, png_bytes

PANEL_PX = (480, 270)  # width, height of each of six
GAP_PX, TITLE_PX = 14, 30
PROFILE_COLORS: dict[str, Color] = {"8-bit": (215, 60, 50), "10-bit": (240, 150, 40), "truth": (30, 30, 30)}
MOST_PROFILE_PX, LEAST_PROFILE_PX = 160, 16  # of a row
PROFILE_STEPS = 6.0  # of 8 bits: of more none is seen


def draw_study(
    rgb: np.ndarray | None, truth: np.ndarray, measured: np.ndarray, decoded: dict[str, np.ndarray]
) -> bytes:
    """Draw six panels; PNG bytes.

    Args:
        rgb: (h, w, 3) uint8 of the frame, None where there is none. truth: (h, w) m; measured: (h, w) bool.
        decoded: name of a coding -> the depth that comes back.
    """
    low, high = float(truth[measured].min()), float(truth[measured].max())
    grey = np.where(measured, np.clip((decoded["8-bit"] - low) / (high - low), 0, 1) * 255.0, 0).astype(np.uint8)
    fine = "32-bit float" if "64-bit float" in decoded else "16-bit"
    panels = [
        (
            "(a) colours" if rgb is not None else "(a) no colours beside it",
            np.full((*truth.shape, 3), PAPER, np.uint8) if rgb is None else rgb,
        ),
        ("(b) 8 bits, as grey", cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)),
        (f"(c) float32, inferno reversed, to {high:.0f} m", depth_colors(truth.astype(np.float32), high)),
        _errors("(d) error of 8 bits", decoded["8-bit"], truth, measured),
        _errors(f"(e) error of {fine}", decoded[fine], truth, measured),
        ("(f) a row, from the side", _profile(truth, measured, decoded)),
    ]
    width, height = PANEL_PX
    picture = np.full((2 * (height + TITLE_PX + GAP_PX) + GAP_PX, 3 * (width + GAP_PX) + GAP_PX, 3), PAPER, np.uint8)
    for k, (title, panel) in enumerate(panels):
        x, y = GAP_PX + (k % 3) * (width + GAP_PX), GAP_PX + (k // 3) * (height + TITLE_PX + GAP_PX)
        draw_text(picture, title, x, y + 20, 0.5)
        picture[y + TITLE_PX : y + TITLE_PX + height, x : x + width] = cv2.resize(
            panel, PANEL_PX, interpolation=cv2.INTER_AREA
        )
    return png_bytes(picture)


def _errors(title: str, values: np.ndarray, truth: np.ndarray, measured: np.ndarray) -> tuple[str, np.ndarray]:
    """Give a map of errors with its title, bright where they are greatest."""
    errors = np.where(measured, np.abs(values - truth), 0.0)
    most = float(errors.max())
    level = np.round(errors / (most or 1.0) * 255.0).astype(np.uint8)
    shown = cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    return f"{title}, up to {most * 100:.3g} cm", shown


def steady_stretch(truth: np.ndarray, measured: np.ndarray) -> tuple[int, int, int]:
    """Give row, first column and length of a stretch of measured pixels whose depth changes evenly, by about PROFILE_STEPS of 8 bits and slowly."""
    known = truth[measured]
    step_m = float(known.max() - known.min()) / 255.0
    depth = np.where(measured, truth, np.nan).astype(np.float64)
    best, place = np.inf, (truth.shape[0] // 2, 0, min(MOST_PROFILE_PX, truth.shape[1]))
    for y in range(0, truth.shape[0], max(1, truth.shape[0] // 60)):
        for length in (MOST_PROFILE_PX, MOST_PROFILE_PX // 3, LEAST_PROFILE_PX):
            for x in range(0, truth.shape[1] - length + 1, max(1, length // 2)):
                part = depth[y, x : x + length]
                steps = abs(part[-1] - part[0]) / step_m
                if not steps > 0 or np.isnan(part).any():
                    continue
                uneven = float(np.abs(part - np.linspace(part[0], part[-1], length)).max()) / step_m
                if (badness := abs(np.log(steps / PROFILE_STEPS)) + uneven + 4.0 * steps / length) < best:
                    best, place = badness, (y, x, length)
    return place


def _profile(truth: np.ndarray, measured: np.ndarray, decoded: dict[str, np.ndarray]) -> np.ndarray:
    """Draw the depth along a stretch of a row: as it is, as a line, and over that in 8 and 10 bits, a step at each pixel."""
    y, x, length = steady_stretch(truth, measured)
    width, height = PANEL_PX
    panel = np.full((height, width, 3), 255, np.uint8)
    curves = {
        name: (truth if name == "truth" else decoded[name])[y, x : x + length].astype(np.float64)
        for name in PROFILE_COLORS
    }
    low, high = (edge(curve.min() if edge is min else curve.max() for curve in curves.values()) for edge in (min, max))
    edges = 50.0 + np.arange(length + 1) * (width - 70.0) / length
    for name in reversed(PROFILE_COLORS):
        rows = height - 30.0 - (curves[name] - low) / ((high - low) or 1.0) * (height - 60.0)
        if name == "truth":
            places = np.stack([(edges[1:] + edges[:-1]) / 2.0, rows], axis=1)
        else:
            places = np.stack([np.repeat(edges, 2)[1:-1], np.repeat(rows, 2)], axis=1)
        draw_line(panel, places, PROFILE_COLORS[name], 3 if name == "truth" else 1)
    left = 60
    for name, color in PROFILE_COLORS.items():
        left = draw_text(panel, name, left, 18, 0.45, color) + 16
    draw_text(panel, f"{high:.2f} m", 4, 34, 0.35, INK)
    draw_text(panel, f"{low:.2f} m", 4, height - 28, 0.35, INK)
    draw_text(panel, f"row {y}, columns {x} to {x + length - 1}", 60, height - 8, 0.4, INK)
    return panel
