"""Rows of a release, as its shards give them, whose figures can be worked out by hand."""

from release.columns import CAPTION_FIELDS, COUNTED, POINT, POSE, SCALAR_NAMES

WORDS = {
    "decision": "hover", "label": "ascend", "label_from": "flight", "verdict": "SOFT_CONFLICT", "teacher_kind": "rules",
}  # fmt: skip


def make_row(i: int, variant: str = "ORI", trajectory: str = "trajectory_1", **change) -> dict:
    """A frame of a drone that flies 3 m a frame to the east, 20 m above a person; the perturbed track 1 m beside."""
    shift = 0.0 if variant == "ORI" else (-1.0) ** i
    place = {"x_m": 3.0 * i, "y_m": shift, "z_m": 20.0}
    row = dict.fromkeys(SCALAR_NAMES) | {
        "sample_id": f"{trajectory}_{variant}_frame_{i:05d}", "run": "one", "town": "Town01",
        "trajectory": trajectory, "variant": variant,
        "track": "clean" if variant == "ORI" else "perturbed", "style": "follow", "pace": "walk",
        "frame_index": i, "time_s": 0.5 * i,
        "width_px": 64, "height_px": 36, "fov_deg": 60.0, "pose": dict.fromkeys(POSE, 0.0) | place,
        "drone_offset": dict.fromkeys(POSE, 0.0) | {"y_m": shift},
        "target": dict(zip(POINT, (3.0 * i, 0.0, 0.0), strict=True)),
        "visibility": 0.75, "is_perturbed": variant != "ORI", "target_in_view": True,
        "target_visible": True, "has_caption": i % 2 == 0,
    }  # fmt: skip
    if row["has_caption"]:
        row |= dict.fromkeys((*COUNTED, *CAPTION_FIELDS), "word") | WORDS | {"values_filled_en": 2}
    return row | change
