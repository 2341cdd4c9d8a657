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


def first_split(record: ReleaseRecord) -> str:
    """Give the first split that has rows."""
    return next((name for name in SPLIT_NAMES if name in record.splits.splits), SPLIT_NAMES[0])
