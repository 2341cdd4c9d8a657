"""Compare ways to store the depth of one frame (tab:depth_format_comparison): `depth_study.json`, `depth_study.md`, and
a figure (fig:depth_comparison).

Whole numbers of 8 to 16 bits share the frame's own range evenly, as in the paper. The reference is what the file holds:
float64 or float32; of the latter 32 bits lose nothing more.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from pydantic import BaseModel

from cosfly.formats.frames import INVALID_DEPTH_M, SKY_DEPTH_M, depth_values, frame_path, is_packed, read_rgb
from cosfly.runtime.arrays import parse_array, parse_array_header
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import read_bytes, write_bytes
from cosfly.runtime.json_io import FileFormat, write_model
from cosfly.viz.frame_views import depth_colors
from cosfly.viz.tables import TextTable
from cosfly.viz.topview import PAPER, Color, draw_line, draw_text, png_bytes

FORMAT = FileFormat("cosfly.depth_study", "2.0")
BITS = (8, 10, 12, 16)
SINGLE = "32-bit float"
ENTROPY_BINS = 8192  # of the frame's range, the same for all codings: exact values of a float are nearly all different
CM = 100.0
KB = 1024.0  # bytes, as the paper's column counts them
PANEL_PX = (480, 270)  # width, height of each of six
GAP_PX, TITLE_PX = 14, 30
PROFILE_COLORS: dict[str, Color] = {"truth": (30, 30, 30), "10-bit": (240, 150, 40), "8-bit": (215, 60, 50)}
COLUMNS = [
    "coding", "unique values", "max error, cm", "mean error, cm", "RMSE, cm", "PSNR, dB", "entropy, bits",
    "edge correlation", "size, KB of 1,024 bytes",
]  # fmt: skip


class CodingRow(BaseModel):
    """Figures of one coding, of the pixels that are neither sky nor invalid; errors against the truth, cm.

    psnr_db: of the frame's range; null: no error. edges: Pearson correlation of Sobel gradients. kilobytes: of the
    frame in memory.
    """

    coding: str
    unique: int
    max_cm: float
    mean_cm: float
    rmse_cm: float
    psnr_db: float | None
    entropy_bits: float
    edges: float
    kilobytes: float


class Study(BaseModel):
    """`depth_study.json`. share_measured: of the pixels, neither sky nor invalid."""

    frame: str
    width_px: int
    height_px: int
    truth: str
    min_m: float
    max_m: float
    share_measured: float
    rows: list[CodingRow]


def run(frame: Path, out: Path) -> Study:
    """Read a frame folder, or a `.npy` of depth; write the study into a folder, with a figure; return it.

    Raises:
        InputError: there is no depth image, it is not of metres, or it holds fewer than two different depths.
    """
    file = frame_path(frame, "depth.npy") if frame.is_dir() else frame
    truth = _truth(read_bytes(file, what="depth image"), file)
    measured = (truth != INVALID_DEPTH_M) & (truth != SKY_DEPTH_M)
    known = truth[measured]
    if not known.size or known.min() == known.max() or known.min() < 0:
        got = "no measured pixel" if not known.size else f"{known.min():g} to {known.max():g} m"
        expected = "two depths or more, above 0 m"
        raise InputError("a depth image that has nothing to study", where=file, got=got, expected=expected)
    decoded = {f"{bits}-bit": quantised(truth, measured, bits)[1] for bits in BITS}
    decoded[SINGLE] = truth.astype(np.float32).astype(np.float64)
    sizes = dict(zip(decoded, (*BITS, 32), strict=True))
    study = Study(
        frame="/".join(file.absolute().parts[-2:]),
        width_px=truth.shape[1],
        height_px=truth.shape[0],
        truth=str(truth.dtype),
        min_m=float(known.min()),
        max_m=float(known.max()),
        share_measured=float(measured.mean()),
        rows=[_row(coding, values, sizes[coding], truth, measured) for coding, values in decoded.items()],
    )
    rgb = read_rgb(frame) if frame.is_dir() and (frame / "rgb.png").exists() else None
    write_model(out / "depth_study.json", study, FORMAT)
    write_bytes(out / "depth_study.md", markdown(study).encode())
    write_bytes(out / "depth_study.png", draw_study(rgb, truth, measured, decoded))
    return study


def _truth(data: bytes, file: Path) -> np.ndarray:
    """Read depth, (h, w) m; what others write for a pixel without, NaN or infinity, becomes INVALID_DEPTH_M."""
    if is_packed(data):
        truth = depth_values(data, file)
        return np.where(np.isfinite(truth), truth, np.float32(INVALID_DEPTH_M))
    kind = parse_array_header(memoryview(data), file, what="depth image").dtype
    if kind.kind in "iu":
        raise InputError(
            "a depth image whose unit nobody knows", where=file, got=str(kind), expected="metres as float32 or float64",
            fix='np.save("depth.npy", image / 1000.0), where it holds millimetres',
        )  # fmt: skip
    wanted = np.float64 if kind == np.float64 else np.float32
    truth = parse_array(data, file, dtype=wanted, ndim=2, what="depth image")
    return np.where(np.isfinite(truth), truth, wanted(INVALID_DEPTH_M))


# --- figures ----------------------------------------------------------------------------------------------------------


def quantised(truth: np.ndarray, measured: np.ndarray, bits: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the codes of whole numbers that share the frame's range evenly, and the depth that they decode to.

    Args:
        truth: (h, w) m; measured: (h, w) bool. Pixels that are not measured get code 0, and their own depth back.
    """
    low, high = float(truth[measured].min()), float(truth[measured].max())
    step_m = (high - low) / (2**bits - 1)
    codes = np.where(measured, np.rint((truth.astype(np.float64) - low) / step_m), 0).astype(np.uint16)
    return codes, np.where(measured, low + codes * step_m, truth.astype(np.float64))


def _row(coding: str, values: np.ndarray, bits: int, truth: np.ndarray, measured: np.ndarray) -> CodingRow:
    known, came_back = truth[measured].astype(np.float64), values[measured]
    errors = np.abs(came_back - known)
    rmse = float(np.sqrt(np.mean(errors**2)))
    low, high = float(known.min()), float(known.max())
    return CodingRow(
        coding=coding,
        unique=len(np.unique(came_back)),
        max_cm=float(errors.max()) * CM,
        mean_cm=float(errors.mean()) * CM,
        rmse_cm=rmse * CM,
        psnr_db=20.0 * float(np.log10((high - low) / rmse)) if rmse else None,
        entropy_bits=entropy_bits(came_back, low, high),
        edges=edge_correlation(values, truth.astype(np.float64), measured),
        kilobytes=truth.size * bits / 8.0 / KB,
    )


def entropy_bits(values: np.ndarray, low: float, high: float) -> float:
    """Return Shannon's entropy of a histogram of ENTROPY_BINS equal bins from low to high, bits."""
    counts = np.histogram(values, bins=ENTROPY_BINS, range=(low, high))[0]
    shares = counts[counts > 0] / counts.sum()
    return float(-(shares * np.log2(shares)).sum())


def edge_correlation(values: np.ndarray, truth: np.ndarray, measured: np.ndarray) -> float:
    """Return Pearson's correlation of the lengths of Sobel gradients, where the nine pixels under the filter are all
    measured; 1 where none are."""
    window = np.ones((3, 3), np.uint8)
    inner = cv2.erode(measured.astype(np.uint8), window, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    lengths = [
        np.hypot(cv2.Sobel(image, cv2.CV_64F, 1, 0), cv2.Sobel(image, cv2.CV_64F, 0, 1))[inner]
        for image in (values, truth)
    ]
    if not inner.any() or min(length.std() for length in lengths) == 0:
        return 1.0
    return float(np.corrcoef(lengths)[0, 1])


def markdown(study: Study) -> str:
    """Return the table of the study, as the paper prints it."""
    rows = []
    for row in study.rows:
        errors = [f"{value:.4g}" for value in (row.max_cm, row.mean_cm, row.rmse_cm)]
        psnr = "no error" if row.psnr_db is None else f"{row.psnr_db:.1f}"
        rest = [psnr, f"{row.entropy_bits:.2f}", f"{row.edges:.6f}", f"{row.kilobytes:,.0f}"]
        rows.append([row.coding, f"{row.unique:,}", *errors, *rest])
    table = TextTable("", COLUMNS, rows).markdown()
    of = f"Depth of `{study.frame}`, {study.width_px} x {study.height_px} px, {study.min_m:.2f} to {study.max_m:.2f} m"
    return f"{of}, {study.share_measured:.1%} of the pixels measured; errors against {study.truth}.\n\n{table}"


# --- the figure -------------------------------------------------------------------------------------------------------


def draw_study(
    rgb: np.ndarray | None, truth: np.ndarray, measured: np.ndarray, decoded: dict[str, np.ndarray]
) -> bytes:
    """Draw six panels; PNG bytes.

    Args:
        rgb: (h, w, 3) uint8 of the frame, None where there is none. truth: (h, w) m; measured: (h, w) bool.
        decoded: name of a coding -> the depth that it decodes to.
    """
    low, high = float(truth[measured].min()), float(truth[measured].max())
    grey = np.where(measured, np.clip((decoded["8-bit"] - low) / (high - low), 0, 1) * 255.0, 0).astype(np.uint8)
    fine = SINGLE if truth.dtype == np.float64 else "16-bit"
    panels = [
        ("(a) colours", np.full((*truth.shape, 3), PAPER, np.uint8) if rgb is None else rgb),
        ("(b) 8 bits, as grey", cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)),
        (f"(c) float32, inferno reversed, to {high:.0f} m", depth_colors(truth.astype(np.float32), high)),
        _errors("(d) error of 8 bits", decoded["8-bit"], truth, measured),
        _errors(f"(e) error of {fine}", decoded[fine], truth, measured),
        ("(f) middle row", _profile(truth, measured, decoded)),
    ]
    width, height = PANEL_PX
    picture = np.full((2 * (height + TITLE_PX + GAP_PX) + GAP_PX, 3 * (width + GAP_PX) + GAP_PX, 3), PAPER, np.uint8)
    for k, (title, panel) in enumerate(panels):
        x, y = GAP_PX + (k % 3) * (width + GAP_PX), GAP_PX + (k // 3) * (height + TITLE_PX + GAP_PX)
        draw_text(picture, title, x, y + 20, 0.5)
        scaled = cv2.resize(panel, PANEL_PX, interpolation=cv2.INTER_AREA)
        picture[y + TITLE_PX : y + TITLE_PX + height, x : x + width] = scaled
    return png_bytes(picture)


def _errors(title: str, values: np.ndarray, truth: np.ndarray, measured: np.ndarray) -> tuple[str, np.ndarray]:
    """Return a map of errors with its title, bright where they are greatest."""
    errors = np.where(measured, np.abs(values - truth), 0.0)
    most = float(errors.max())
    level = np.round(errors / (most or 1.0) * 255.0).astype(np.uint8)
    shown = cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    return f"{title}: up to {most * CM:.2g} cm", shown


def _profile(truth: np.ndarray, measured: np.ndarray, decoded: dict[str, np.ndarray]) -> np.ndarray:
    """Draw the depth along the middle row: the truth, and what 8 and 10 bits make of it."""
    y = truth.shape[0] // 2
    columns = np.flatnonzero(measured[y])
    panel = np.full((PANEL_PX[1], PANEL_PX[0], 3), 255, np.uint8)
    low, high = float(truth[measured].min()), float(truth[measured].max())
    left = 10
    for name, color in PROFILE_COLORS.items():
        depth = (truth if name == "truth" else decoded[name])[y, columns].astype(np.float64)
        rows = PANEL_PX[1] - 10.0 - (depth - low) / (high - low) * (PANEL_PX[1] - 40.0)
        if len(columns) > 1:
            draw_line(panel, np.stack([columns * PANEL_PX[0] / truth.shape[1], rows], axis=1), color)
        left = draw_text(panel, name, left, 18, 0.45, color) + 16
    return panel
