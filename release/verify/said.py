"""What can be told of a row's caption without its meaning: is it whole, of its own row, decided as it says, and from
the past alone?

What its words say is told by a reader of captions (caption/run/released.py), which the command line brings along.
"""

from __future__ import annotations

import re
from collections import Counter
from functools import partial

from cosfly.products.answer_text import MAX_CHARACTERS, MIN_CHARACTERS, MIN_CHARACTERS_ZH, is_in_script
from cosfly.products.captions import FIELDS, PICTURES_MARK, Coc
from cosfly.products.sentences import sentences_of
from release.columns import CAPTION, CAPTION_NAMES, LANGUAGES, PICTURE_PX, STATES, WINDOW
from release.flight_rows import FlightRows, Row
from release.verify.findings import Findings

NEVER_NULL = [column.name for column in CAPTION if column.required]
SHARE = 1e-6  # of proved sentences: a quotient of counts
MOST_SIDE_PX, SAME_SHAPE = 20_000, 0.1  # of a picture that a teacher was shown
_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def check_captions(flight: FlightRows, window_frames: int | None, findings: Findings) -> None:
    """Check the captions of a flight's rows.

    Args:
        window_frames: of every window, as the record says; None where nobody says.
    """
    released = set(flight.index.tolist())
    for i, row in enumerate(flight.rows):
        tell = partial(_tell, flight, i, findings)
        if not row.get("has_caption"):
            if present := [name for name in CAPTION_NAMES if row.get(name) is not None]:
                tell("caption", present[0], "a value", "null: has_caption is false")
        elif absent := [name for name in NEVER_NULL if name in row and not row[name]]:
            tell("caption", absent[0], repr(row.get(absent[0])), "a value: has_caption is true")
        else:
            _check_window(row, released, window_frames, tell)
            _check_decision(row, tell)
            _check_texts(row, tell)
            _check_prompts(row, tell)
            _check_states(row, tell)


def _tell(flight: FlightRows, i: int, findings: Findings, code: str, column: str, got: object, expected: str) -> None:
    findings.error(code, flight.where(i, column), got, expected)


def _check_window(row: Row, released: set[int], window_frames: int | None, tell: partial[None]) -> None:
    window, index, size = row[WINDOW], row["frame_index"], row[PICTURE_PX]
    if any(frame is None or frame > index for frame in window):
        tell("window", WINDOW, window, f"nothing after frame {index}, which is the current one")
    elif window != list(range(index - len(window) + 1, index + 1)):
        tell("window", WINDOW, window, f"frames that follow each other and end with {index}")
    elif window_frames is not None and len(window) != window_frames:
        tell("window", WINDOW, f"{len(window)} frames", f"{window_frames}, as settings.window_frames says")
    elif not released.issuperset(window):
        tell("window", WINDOW, f"frame {min(set(window) - released)} is not in the rows", "windows that are whole")
    if len(size) != 2 or not all(1 <= (side or 0) <= MOST_SIDE_PX for side in size):
        tell("caption", PICTURE_PX, size, "width and height of a picture")
    elif abs(size[0] / size[1] / (row["width_px"] / row["height_px"]) - 1.0) >= SAME_SHAPE:
        tell("caption", PICTURE_PX, size, f"the shape of {row['width_px']} x {row['height_px']} px")


def _check_decision(row: Row, tell: partial[None]) -> None:
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
    if (row["label_from"] == "flight") != (row.get("track") == "clean"):
        got = f"{row['label_from']} in a {row.get('track')} flight"
        tell("label_from", "label_from", got, "flight exactly in a clean one")


def _check_texts(row: Row, tell: partial[None]) -> None:
    """Texts have their length and script."""
    for language in LANGUAGES:
        for name, least in (MIN_CHARACTERS_ZH if language == "zh" else MIN_CHARACTERS).items():
            column, most = f"caption_{language}_{name}", MAX_CHARACTERS[name] * 2
            if not least <= len(row[column]) <= most:
                tell("caption_length", column, f"{len(row[column])} characters", f"{least} to {most}")
            elif not is_in_script(row[column], language):
                tell("languages", column, repr(row[column][:60]), f"a text in {language}")


def _check_prompts(row: Row, tell: partial[None]) -> None:
    """Both prompts are there or none, with the same numbers: they are one text in two languages."""
    prompts = {language: row.get(f"prompt_{language}") for language in LANGUAGES}
    known = {language: prompt for language, prompt in prompts.items() if prompt is not None}
    for language, prompt in known.items():
        if PICTURES_MARK not in prompt:
            tell("prompt", f"prompt_{language}", repr(prompt[:60]), f"a prompt with {PICTURES_MARK}")
        if not row.get(f"system_{language}"):
            tell("prompt", f"system_{language}", "null", "what stands before the prompt")
    numbers = [Counter(_NUMBER.findall(prompt)) for prompt in known.values()]
    if len(numbers) == 1:
        tell("prompt", "prompt_en", "one language alone", "prompts in both, or in none")
    elif numbers and numbers[0] != numbers[1]:
        more = sorted(((numbers[0] - numbers[1]) + (numbers[1] - numbers[0])).keys())[:4]
        tell("prompt", "prompt_en", f"{', '.join(more)} in one language", "the same numbers in both")


def _check_states(row: Row, tell: partial[None]) -> None:
    """States of sentences, their counts and shares are one statement, and as many as there are sentences."""
    for language in LANGUAGES:
        column, share = f"sentence_states_{language}", row.get(f"proved_{language}")
        states, counts = row.get(column), {state: row.get(f"{state}_sentences_{language}") for state in STATES}
        if not states:
            if {share, *counts.values()} != {None}:
                tell("sentences", column, "null, with counts or a share", "all or none of them")
            continue
        if odd := set(states) - set(STATES):
            tell("closed_set", column, sorted(odd, key=str), ", ".join(STATES))
        if counts != {state: states.count(state) for state in STATES}:
            tell("sentences", column, f"{counts}", "counts of the states beside them")
        if share is None or abs(share - states.count("proved") / len(states)) > SHARE:
            tell("sentences", f"proved_{language}", share, f"{states.count('proved')} of {len(states)}")
        text = Coc(**{name: row[f"caption_{language}_{name}"] for name in FIELDS})
        if (number := sum(1 for _ in sentences_of(text))) != len(states):
            tell("sentences", column, f"{len(states)} states", f"one for each of {number} sentences")
