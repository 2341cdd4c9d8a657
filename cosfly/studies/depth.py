"""`cosfly study depth`: ways to store the depth of one frame (tab:depth_format_comparison, fig:depth_comparison).

Integers of 8 to 16 bits divide the frame's own range evenly, as in the paper. The reference is the file's float32.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cosfly.formats.frames import INVALID_DEPTH_M, SKY_DEPTH_M, frame_path, read_depth, read_rgb
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import FileFormat, write_json
from cosfly.viz.frame_views import depth_colors
from cosfly.viz.tables import TextTable
from cosfly.viz.topview import Color, captioned_grid, draw_line, draw_text, png_bytes

FORMAT = FileFormat("cosfly.depth_study", "2.0")
BITS = (8, 10, 12, 16)
ENTROPY_BINS = 8192  # of the frame's range, the same for all codings: nearly all exact values of a float differ
CM = 100.0
KB = 1024.0  # bytes, as in the paper's column
PANEL_PX = (480, 270)  # width, height
PROFILE_COLORS: dict[str, Color] = {"truth": (30, 30, 30), "10-bit": (240, 150, 40), "8-bit": (215, 60, 50)}
# Figures of a coding over the measured pixels -> column of the table and form of its numbers. Errors are against the
# reference; psnr_db: relative to the frame's range, None without an error; edges: Pearson correlation of Sobel
# gradients; kilobytes: of the frame in memory.
COLUMNS = {
    "coding": ("coding", "{}"), "unique": ("unique values", "{:,}"), "max_cm": ("max error, cm", "{:.4g}"),
    "mean_cm": ("mean error, cm", "{:.4g}"), "rmse_cm": ("RMSE, cm", "{:.4g}"), "psnr_db": ("PSNR, dB", "{:.1f}"),
    "entropy_bits": ("entropy, bits", "{:.2f}"), "edges": ("edge correlation", "{:.6f}"),
    "kilobytes": ("size, KB of 1,024 bytes", "{:,.0f}"),
}  # fmt: skip


def run(frame: Path, out: Path) -> dict[str, Any]:
    """Read a frame folder; write `depth_study.json`, which is returned, `.md` and `.png`."""
    file = frame_path(frame, "depth.npy")
    truth = read_depth(frame)
    truth = np.where(np.isfinite(truth), truth, truth.dtype.type(INVALID_DEPTH_M))
    study, decoded = study_of(truth, "/".join(file.absolute().parts[-2:]))
    write_json(out / "depth_study.json", {**FORMAT.header, **study})
    write_bytes(out / "depth_study.md", markdown(study).encode())
    rgb = read_rgb(frame) if (frame / "rgb.png").exists() else np.full((*truth.shape, 3), 255, np.uint8)
    write_bytes(out / "depth_study.png", draw_study(rgb, truth, is_measured(truth), decoded))
    return study


def is_measured(truth: np.ndarray) -> np.ndarray:
    """Return which pixels are neither sky nor invalid, (h, w) bool."""
    return (truth != INVALID_DEPTH_M) & (truth != SKY_DEPTH_M)


def study_of(truth: np.ndarray, frame: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the figures of a depth image, (h, w) m, and by coding the depth that it decodes to."""
    measured = is_measured(truth)
    depths = truth[measured]
    if not depths.size or depths.min() == depths.max() or depths.min() < 0:
        got = f"{depths.min():g} to {depths.max():g} m" if depths.size else "no measured pixel"
        what, expected = "the depth image has too few different depths", "at least two different depths of 0 m or more"
        raise InputError(what, where=frame, got=got, expected=expected)
    decoded = {f"{bits}-bit": quantised(truth, measured, bits)[1] for bits in BITS}
    decoded["32-bit float"] = truth.astype(np.float32).astype(np.float64)
    sizes = zip(decoded.items(), (*BITS, 32), strict=True)
    return {
        "frame": frame, "width_px": truth.shape[1], "height_px": truth.shape[0],
        "truth": str(truth.dtype), "min_m": float(depths.min()), "max_m": float(depths.max()),
        "share_measured": float(measured.mean()),  # of the pixels: neither sky nor invalid
        "rows": [_row(coding, bits, values, truth, measured) for (coding, values), bits in sizes],
    }, decoded  # fmt: skip


def quantised(truth: np.ndarray, measured: np.ndarray, bits: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the codes of integers that share the frame's range evenly, and the depth that they decode to.

    Args:
        truth: (h, w) m. measured: (h, w) bool; other pixels get code 0 and keep their depth.
    """
    low, high = float(truth[measured].min()), float(truth[measured].max())
    step_m = (high - low) / (2**bits - 1)
    codes = np.where(measured, np.rint((truth.astype(np.float64) - low) / step_m), 0).astype(np.uint16)
    return codes, np.where(measured, low + codes * step_m, truth.astype(np.float64))


def _row(coding: str, bits: int, values: np.ndarray, truth: np.ndarray, measured: np.ndarray) -> dict[str, Any]:
    """Return the figures of one coding, which decodes to `values`, (h, w) m."""
    expected = truth[measured].astype(np.float64)
    decoded = values[measured]
    errors = np.abs(decoded - expected)
    rmse = float(np.sqrt(np.mean(errors**2)))
    low, high = float(expected.min()), float(expected.max())
    counts = np.histogram(decoded, bins=ENTROPY_BINS, range=(low, high))[0]
    shares = counts[counts > 0] / counts.sum()
    return {
        "coding": coding, "unique": len(np.unique(decoded)), "max_cm": float(errors.max()) * CM,
        "mean_cm": float(errors.mean()) * CM, "rmse_cm": rmse * CM,
        "psnr_db": 20.0 * float(np.log10((high - low) / rmse)) if rmse else None,
        "entropy_bits": float(-(shares * np.log2(shares)).sum()),
        "edges": _edge_correlation(values, truth.astype(np.float64), measured),
        "kilobytes": truth.size * bits / 8.0 / KB,
    }  # fmt: skip


def _edge_correlation(values: np.ndarray, truth: np.ndarray, measured: np.ndarray) -> float:
    """Return Pearson's correlation of Sobel gradient lengths where the whole 3 x 3 window is measured; 1 if nowhere."""
    window = np.ones((3, 3), np.uint8)
    inner = cv2.erode(measured.astype(np.uint8), window, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    slopes = [[cv2.Sobel(image, cv2.CV_64F, *axis) for axis in ((1, 0), (0, 1))] for image in (values, truth)]
    lengths = [np.hypot(*pair)[inner] for pair in slopes]
    if not inner.any() or min(length.std() for length in lengths) == 0:
        return 1.0
    return float(np.corrcoef(lengths)[0, 1])


def markdown(study: dict[str, Any]) -> str:
    """Return the table of the study in the paper's columns."""
    pairs = [[(row[name], form) for name, (_, form) in COLUMNS.items()] for row in study["rows"]]
    texts = [["no error" if value is None else form.format(value) for value, form in row] for row in pairs]
    size = f"{study['width_px']} x {study['height_px']} px"
    ends = f"{study['min_m']:.2f} to {study['max_m']:.2f} m"
    measured = f"{study['share_measured']:.1%} of the pixels measured; errors against {study['truth']}."
    table = TextTable("", [title for title, _ in COLUMNS.values()], texts)
    return f"Depth of `{study['frame']}`, {size}, {ends}, {measured}\n\n{table.markdown()}"


def draw_study(rgb: np.ndarray, truth: np.ndarray, measured: np.ndarray, decoded: dict[str, np.ndarray]) -> bytes:
    """Draw the frame, its depth, the error of 8 bits and the middle row; return a PNG.

    Args:
        rgb: (h, w, 3) uint8. truth: (h, w) m. measured: (h, w) bool. decoded: coding -> the depth that it decodes to.
    """
    errors = np.where(measured, np.abs(decoded["8-bit"] - truth), 0.0)
    level = np.round(errors / (errors.max() or 1.0) * 255.0).astype(np.uint8)
    low, high = float(truth[measured].min()), float(truth[measured].max())
    y = truth.shape[0] // 2
    columns = np.flatnonzero(measured[y])
    profile = np.full((*PANEL_PX[::-1], 3), 255, np.uint8)
    name_x = 10
    for name, color in PROFILE_COLORS.items():
        depth = (truth if name == "truth" else decoded[name])[y, columns].astype(np.float64)
        rows = PANEL_PX[1] - 10.0 - (depth - low) / (high - low) * (PANEL_PX[1] - 40.0)
        if len(columns) > 1:
            draw_line(profile, np.stack([columns * PANEL_PX[0] / truth.shape[1], rows], axis=1), color)
        name_x = draw_text(profile, name, name_x, 18, 0.45, color) + 16
    panels = [
        ("(a) colours", rgb),
        (f"(b) float32, inferno reversed, to {high:.0f} m", depth_colors(truth.astype(np.float32), high)),
        (
            f"(c) error of 8 bits: up to {errors.max() * CM:.2g} cm",
            np.ascontiguousarray(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO)[..., ::-1]),
        ),
        ("(d) middle row", profile),
    ]
    return png_bytes(captioned_grid(panels, 2, PANEL_PX))
