"""The figure of a depth study: what is seen of the frame in each coding, where the errors lie, and a row of pixels from the side."""

from __future__ import annotations

import cv2
import numpy as np

from cosfly.frame_views import depth_colors
from cosfly.topview import INK, PAPER, Color, draw_line, draw_text, png_bytes

PANEL_PX = (480, 270)  # width, height of each of six
GAP_PX, TITLE_PX = 14, 30
PROFILE_COLORS: dict[str, Color] = {"8-bit": (215, 60, 50), "10-bit": (240, 150, 40), "truth": (30, 30, 30)}
PROFILE_PX = 160  # pixels of a row that the profile shows: more, and no step is seen


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
        ("(a) colours", np.full((*truth.shape, 3), PAPER, np.uint8) if rgb is None else rgb),
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


def smoothest_row(truth: np.ndarray, measured: np.ndarray) -> tuple[int, int]:
    """Give row and first column of the stretch of PROFILE_PX measured pixels that is smoothest: there steps are seen best."""
    length = min(PROFILE_PX, truth.shape[1])
    steps = np.abs(np.diff(np.where(measured, truth, np.nan).astype(np.float64), n=2, axis=1))
    best, place = np.inf, (truth.shape[0] // 2, 0)
    for y in range(0, truth.shape[0], max(1, truth.shape[0] // 60)):
        for x in range(0, truth.shape[1] - length + 1, max(1, length // 2)):
            part = steps[y, x : x + length - 2]
            span = abs(float(truth[y, x + length - 1]) - float(truth[y, x]))
            if not np.isnan(part).any() and span > 0 and part.max(initial=0.0) / span < best:
                best, place = part.max(initial=0.0) / span, (y, x)
    return place


def _profile(truth: np.ndarray, measured: np.ndarray, decoded: dict[str, np.ndarray]) -> np.ndarray:
    """Draw the depth along a stretch of a row, in 8 bits, 10 bits and as it is."""
    y, x = smoothest_row(truth, measured)
    length = min(PROFILE_PX, truth.shape[1])
    width, height = PANEL_PX
    panel = np.full((height, width, 3), 255, np.uint8)
    curves = {
        name: (truth if name == "truth" else decoded[name])[y, x : x + length].astype(np.float64)
        for name in PROFILE_COLORS
    }
    low, high = (edge(curve.min() if edge is min else curve.max() for curve in curves.values()) for edge in (min, max))
    columns = 50.0 + np.arange(length) * (width - 70.0) / max(1, length - 1)
    for name, curve in curves.items():
        rows = height - 30.0 - (curve - low) / ((high - low) or 1.0) * (height - 60.0)
        draw_line(panel, np.stack([columns, rows], axis=1), PROFILE_COLORS[name], 2 if name == "truth" else 1)
    left = 60
    for name, color in PROFILE_COLORS.items():
        left = draw_text(panel, name, left, 18, 0.45, color) + 16
    draw_text(panel, f"{high:.2f} m", 4, 34, 0.35, INK)
    draw_text(panel, f"{low:.2f} m", 4, height - 28, 0.35, INK)
    draw_text(panel, f"row {y}, columns {x} to {x + length - 1}", 60, height - 8, 0.4, INK)
    return panel
