"""Check a row's caption without the flight: complete, decided as label and verdict say, made from the past alone."""

from __future__ import annotations

from collections.abc import Callable

from release.columns import CAPTION, CAPTION_NAMES, LANGUAGES, WINDOW
from release.flight_rows import FlightRows, Row
from release.verify.findings import Findings

NEVER_NULL = [column.name for column in CAPTION if column.required]


def check_captions(flight: FlightRows, window_frames: int | None, findings: Findings) -> None:
    """Check the captions of a flight's rows.

    Args:
        window_frames: of every window, as the record says; None where nobody says.
    """
    released = set(flight.index.tolist())
    for i, row in enumerate(flight.rows):

        def tell(code: str, column: str, got: object, expected: str, i: int = i) -> None:
            findings.error(code, flight.where(i, column), got, expected)

        if not row.get("has_caption"):
            if present := [name for name in CAPTION_NAMES if row.get(name) is not None]:
                tell("caption", present[0], "a value", "null: has_caption is false")
        elif absent := [name for name in NEVER_NULL if name in row and not row[name]]:
            tell("caption", absent[0], repr(row.get(absent[0])), "a value: has_caption is true")
        else:
            _check_window(row, released, window_frames, tell)
            _check_decision(row, tell)


def _check_window(row: Row, released: set[int], window_frames: int | None, tell: Callable[..., None]) -> None:
    window, index = row[WINDOW], row["frame_index"]
    if any(frame is None or frame > index for frame in window):
        tell("window", WINDOW, window, f"nothing after frame {index}, which is the current one")
    elif window != list(range(index - len(window) + 1, index + 1)):
        tell("window", WINDOW, window, f"frames that follow each other and end with {index}")
    elif window_frames is not None and len(window) != window_frames:
        tell("window", WINDOW, f"{len(window)} frames", f"{window_frames}, as settings.window_frames says")
    elif not released.issuperset(window):
        tell("window", WINDOW, f"frame {min(set(window) - released)} is not in the rows", "windows that are whole")


def _check_decision(row: Row, tell: Callable[..., None]) -> None:
    """One decision, and a verdict that follows from it and the label."""
    decision, label, verdict = row["decision"], row["label"], row["verdict"]
    decisions = {decision, *(row[f"caption_{language}_flight_decision"] for language in LANGUAGES)}
    if len(decisions) > 1:
        tell("decision", "decision", sorted(decisions), "one decision in the row")
    if (verdict == "CONSISTENT") != (label is not None and decision == label):
        got = f"{verdict}: decision {decision}, label {label}"
        tell("verdict", "verdict", got, "CONSISTENT exactly where the decision is the label")
    elif (verdict == "ABSTAIN" and label is not None) or (verdict == "SOFT_CONFLICT" and label is None):
        tell("verdict", "verdict", f"{verdict}, label {label}", "ABSTAIN where there is no label, and else not")
