"""Overviews of a playback tree: a contact sheet, an animation of one track, four pictures of a frame."""

import io
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from cosfly.formats.boxes import BoxMap
from cosfly.formats.frames import FRAME_FILES, frame_path, read_instance, read_meta, read_rgb, rgb_bytes
from cosfly.formats.places import ALL_TRACKS, TrackChoice
from cosfly.formats.playback import Track
from cosfly.formats.playback_file import read_track
from cosfly.formats.town import read_instance_ids
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import inside, write_bytes
from cosfly.viz.frame_views import DEPTH_RANGE_M, VIEW_FILES, read_view, spread
from cosfly.viz.overlay import Overlay
from cosfly.viz.topview import captioned_grid, draw_text

TILE_PX = (320, 180)
NUM_RGB_TILES = 4
MOST_ROWS = 12  # tracks on one sheet
GIF_WIDTH_PX = 480
GIF_FRAME_MS = 250  # twice as fast as the paper's 0.5 s
MOST_GIF_FRAMES = 60
BOX_COLOR = (255, 214, 10)


def contact_sheet(tree: Path, out_png: Path, choice: TrackChoice = ALL_TRACKS) -> None:
    """Read a playback tree and write a PNG: a few RGB frames, a depth image and a mask of each track."""
    folders = find_tracks(tree, choice)
    rows = [_row(read_track(folder)) for folder in folders[:MOST_ROWS]]
    heading = np.full((26, rows[0].shape[1], 3), 60, np.uint8)
    note = "" if len(folders) <= MOST_ROWS else f", the first {MOST_ROWS} shown"
    draw_text(heading, f"{len(folders)} tracks{note}", 8, 18, 0.5, (255, 255, 255))
    write_bytes(out_png, _small_png(np.vstack([heading, *rows])))


def preview_gif(
    tree: Path, out_gif: Path, choice: TrackChoice = ALL_TRACKS, frames_per_s: float = 1000 / GIF_FRAME_MS
) -> None:
    """Read a playback tree and write its first clean track as an animation, with the target's box."""
    track, frames = _first_clean(tree, choice, "rgb.png")
    pictures = [_preview(track, frames[i]) for i in spread(len(frames), MOST_GIF_FRAMES)]
    write_bytes(out_gif, _gif(pictures, round(1000 / frames_per_s)))


def four_panels(tree: Path, out_png: Path, *, box_map: BoxMap, frame: str | None = None) -> str:
    """Read a frame of a playback tree; write a PNG: colours, depth, instances, and boxes with ids and distances.

    Args:
        frame: Its folder, as for `frame_in`; None is the frame of the first clean track that shows most of the target.
        box_map: The drawn map.

    Returns:
        The frame's folder in the tree.
    """
    folder = best_frame(tree, *FRAME_FILES) if frame is None else frame_in(tree, frame)
    meta = read_meta(folder)
    rgb = read_rgb(folder)
    overlay = Overlay(box_map, read_instance_ids(folder.parents[3]).of_boxes(box_map))
    boxes = overlay.draw(rgb, read_instance(folder)[1], meta)
    panels = [
        (f"RGB, {meta.camera.fov_deg:.0f} deg", rgb),
        (f"depth, black: {DEPTH_RANGE_M:g} m and beyond", read_view(folder, "depth")),
        ("instances, the target red", read_view(folder, "segmentation")),
        (f"boxes, ids, distances; visibility {meta.target.visibility:.2f}", boxes),
    ]
    write_bytes(out_png, rgb_bytes(captioned_grid(panels, 2)))
    return folder.relative_to(tree).as_posix()


def frame_in(tree: Path, frame: str | Path) -> Path:
    """Return the folder of a frame, which is named relative to the tree, or by a path into it."""
    path = Path(frame).resolve()
    if path.is_dir() and path.is_relative_to(tree.resolve()):
        return tree / path.relative_to(tree.resolve())
    return inside(tree, str(frame))


def best_frame(tree: Path, *names: str) -> Path:
    """Return the frame folder of a tree's first clean track that shows most of the target and has these files."""
    track, frames = _first_clean(tree, ALL_TRACKS, *names)
    return track.frame_folder(max(frames, key=lambda i: (np.nan_to_num(track.target.visibility[i]), i)))


# --- pieces -----------------------------------------------------------------------------------------------------------


def _first_clean(tree: Path, choice: TrackChoice, *names: str) -> tuple[Track, list[int]]:
    """Return the first clean track of a tree, or without clean ones the first, and its frames that have these files."""
    folders = find_tracks(tree, choice)
    track = read_track(next((f for f in folders if f.name == "ORI"), folders[0]))
    return track, _frames_with(track, *names)


def _frames_with(track: Track, *names: str) -> list[int]:
    frames = sorted(set(range(len(track))) - set(track.missing_frames(names)))
    if not frames:
        expected, fix = f"a frame with {', '.join(names)}", "render the track again"
        raise InputError("the track has no complete frame", where=track.folder, expected=expected, fix=fix)
    return frames


def _row(track: Track) -> np.ndarray:
    frames = _frames_with(track, "rgb.png")
    tiles = []
    for k in spread(len(frames), NUM_RGB_TILES):
        i = frames[k]
        picture = _boxed(read_rgb(track.frame_folder(i)), track, i)
        tiles.append(_tile(picture, f"t = {track.time_s[i]:.1f} s"))
    tiles += [np.zeros_like(tiles[0])] * (NUM_RGB_TILES - len(tiles))
    middle = track.frame_folder(frames[len(frames) // 2])
    for view in ("depth", "segmentation"):
        if frame_path(middle, VIEW_FILES[view]).is_file():
            tiles.append(_tile(read_view(middle, view), view))
        else:
            tiles.append(_tile(np.zeros_like(tiles[0]), f"no {VIEW_FILES[view]}"))
    strip = np.full((22, TILE_PX[0] * len(tiles), 3), 24, np.uint8)
    visible = f"target visible in {int(track.target.visible.sum())} of {len(track)} frames"
    fov = " to ".join(dict.fromkeys(f"{fov:.0f}" for fov in track.fovs_deg))
    text = f"{track.town}  {track.trajectory}  {track.variant}   fov {fov} deg   {visible}"
    draw_text(strip, text, 8, 15, 0.45, (235, 235, 235))
    return np.vstack([strip, np.hstack(tiles)])


def _tile(picture: np.ndarray, text: str) -> np.ndarray:
    tile = cv2.resize(picture, TILE_PX, interpolation=cv2.INTER_AREA)
    draw_text(tile, text, 6, TILE_PX[1] - 8, 0.42, (255, 255, 255), halo=(0, 0, 0))
    return tile


def _boxed(picture: np.ndarray, track: Track, i: int) -> np.ndarray:
    """Draw the target's box if the frame has one."""
    picture = np.ascontiguousarray(picture)
    if not np.isnan(track.target.bbox[i]).any():
        x0, y0, x1, y1 = (round(float(v)) for v in track.target.bbox[i])
        cv2.rectangle(picture, (x0, y0), (x1, y1), BOX_COLOR, max(1, picture.shape[1] // 400))
    return picture


def _preview(track: Track, i: int) -> Image.Image:
    picture = _boxed(read_rgb(track.frame_folder(i)), track, i)
    size_px = GIF_WIDTH_PX, round(GIF_WIDTH_PX * picture.shape[0] / picture.shape[1])
    return Image.fromarray(cv2.resize(picture, size_px, interpolation=cv2.INTER_AREA))


def _gif(frames: list[Image.Image], frame_ms: int) -> bytes:
    # One palette for all frames: colours do not flicker, and undithered areas compress better.
    sample = np.vstack([np.asarray(frames[i]) for i in spread(len(frames), 6)])
    palette = Image.fromarray(sample).quantize(128)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    buffer = io.BytesIO()
    options = {"append_images": frames[1:], "duration": frame_ms, "loop": 0, "optimize": False}
    frames[0].save(buffer, format="GIF", save_all=True, **options)
    return buffer.getvalue()


def _small_png(rgb: np.ndarray) -> bytes:
    """Encode a picture with a palette of 256 colours."""
    buffer = io.BytesIO()
    Image.fromarray(rgb).quantize(256, dither=Image.Dither.NONE).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()
