"""`cosfly study depth`: ways to store the depth of one frame (tab:depth_format_comparison, fig:depth_comparison).

Integers of 8 to 16 bits divide the frame's own range evenly, as in the paper. The reference is the file's float32.
"""

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
BITS_OF = {**{f"{bits}-bit": bits for bits in BITS}, "32-bit float": 32}  # coding -> bits of a pixel
ENTROPY_BINS = 8192  # of the frame's range, the same for all codings: nearly all exact values of a float differ
CM_PER_M = 100.0
BYTES_PER_KB = 1024.0  # as in the paper's column
PANEL_PX = (480, 270)  # width, height
PROFILE_TOP_PX, PROFILE_BOTTOM_PX = 30.0, 10.0  # margins of the profile: its legend is above
LEGEND_LEFT_PX, LEGEND_BASELINE_PX, LEGEND_GAP_PX, LEGEND_SCALE = 10, 18, 16, 0.45
PROFILE_COLORS: dict[str, Color] = {"truth": (30, 30, 30), "10-bit": (240, 150, 40), "8-bit": (215, 60, 50)}
# Figure of a coding over the measured pixels -> title of its column and format. Errors are against the reference.
COLUMNS = {
    "coding": ("coding", "{}"),
    "unique": ("unique values", "{:,}"),
    "max_cm": ("max error, cm", "{:.4g}"),
    "mean_cm": ("mean error, cm", "{:.4g}"),
    "rmse_cm": ("RMSE, cm", "{:.4g}"),
    "psnr_db": ("PSNR, dB", "{:.1f}"),  # relative to the frame's range; None without an error
    "entropy_bits": ("entropy, bits", "{:.2f}"),  # of the histogram of ENTROPY_BINS
    "edges": ("edge correlation", "{:.6f}"),  # Pearson's, of Sobel gradients
    "kilobytes": ("size, KB of 1,024 bytes", "{:,.0f}"),  # of the frame in memory
}


def run(frame: Path, out: Path) -> dict[str, Any]:
    """Read a frame folder; write `depth_study.json`, which is returned, `.md` and `.png`."""
    file = frame_path(frame, "depth.npy")
    reference_m = read_depth(frame)
    reference_m = np.where(np.isfinite(reference_m), reference_m, reference_m.dtype.type(INVALID_DEPTH_M))
    study, decoded_m = study_of(reference_m, "/".join(file.absolute().parts[-2:]))
    write_json(out / "depth_study.json", {**FORMAT.header, **study})
    write_bytes(out / "depth_study.md", markdown(study).encode())
    rgb = read_rgb(frame) if (frame / "rgb.png").exists() else np.full((*reference_m.shape, 3), 255, np.uint8)
    write_bytes(out / "depth_study.png", draw_study(rgb, reference_m, decoded_m))
    return study


def is_measured(reference_m: np.ndarray) -> np.ndarray:
    """Return which pixels are neither sky nor invalid, (h, w) bool."""
    return (reference_m != INVALID_DEPTH_M) & (reference_m != SKY_DEPTH_M)


def study_of(reference_m: np.ndarray, frame: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the figures of a depth image, (h, w) m, and by coding the depth that it decodes to, (h, w) m."""
    measured = is_measured(reference_m)
    depths_m = reference_m[measured]
    _check_depths(depths_m, frame)
    decoded_m = dict[str, np.ndarray]()
    for bits in BITS:
        _, decoded_m[f"{bits}-bit"] = quantised(reference_m, measured, bits)
    decoded_m["32-bit float"] = reference_m.astype(np.float32).astype(np.float64)
    return {
        "frame": frame, "width_px": reference_m.shape[1], "height_px": reference_m.shape[0],
        "truth": str(reference_m.dtype), "min_m": float(depths_m.min()), "max_m": float(depths_m.max()),
        "share_measured": float(measured.mean()),  # of the pixels: neither sky nor invalid
        "rows": [_row(coding, depth_m, reference_m, measured) for coding, depth_m in decoded_m.items()],
    }, decoded_m  # fmt: skip


def _check_depths(depths_m: np.ndarray, frame: str) -> None:
    if not depths_m.size or depths_m.min() == depths_m.max() or depths_m.min() < 0:
        got = f"{depths_m.min():g} to {depths_m.max():g} m" if depths_m.size else "no measured pixel"
        what = "the depth image needs two different depths"
        raise InputError(what, where=frame, got=got, expected="at least two different depths, none below 0 m")


def quantised(reference_m: np.ndarray, measured: np.ndarray, bits: int) -> tuple[np.ndarray, np.ndarray]:
    """Return integer codes that share the frame's range evenly, (h, w) uint16, and the depth that they decode to, m.

    Args:
        reference_m: (h, w). measured: (h, w) bool; other pixels get code 0 and keep their depth.
    """
    low_m, high_m = float(reference_m[measured].min()), float(reference_m[measured].max())
    step_m = (high_m - low_m) / (2**bits - 1)
    exact_m = reference_m.astype(np.float64)
    codes = np.where(measured, np.rint((exact_m - low_m) / step_m), 0).astype(np.uint16)
    return codes, np.where(measured, low_m + codes * step_m, exact_m)


def _row(coding: str, decoded_m: np.ndarray, reference_m: np.ndarray, measured: np.ndarray) -> dict[str, Any]:
    """Return the figures of one coding; decoded_m, reference_m: (h, w)."""
    exact_m = reference_m.astype(np.float64)
    errors_m = np.abs(decoded_m - exact_m)[measured]
    rmse_m = float(np.sqrt(np.mean(errors_m**2)))
    low_m, high_m = float(exact_m[measured].min()), float(exact_m[measured].max())
    counts = np.histogram(decoded_m[measured], bins=ENTROPY_BINS, range=(low_m, high_m))[0]
    shares = counts[counts > 0] / counts.sum()
    return {
        "coding": coding, "unique": len(np.unique(decoded_m[measured])), "max_cm": float(errors_m.max()) * CM_PER_M,
        "mean_cm": float(errors_m.mean()) * CM_PER_M, "rmse_cm": rmse_m * CM_PER_M,
        "psnr_db": 20.0 * float(np.log10((high_m - low_m) / rmse_m)) if rmse_m else None,
        "entropy_bits": float(-(shares * np.log2(shares)).sum()),
        "edges": _edge_correlation(decoded_m, exact_m, measured),
        "kilobytes": reference_m.size * BITS_OF[coding] / 8.0 / BYTES_PER_KB,
    }  # fmt: skip


def _edge_correlation(decoded_m: np.ndarray, exact_m: np.ndarray, measured: np.ndarray) -> float:
    """Return Pearson's correlation of Sobel gradient lengths where the whole 3 x 3 window is measured; 1 if nowhere."""
    window = np.ones((3, 3), np.uint8)
    inner = cv2.erode(measured.astype(np.uint8), window, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    lengths = [
        np.hypot(cv2.Sobel(depth_m, cv2.CV_64F, 1, 0), cv2.Sobel(depth_m, cv2.CV_64F, 0, 1))[inner]
        for depth_m in (decoded_m, exact_m)
    ]
    if not inner.any() or min(length.std() for length in lengths) == 0:
        return 1.0
    return float(np.corrcoef(lengths)[0, 1])


def markdown(study: dict[str, Any]) -> str:
    """Return the table of the study in the paper's columns."""
    texts = [
        ["no error" if row[name] is None else text.format(row[name]) for name, (_, text) in COLUMNS.items()]
        for row in study["rows"]
    ]
    size = f"{study['width_px']} x {study['height_px']} px"
    ends = f"{study['min_m']:.2f} to {study['max_m']:.2f} m"
    measured = f"{study['share_measured']:.1%} of the pixels measured; errors against {study['truth']}."
    table = TextTable("", [title for title, _ in COLUMNS.values()], texts)
    return f"Depth of `{study['frame']}`, {size}, {ends}, {measured}\n\n{table.markdown()}"


def draw_study(rgb: np.ndarray, reference_m: np.ndarray, decoded_m: dict[str, np.ndarray]) -> bytes:
    """Draw the frame, its depth, the error of 8 bits and the middle row; return a PNG.

    Args:
        rgb: (h, w, 3) uint8. reference_m: (h, w). decoded_m: coding -> the depth that it decodes to, (h, w).
    """
    measured = is_measured(reference_m)
    errors_m = np.where(measured, np.abs(decoded_m["8-bit"] - reference_m), 0.0)
    levels = np.round(errors_m / (errors_m.max() or 1.0) * 255.0).astype(np.uint8)
    error_panel = np.ascontiguousarray(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1])
    high_m = float(reference_m[measured].max())
    depth_panel = depth_colors(reference_m.astype(np.float32), high_m)
    panels = [
        ("(a) colours", rgb),
        (f"(b) float32, inferno reversed, to {high_m:.0f} m", depth_panel),
        (f"(c) error of 8 bits: up to {errors_m.max() * CM_PER_M:.2g} cm", error_panel),
        ("(d) middle row", _profile_panel({"truth": reference_m, **decoded_m}, measured)),
    ]
    return png_bytes(captioned_grid(panels, 2, PANEL_PX))


def _profile_panel(depths_m: dict[str, np.ndarray], measured: np.ndarray) -> np.ndarray:
    """Draw the middle row of the depths of PROFILE_COLORS over each other; return RGB of PANEL_PX."""
    width_px, height_px = PANEL_PX
    panel = np.full((height_px, width_px, 3), 255, np.uint8)
    exact_m = depths_m["truth"][measured]
    low_m, high_m = float(exact_m.min()), float(exact_m.max())
    middle = len(measured) // 2
    columns = np.flatnonzero(measured[middle])
    x = columns * width_px / measured.shape[1]
    legend_x = LEGEND_LEFT_PX
    for name, color in PROFILE_COLORS.items():
        depth_m = depths_m[name][middle, columns].astype(np.float64)
        share = (depth_m - low_m) / (high_m - low_m)
        y = height_px - PROFILE_BOTTOM_PX - share * (height_px - PROFILE_BOTTOM_PX - PROFILE_TOP_PX)
        if len(columns) > 1:
            draw_line(panel, np.stack([x, y], axis=1), color)
        legend_x = draw_text(panel, name, legend_x, LEGEND_BASELINE_PX, LEGEND_SCALE, color) + LEGEND_GAP_PX
    return panel
