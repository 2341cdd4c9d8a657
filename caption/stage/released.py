"""Labels, verdicts and values of released captions, recomputed from the points of the track.

A reader for `cosfly release verify`, which gives all points of a track, also those whose frames are not released.
"""

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from pydantic import ValidationError

from caption.answer_formats.formats import FORMATS, Refused, fill_answer
from caption.schema import FutureMotion, ObservedFrame
from caption.stage.windows import LabelMotion, cut_future, frames_of, label_motion, observe
from caption.verification.actions import TABLE, ActionTable, Motion, Thresholds, measure
from caption.verification.facts import Facts, measure_facts
from caption.verification.glossary import prompt_line
from caption.verification.values import check_values
from cosfly.formats.captions import ORDERS, Coc, Evidence, Language, verdict_on
from cosfly.formats.segments import MISSION_KINDS
from cosfly.formats.shown_captions import Mismatch, ReleasedTrack, ShownCaption

NUDGE = 1e-9  # of a threshold: rounding error of subtracting the offsets again


def read_released(track: ReleasedTrack) -> list[Mismatch]:
    """Return the labels, verdicts and values of a track's captions that do not follow from its points."""
    motion, frames = label_motion(track.flight, track.twin), frames_of(track.flight)
    mismatches: list[Mismatch] = []
    for caption in track.captions:
        if mismatch := _check_label(track, motion, caption):
            mismatches.append(mismatch)
        mismatches += _check_values(track, frames, caption)
    return mismatches


def _order_of(caption: ShownCaption) -> str | None:
    """Return the kind of the order that the prompt gives, None without one."""
    for kind, (language, text) in itertools.product(MISSION_KINDS, caption.prompts.items()):
        if text.endswith("\n" + prompt_line(kind, language)):
            return kind
    return None


def _check_label(track: ReleasedTrack, motion: LabelMotion, caption: ShownCaption) -> Mismatch | None:
    """Compare label and verdict with the frames after the window."""
    where = f"{caption.sample_id}: label"
    has_order = _order_of(caption) is not None
    if caption.prompts and has_order != (caption.label in ORDERS):
        got = f"{caption.label}, and {'an order' if has_order else 'no order'} in the prompt"
        return "label", where, got, "an order as the label if and only if the prompt has one"
    future = _future(track, motion, caption)
    if future is None:
        return None
    measured = measure(replace(future, order=caption.label) if has_order else future)
    label = TABLE.label_of(measured)
    if label != caption.label and caption.label not in _nearby_labels(measured):
        return "label", where, str(caption.label), f"{label}, by the frames after the window"
    verdict = verdict_on(caption.decision, caption.label, TABLE.contradicted_by(measured, caption.label))
    if caption.verdict is None or verdict == caption.verdict:
        return None
    got = f"{caption.verdict} for {caption.decision} (label {caption.label})"
    return "verdict", f"{caption.sample_id}: verdict", got, f"{verdict}, by the frames after the window"


def _nearby_labels(measured: Motion) -> set[str | None]:
    """Return the labels by thresholds that are a nudge smaller or larger: a value may lie on a threshold."""
    thresholds = {name: value for name, value in vars(Thresholds()).items() if name != "absent_share"}
    labels = set()
    for factor in (1.0 - NUDGE, 1.0 + NUDGE):
        nudged = Thresholds(**{name: value * factor for name, value in thresholds.items()})
        labels.add(ActionTable(nudged).label_of(measured))
    return labels


def _future(track: ReleasedTrack, motion: LabelMotion, caption: ShownCaption) -> FutureMotion | None:
    """Return the motion after a window; None if the track has no such points."""
    num_future = int(track.settings.get("window", {}).get("future_frames", 5))
    now = caption.frame_index
    is_inside = 1 <= now < len(track.flight) - num_future
    if not is_inside or np.isnan(track.flight.positions_m[now - 1 : now + num_future + 1]).any():
        return None
    return cut_future(track.flight, motion, now, num_future)


def _check_values(track: ReleasedTrack, frames: tuple[ObservedFrame, ...], caption: ShownCaption) -> Iterator[Mismatch]:
    """Fill the slots of the texts again, and compare numbers with the facts of the window."""
    window, where = caption.window, f"{caption.sample_id}: evidence"
    if len(window) < 2 or list(window) != list(range(window[0], window[-1] + 1)) or not window[0] >= 0:
        return  # `release verify` reports such a window itself
    try:
        evidence = Evidence.model_validate_json(caption.evidence)
    except ValidationError as error:
        yield "values", where, str(error.errors()[0]["msg"]), "the evidence of the values, as JSON"
        return
    observed = observe(track.flight, frames, slice(window[0], window[-1] + 1), _order_of(caption))
    facts = measure_facts(observed, caption.picture_px)  # type: ignore[arg-type]
    for language, counts in caption.values.items():
        is_counted = any(count is not None for count in counts)
        if is_counted and (mismatch := _check_text(caption, evidence, facts, language)):
            yield mismatch


def _check_text(caption: ShownCaption, evidence: Evidence, facts: Facts, language: Language) -> Mismatch | None:
    """Compare the text and the counts of values of one language with what the facts of the window give."""
    where, released = f"{caption.sample_id}: caption_{language}", Coc(**caption.texts[language])
    template = (evidence.slots or {}).get(language)
    if template is None:
        draft = FORMATS["prose"].read(released, facts)
    else:
        draft = fill_answer(Coc(**template.model_dump(), flight_decision=released.flight_decision), facts, language)
    if isinstance(draft, Refused):
        return "values", where, draft.complaint, "slots that the facts of the window fill"
    if draft.coc != released and caption.repair != "fix_label":  # that text was filled with the earlier decision
        name = next(name for name in vars(released) if getattr(released, name) != getattr(draft.coc, name))
        return "values", f"{where}_{name}", getattr(released, name), getattr(draft.coc, name)
    counts = caption.values[language]
    checked = check_values(draft.outside, facts, language, draft.num_filled).counts
    expected = (checked.values_filled, checked.values_matched, checked.values_contradicted)
    if expected == counts:
        return None
    return "values", where, f"filled, matched, contradicted {counts}", f"{expected}, by the points of the window"
