"""Code of the card: how to read this release. A test runs it."""

from __future__ import annotations

from release.columns import SPLIT_NAMES
from release.record import ReleaseRecord

DEPTH = {
    "float32": 'depth_m = np.load(io.BytesIO(row["depth"]))  # float32 (height, width)',
    "float16": 'depth_m = np.load(io.BytesIO(row["depth"])).astype(np.float32)  # (height, width)',
    "millimetre_png": 'depth_m = np.asarray(Image.open(io.BytesIO(row["depth"]))) / np.float32(1000.0)  # (height, width); 65.535 is sky, 0 invalid',
}


def one_row(record: ReleaseRecord) -> str:
    """Give what loads one split and decodes a row."""
    files = record.settings.modalities
    is_png = record.depth is not None and record.depth.coding == "millimetre_png"
    lines = [
        "import io",
        "import numpy as np",
        "from datasets import load_dataset",
        *(["from PIL import Image"] if is_png else []),
        "",
    ]
    lines += [
        f'data = load_dataset(FOLDER, split="{first_split(record)}")  # this folder, or its name on the hub',
        "row = data[0]",
    ]
    if "rgb" in files:
        lines.append('rgb = np.asarray(row["image"].convert("RGB"))')
    if record.depth is not None:
        lines.append(DEPTH[record.depth.coding])
    if "instance" in files:
        lines += [
            'coded = np.asarray(row["instance"].convert("RGB")).astype(np.uint16)',
            "semantic, instance_id = coded[..., 0], coded[..., 1] | (coded[..., 2] << 8)",
        ]
    lines += [
        'intrinsics, pose = row["intrinsics"], row["pose"]',
        'reason = row["caption_en_reasoning_trace"]  # or _zh_',
    ]
    return "\n".join(lines)


def parts(record: ReleaseRecord) -> str:
    """Give what loads by split, row by row, or a part."""
    split, names = first_split(record), ", ".join(record.splits.splits)
    return "\n".join(
        [
            "from datasets import load_dataset",
            "import pyarrow.dataset",
            "",
            f"splits = load_dataset(FOLDER)  # all of them: {names}",
            f'flow = load_dataset(FOLDER, split="{split}", streaming=True)  # row by row, nothing is downloaded first',
            'places = [row["target"] for row in flow.select_columns(["sample_id", "target"]).take(10)]',
            "",
            "# Of a folder on disk some columns and rows alone; nothing else is read.",
            'rows = pyarrow.dataset.dataset(f"{FOLDER}/data", format="parquet")',
            f'poses = rows.to_table(columns=["sample_id", "pose"], filter=pyarrow.dataset.field("split") == "{split}")',
        ]
    )


def windows(record: ReleaseRecord) -> str:
    """Give what makes captioned windows of the rows, with `datasets` alone."""
    has_rgb = "rgb" in record.settings.modalities
    frames = ['    frames = [row["image"] for row in rows]'] if has_rgb else []
    given = ['"frames": frames'] if has_rgb else []
    given += ['"facts": facts', '"prompt": last["prompt_en"]', '"caption": last["caption_en_reasoning_trace"]']
    return "\n".join(
        [
            "from datasets import load_dataset",
            "",
            f'data = load_dataset(FOLDER, split="{first_split(record)}")',
            'flight = ["run", "town", "trajectory", "variant"]',
            'keys = data.select_columns([*flight, "frame_index"])',
            "place = {tuple(key.values()): number for number, key in enumerate(keys)}",
            'captioned = [number for number, has in enumerate(data["has_caption"]) if has]',
            "",
            "def window(i):",
            "    last = data[captioned[i]]",
            "    name = [last[part] for part in flight]",
            '    rows = data.select([place[(*name, index)] for index in last["caption_window"]])',
            *frames,
            '    facts = rows.select_columns(["time_s", "pose", "target", "target_bbox", "target_visible"])[:]',
            f"    return {{{', '.join(given)}}}",
        ]
    )


def first_split(record: ReleaseRecord) -> str:
    """Give the first split that has rows."""
    return next((name for name in SPLIT_NAMES if name in record.splits.splits), SPLIT_NAMES[0])
