"""What can be told of a row's caption without its meaning: is it whole, of its own row, decided as it says, and from the past alone?

What its words say is told by a reader of captions (caption/run/released.py), which the command line brings along.
"""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

from cosfly.products.answer_text import MAX_CHARACTERS, MIN_CHARACTERS, MIN_CHARACTERS_ZH, is_in_script
from cosfly.products.captions import FIELDS, PICTURES_MARK, Coc
from cosfly.products.sentences import sentences_of
from release.columns import CAPTION, CAPTION_NAMES, LANGUAGES, PICTURE_PX, STATES, WINDOW
from release.verify.findings import Findings
from release.verify.rows import FlightRows, Row

NEVER_NULL = [column.name for column in CAPTION if column.required]
SHARE = 1e-6  # of proved sentences: a quotient of counts
_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def check_captions(flight: FlightRows, window_frames: int | None, findings: Findings) -> None:
    """Check the captions of a flight's rows.

    Args:
        window_frames: of every window, as the record says; None where nobody says.
    """
    released = set(flight.index.tolist())
    for i, row in enumerate(flight.rows):
        if not row.get("has_caption"):
            present = [name for name in CAPTION_NAMES if row.get(name) is not None]
            if present:
                findings.error("caption", flight.where(i, present[0]), "a value", "null: has_caption is false")
            continue
        absent = [name for name in NEVER_NULL if name in row and not row[name]]
        if absent:
            findings.error(
                "caption", flight.where(i, absent[0]), repr(row.get(absent[0])), "a value: has_caption is true"
            )
            continue
        if WINDOW in row:  # a format may have none
            _check_window(flight, i, row, released, window_frames, findings)
        _check_decision(flight, i, row, findings)
        _check_texts(flight, i, row, findings)
        _check_states(flight, i, row, findings)


def _check_window(
    flight: FlightRows, i: int, row: Row, released: set[int], window_frames: int | None, findings: Findings
) -> None:
    window, index = row[WINDOW], row["frame_index"]
    where = flight.where(i, WINDOW)
    if any(frame is None or frame > index for frame in window):
        findings.error("window", where, window, f"nothing after frame {index}, which is the current one")
    elif window != list(range(index - len(window) + 1, index + 1)):
        findings.error("window", where, window, f"frames that follow each other and end with {index}")
    elif window_frames is not None and len(window) != window_frames:
        findings.error("window", where, f"{len(window)} frames", f"{window_frames}, as settings.window_frames says")
    elif not released.issuperset(window):
        findings.error(
            "window", where, f"frame {min(set(window) - released)} is not in the rows", "windows that are whole"
        )
    if row["caption_picture_px"][:1] and any(not 1 <= (side or 0) <= 20_000 for side in row[PICTURE_PX]):
        findings.error("caption", flight.where(i, PICTURE_PX), row[PICTURE_PX], "width and height of a picture")
    elif len(row[PICTURE_PX]) == 2:
        shape, own = row[PICTURE_PX][0] / row[PICTURE_PX][1], row["width_px"] / row["height_px"]
        if not 0.9 < shape / own < 1.1:
            findings.error("caption", flight.where(i, PICTURE_PX), row[PICTURE_PX], f"the shape of {row['width_px']} x {row['height_px']} px")  # fmt: skip


def _check_decision(flight: FlightRows, i: int, row: Row, findings: Findings) -> None:
    """One decision, and a verdict that follows from it and the label."""
    decision, label, verdict = row["decision"], row["label"], row["verdict"]
    texts = {row[f"caption_{language}_flight_decision"] for language in LANGUAGES}
    if texts != {decision}:
        findings.error("decision", flight.where(i, "decision"), sorted({decision, *texts}), "one decision in the row")
    if (verdict == "CONSISTENT") != (label is not None and decision == label):
        got = f"{verdict}: decision {decision}, label {label}"
        findings.error("verdict", flight.where(i, "verdict"), got, "CONSISTENT exactly where the decision is the label")
    elif (verdict == "ABSTAIN" and label is not None) or (verdict == "SOFT_CONFLICT" and label is None):
        findings.error("verdict", flight.where(i, "verdict"), f"{verdict}, label {label}", "ABSTAIN where there is no label, and else not")  # fmt: skip
    if "label_from" in row and (row["label_from"] == "flight") != (row.get("track") == "clean"):
        findings.error("label_from", flight.where(i, "label_from"), f"{row['label_from']} in a {row.get('track')} flight", "flight exactly in a clean one")  # fmt: skip


def _check_texts(flight: FlightRows, i: int, row: Row, findings: Findings) -> None:
    """Texts of their length and script; the same numbers in both prompts, which are one text in two languages."""
    for language in LANGUAGES:
        least = MIN_CHARACTERS_ZH if language == "zh" else MIN_CHARACTERS
        for name, characters in least.items():
            text = row[f"caption_{language}_{name}"]
            place = flight.where(i, f"caption_{language}_{name}")
            if not characters <= len(text) <= MAX_CHARACTERS[name] * 2:
                findings.error("caption_length", place, f"{len(text)} characters", f"{characters} to {MAX_CHARACTERS[name] * 2}")  # fmt: skip
            elif not is_in_script(text, language):
                findings.error("languages", place, repr(text[:60]), f"a text in {language}")
    prompts = {language: row.get(f"prompt_{language}") for language in LANGUAGES}
    for language, prompt in prompts.items():
        if prompt is not None and PICTURES_MARK not in prompt:
            findings.error("prompt", flight.where(i, f"prompt_{language}"), repr(prompt[:60]), f"a prompt with {PICTURES_MARK}")  # fmt: skip
        if prompt is not None and not row.get(f"system_{language}"):
            findings.error("prompt", flight.where(i, f"system_{language}"), "null", "what stands before the prompt")
    told = [Counter(_NUMBER.findall(prompt)) for prompt in prompts.values() if prompt is not None]
    if len(told) == 2 and told[0] != told[1]:
        more = sorted(((told[0] - told[1]) + (told[1] - told[0])).keys())[:4]
        findings.error("prompt", flight.where(i, "prompt_en"), f"{', '.join(more)} in one language", "the same numbers in both")  # fmt: skip
    if len(told) == 1:
        findings.error("prompt", flight.where(i, "prompt_en"), "one language alone", "prompts in both, or in none")


def _check_states(flight: FlightRows, i: int, row: Row, findings: Findings) -> None:
    """States of sentences, their counts and shares are one statement, and as many as there are sentences."""
    for language in LANGUAGES:
        states = row.get(f"sentence_states_{language}")
        counts = {state: row.get(f"{state}_sentences_{language}") for state in STATES}
        share, place = row.get(f"proved_{language}"), flight.where(i, f"sentence_states_{language}")
        if not states:
            if any(count is not None for count in counts.values()) or share is not None:
                findings.error("sentences", place, "null, with counts or a share", "all or none of them")
            continue
        if set(states) - set(STATES):
            findings.error("closed_set", place, sorted(set(states) - set(STATES)), ", ".join(STATES))
        if counts != {state: states.count(state) for state in STATES}:
            findings.error("sentences", place, f"{counts}", "counts of the states beside them")
        if share is None or abs(share - states.count("proved") / len(states)) > SHARE:
            findings.error("sentences", flight.where(i, f"proved_{language}"), share, f"{states.count('proved')} of {len(states)}")  # fmt: skip
        texts: dict[str, Any] = {name: row[f"caption_{language}_{name}"] for name in FIELDS}
        if len(list(sentences_of(Coc(**texts)))) != len(states):
            findings.error("sentences", place, f"{len(states)} states", f"one for each of {len(list(sentences_of(Coc(**texts))))} sentences")  # fmt: skip
