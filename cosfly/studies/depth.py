"""Codes the depth of one frame in all the ways there are, decodes it, and compares: `depth_study.json`,
`depth_study.md`, and a figure.

Whole numbers of 8 to 16 bits share the frame's own range evenly, as the paper's table does. The truth is what the file
holds: float32, whose rounding is then told as half the step between neighbouring numbers at the farthest pixel, or
float64, against which float32 is measured.
"""

from __future__ import annotations

import io
import zlib
from pathlib import Path

import cv2
import numpy as np
from pydantic import BaseModel

from cosfly.errors import InputError
from cosfly.look.frame_views import depth_colors
from cosfly.look.topview import INK, PAPER, Color, draw_line, draw_text, png_bytes
from cosfly.products.frames import (
    INVALID_DEPTH_M,
    SKY_DEPTH_M,
    depth_bytes,
    depth_values,
    frame_path,
    is_packed,
    read_rgb,
)
from cosfly.reading.arrays import parse_array, parse_array_header
from cosfly.reading.documents import FileFormat
from cosfly.reading.files import read_bytes
from cosfly.work.store import write_bytes, write_model

FORMAT = FileFormat("cosfly.depth_study", "1.0")
MM_A_METRE, SKY_MM, MOST_PNG_M = 1000.0, 65535, 65.5  # 16 bits of millimetres; what is left for the sky
MOST_HALF_M = float(np.finfo(np.float16).max)  # more is no number in 16 bits
BITS = (8, 10, 12, 16)
ENTROPY_BINS = 8192  # of the frame's range, the same for all codings: exact values of a float are nearly all unlike
CM = 100.0
KB = 1024.0  # bytes, as the paper's column counts them
PANEL_PX = (480, 270)  # width, height of each of six
GAP_PX, TITLE_PX = 14, 30
PROFILE_COLORS: dict[str, Color] = {"8-bit": (215, 60, 50), "10-bit": (240, 150, 40), "truth": (30, 30, 30)}
MOST_PROFILE_PX, LEAST_PROFILE_PX = 160, 16  # of a row
PROFILE_STEPS = 6.0  # of 8 bits: of more none is seen


class CodingRow(BaseModel):
    """Figures of one coding, of the pixels that are neither sky nor invalid; errors against the truth, cm.

    psnr_db: of the frame's range; null: no error. edges: Pearson correlation of Sobel gradients. kilobytes: of the
    frame as it lies in memory or, of a PNG, as a file; deflated: after zlib at its default level. rounding_cm: of a
    truth that is float32 itself, its own greatest rounding.
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
    deflated_kilobytes: float
    rounding_cm: float | None = None


class Study(BaseModel):
    """`depth_study.json`. share_measured: of the pixels, neither sky nor invalid. left_out: codings that have no number
    for these depths."""

    frame: str
    width_px: int
    height_px: int
    truth: str
    min_m: float
    max_m: float
    share_measured: float
    rows: list[CodingRow]
    left_out: dict[str, str]


def run(frame: Path, out: Path) -> Study:
    """Read a frame folder, or a `.npy` of depth; write the study into a folder, with a figure; give it.

    Raises:
        InputError: there is no depth image, it is not of metres, or it holds fewer than two different depths.
    """
    file = frame_path(frame, "depth.npy") if frame.is_dir() else frame
    data = read_bytes(file, what="depth image")
    truth = _truth(data, file)
    measured = (truth != INVALID_DEPTH_M) & (truth != SKY_DEPTH_M)
    known = truth[measured]
    if not known.size or known.min() == known.max() or known.min() < 0:
        got = "no measured pixel" if not known.size else f"{known.min():g} to {known.max():g} m"
        raise InputError(
            "a depth image that has nothing to study", where=file, got=got, expected="two depths or more, above 0 m"
        )
    decoded, left_out = _decoded(truth, measured, file)
    name = "/".join(file.absolute().parts[-2:])
    rows = [_row(coding, values, size, blob, truth, measured) for coding, (values, size, blob) in decoded.items()]
    if truth.dtype == np.float32:
        rounding = float(np.spacing(known.max())) / 2.0 * CM
        rows = [
            row.model_copy(update={"rounding_cm": rounding}) if row.coding == "32-bit float" else row for row in rows
        ]
    study = Study(
        frame=name, width_px=truth.shape[1], height_px=truth.shape[0], truth=str(truth.dtype), min_m=float(known.min()),
        max_m=float(known.max()), share_measured=float(measured.mean()), rows=rows, left_out=left_out,
    )  # fmt: skip
    rgb = read_rgb(frame) if frame.is_dir() and (frame / "rgb.png").exists() else None
    write_model(out / "depth_study.json", study, FORMAT)
    write_bytes(out / "depth_study.md", markdown(study).encode())
    write_bytes(
        out / "depth_study.png",
        draw_study(rgb, truth, measured, {name: values for name, (values, _, _) in decoded.items()}),
    )
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


# --- codings ----------------------------------------------------------------------------------------------------------

Decoded = tuple[np.ndarray, float, bytes]  # the depth that comes back, m; bytes as stored; what deflating starts from


def quantised(truth: np.ndarray, measured: np.ndarray, bits: int) -> tuple[np.ndarray, np.ndarray]:
    """Give the codes of whole numbers that share the frame's range evenly, and the depth that they stand for.

    Args:
        truth: (h, w) m; measured: (h, w) bool. Pixels that are not measured get code 0, and their own depth back.
    """
    low, high = float(truth[measured].min()), float(truth[measured].max())
    step_m = (high - low) / (2**bits - 1)
    codes = np.where(measured, np.rint((truth.astype(np.float64) - low) / step_m), 0).astype(np.uint16)
    return codes, np.where(measured, low + codes * step_m, truth.astype(np.float64))


def _decoded(truth: np.ndarray, measured: np.ndarray, file: Path) -> tuple[dict[str, Decoded], dict[str, str]]:
    """Code and decode in all ways, by their names; and those that cannot hold these depths, with why."""
    found, left_out = dict[str, Decoded](), dict[str, str]()
    for bits in BITS:
        codes, values = quantised(truth, measured, bits)
        blob = codes.astype(np.uint8).tobytes() if bits == 8 else codes.tobytes()
        found[f"{bits}-bit"] = (values, truth.size * bits / 8.0, blob)
    single = truth.astype(np.float32)
    farthest = truth[measured].max()
    if farthest > MOST_HALF_M:
        left_out["16-bit float"] = f"depths beyond {MOST_HALF_M:g} m"
    else:
        half = single.astype(np.float16)
        blob = depth_bytes(half)
        found["16-bit float"] = (half.astype(np.float64), float(len(blob)), blob)
    if farthest > MOST_PNG_M:
        left_out["16-bit PNG of millimetres"] = f"depths beyond {MOST_PNG_M:g} m"
    else:
        blob, values = _millimetres(single, file)
        found["16-bit PNG of millimetres"] = (values, float(len(blob)), blob)
    found["32-bit float"] = (single.astype(np.float64), float(single.nbytes), single.tobytes())
    # The same numbers, their bytes sorted by significance: exponents stand beside exponents, which deflating likes.
    planes = np.frombuffer(single.tobytes(), np.uint8).reshape(-1, 4).T.tobytes()
    found["32-bit float, bytes by significance"] = (_from_planes(planes, single.shape), float(len(planes)), planes)
    if truth.dtype == np.float64:
        found["64-bit float"] = (truth, float(truth.nbytes), truth.tobytes())
    return found, left_out


def _millimetres(depth_m: np.ndarray, where: Path) -> tuple[bytes, np.ndarray]:
    """Return a depth image as a PNG of 16-bit millimetres, and the metres that it decodes to."""
    codes = np.clip(np.rint(depth_m * np.float32(MM_A_METRE)), 1, SKY_MM - 1).astype(np.uint16)
    codes[depth_m == SKY_DEPTH_M] = SKY_MM
    codes[depth_m == INVALID_DEPTH_M] = 0
    is_done, data = cv2.imencode(".png", codes)
    if not is_done:
        raise InputError("cannot encode a PNG", where=where, got=str(depth_m.shape))
    values = codes.astype(np.float32) / np.float32(MM_A_METRE)
    values[codes == SKY_MM] = SKY_DEPTH_M
    return data.tobytes(), values.astype(np.float64)


def _from_planes(planes: bytes, shape: tuple[int, ...]) -> np.ndarray:
    values = np.ascontiguousarray(np.frombuffer(planes, np.uint8).reshape(4, -1).T).view(np.float32)
    return values.reshape(shape).astype(np.float64)


# --- figures ----------------------------------------------------------------------------------------------------------


def _row(
    coding: str, values: np.ndarray, size: float, blob: bytes, truth: np.ndarray, measured: np.ndarray
) -> CodingRow:
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
        kilobytes=size / KB,
        deflated_kilobytes=len(zlib.compress(blob)) / KB,
    )


def entropy_bits(values: np.ndarray, low: float, high: float) -> float:
    """Give Shannon's entropy of a histogram of ENTROPY_BINS equal bins from low to high, bits."""
    counts = np.histogram(values, bins=ENTROPY_BINS, range=(low, high))[0]
    shares = counts[counts > 0] / counts.sum()
    return float(-(shares * np.log2(shares)).sum())


def edge_correlation(values: np.ndarray, truth: np.ndarray, measured: np.ndarray) -> float:
    """Give Pearson's correlation of the lengths of Sobel gradients, where the nine pixels under the filter are all
    measured; 1 where none are."""
    inner = (
        cv2.erode(measured.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
        > 0
    )
    lengths = [
        np.hypot(cv2.Sobel(image, cv2.CV_64F, 1, 0), cv2.Sobel(image, cv2.CV_64F, 0, 1))[inner]
        for image in (values, truth)
    ]
    if not inner.any() or min(length.std() for length in lengths) == 0:
        return 1.0
    return float(np.corrcoef(lengths)[0, 1])


def markdown(study: Study) -> str:
    """Give the table of the study, as the paper prints it, with sizes after deflating."""
    buffer = io.StringIO()
    buffer.write(
        f"Depth of `{study.frame}`, {study.width_px} x {study.height_px} px, {study.min_m:.2f} to "
        f"{study.max_m:.2f} m, {study.share_measured:.1%} of the pixels "
        f"measured; errors against {study.truth}.\n\n"
        "| coding | unique values | max error, cm | mean error, cm | RMSE, cm | PSNR, dB | entropy, bits | edge "
        "correlation | size, KB of 1,024 bytes | deflated, KB |\n"
        "|---|---|---|---|---|---|---|---|---|---|\n"
    )
    for row in study.rows:
        psnr = "none wrong" if row.psnr_db is None else f"{row.psnr_db:.1f}"
        buffer.write(
            f"| {row.coding} | {row.unique:,} | {row.max_cm:.4g} | {row.mean_cm:.4g} | {row.rmse_cm:.4g} | "
            f"{psnr} | {row.entropy_bits:.2f} | "
            f"{row.edges:.6f} | {row.kilobytes:,.0f} | {row.deflated_kilobytes:,.0f} |\n"
        )
    for row in study.rows:
        if row.rounding_cm is not None:
            buffer.write(
                f"\nThe truth is float32 itself, which rounds by at most {row.rounding_cm:.2g} cm at "
                f"{study.max_m:.1f} m.\n"
            )
    for coding, reason in study.left_out.items():
        buffer.write(f"\nNot stored as {coding}: {reason}.\n")
    return buffer.getvalue()


# --- the figure: what is seen of the frame in each coding, where the errors lie, and a row of pixels from the side
# --------


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
    """Give row, column and length of measured pixels whose depth changes evenly, by about PROFILE_STEPS of 8 bits."""
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
    """Draw the depth along a stretch of a row: as it is, and over that in 8 and 10 bits, a step at each pixel."""
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
