"""Check the captions of a track: whole or null, and their labels, verdicts and values by a reader (cosfly caption)."""

from typing import Any

from cosfly.formats.captions import FIELDS
from cosfly.formats.shown_captions import ReleasedTrack, ShownCaption
from cosfly.runtime.errors import shown
from release.columns import CAPTION, LANGUAGES, PICTURE_PX, VALUES, WINDOW
from release.reading import Row, TrackRows
from release.verify.findings import Findings


def check_captions(track: TrackRows, window_frames: int, findings: Findings) -> None:
    """Check that captions are whole or null, the length of their windows, and verdict against label and decision."""
    for i, row in enumerate(track.rows):
        has_caption, decision = row["has_caption"], row["decision"]
        if wrong := _wrong_columns(row):
            expected = f"{'a value' if has_caption else 'null'}, because has_caption is {has_caption}"
            findings.error("caption", track.where(i, wrong[0]), shown(row[wrong[0]]), expected)
        if wrong or not has_caption:
            continue
        window, current = row[WINDOW], row["frame_index"]
        if window != list(range(current - window_frames + 1, current + 1)) or window[0] < 0:
            expected = f"{window_frames} consecutive frames up to {current}"
            findings.error("window", track.where(i, WINDOW), window, expected)
        if any(row[f"caption_{language}_flight_decision"] != decision for language in LANGUAGES):
            findings.error("decision", track.where(i, "decision"), decision, "the same decision in all columns")
        if (row["verdict"] == "CONSISTENT") != (decision == row["label"]):
            got = f"{row['verdict']}, decision {decision}, label {row['label']}"
            expected = "CONSISTENT if and only if the decision is the label"
            findings.error("verdict", track.where(i, "verdict"), got, expected)


def _wrong_columns(row: Row) -> list[str]:
    """Return the columns of captions that are null in a row with a caption, or not null in a row without one."""
    if row["has_caption"]:
        return [column.name for column in CAPTION if column.required and not row[column.name]]
    return [column.name for column in CAPTION if row[column.name] is not None]


def released_track(
    frames: TrackRows, points: TrackRows, clean: TrackRows | None, settings: dict[str, Any]
) -> ReleasedTrack:
    """Return what a reader of captions needs: all points of a track, and of its clean one if it has the same frames."""
    captions = [shown_caption(row) for row in frames.rows if row.get("has_caption")]
    twin = None
    if clean is not None and len(clean) == len(points):
        twin = clean.track
    return ReleasedTrack(points.track, captions, twin, settings)


def shown_caption(row: Row) -> ShownCaption:
    """Return the caption of a row; KeyError or TypeError if a part is missing, which `check_captions` reports."""
    return ShownCaption(
        sample_id=row["sample_id"], frame_index=row["frame_index"], window=row[WINDOW] or [],
        picture_px=tuple(row[PICTURE_PX]),
        prompts={language: row[f"prompt_{language}"] for language in LANGUAGES if row.get(f"prompt_{language}")},
        texts={language: {name: row[f"caption_{language}_{name}"] for name in FIELDS} for language in LANGUAGES},
        writing=row["writing"],
        values={language: tuple(row[f"{name}_{language}"] for name in VALUES) for language in LANGUAGES},
        evidence=row["evidence"], decision=row["decision"], repair=row["repair_strategy"], label=row["label"],
        verdict=row["verdict"],
    )  # fmt: skip
