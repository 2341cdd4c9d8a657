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


def read_released(shown: ReleasedTrack) -> list[Mismatch]:
    """Return the labels, verdicts and values of a track's captions that do not follow from its points."""
    motion, frames = label_motion(shown.flight, shown.twin), frames_of(shown.flight)
    return [
        mismatch
        for caption in shown.captions
        for mismatch in (_label(shown, motion, caption), *_values(shown, frames, caption))
        if mismatch is not None
    ]


def _order_of(caption: ShownCaption) -> str | None:
    """Return the kind of the order that the prompt gives, None without one."""
    for kind, (language, text) in itertools.product(MISSION_KINDS, caption.prompts.items()):
        if text.endswith("\n" + prompt_line(kind, language)):
            return kind
    return None


def _label(shown: ReleasedTrack, motion: LabelMotion, caption: ShownCaption) -> Mismatch | None:
    """Compare label and verdict with the frames after the window."""
    where, has_order = f"{caption.sample_id}: label", _order_of(caption) is not None
    if caption.prompts and has_order != (caption.label in ORDERS):
        got = f"{caption.label}, and {'an order' if has_order else 'no order'} in the prompt"
        return "label", where, got, "an order as the label if and only if the prompt has one"
    future = _future(shown, motion, caption)
    if future is None:
        return None
    measured = measure(replace(future, order=caption.label) if has_order else future)
    label = TABLE.label_of(measured)
    if label != caption.label and caption.label not in _nearly(measured):
        return "label", where, str(caption.label), f"{label}, by the frames after the window"
    verdict = verdict_on(caption.decision, caption.label, TABLE.contradicted_by(measured, caption.label))
    if caption.verdict is None or verdict == caption.verdict:
        return None
    got = f"{caption.verdict} for {caption.decision} (label {caption.label})"
    return "verdict", f"{caption.sample_id}: verdict", got, f"{verdict}, by the frames after the window"


def _nearly(measured: Motion) -> set[str | None]:
    """Return the labels of thresholds a nudge away: a value may lie on one."""
    numbers = {name: value for name, value in vars(Thresholds()).items() if name != "absent_share"}
    scaled = [Thresholds(**{n: v * (1.0 + side * NUDGE) for n, v in numbers.items()}) for side in (-1, 1)]
    return {ActionTable(one).label_of(measured) for one in scaled}


def _future(shown: ReleasedTrack, motion: LabelMotion, caption: ShownCaption) -> FutureMotion | None:
    """Return the motion after a window; None if the track has no such points."""
    num_future = int(shown.settings.get("window", {}).get("future_frames", 5))
    now = caption.frame_index
    if now < 1 or now + num_future >= len(shown.flight):
        return None
    if np.isnan(shown.flight.positions_m[now - 1 : now + num_future + 1]).any():
        return None
    return cut_future(shown.flight, motion, now, num_future)


def _values(shown: ReleasedTrack, frames: tuple[ObservedFrame, ...], caption: ShownCaption) -> Iterator[Mismatch]:
    """Fill the slots of the texts again, and compare numbers with the facts of the window."""
    window, where = caption.window, f"{caption.sample_id}: evidence"
    if len(window) < 2 or list(window) != list(range(window[0], window[-1] + 1)) or not window[0] >= 0:
        return  # a finding of its own
    try:
        evidence = Evidence.model_validate_json(caption.evidence)
    except ValidationError as error:
        yield "values", where, str(error.errors()[0]["msg"]), "the evidence of the values, as JSON"
        return
    observed = observe(shown.flight, frames, slice(window[0], window[-1] + 1), _order_of(caption))
    facts = measure_facts(observed, caption.picture_px)  # type: ignore[arg-type]
    for language, counts in caption.values.items():
        if any(count is not None for count in counts):  # otherwise they were not counted
            yield from _of_language(caption, evidence, facts, language)


def _of_language(caption: ShownCaption, evidence: Evidence, facts: Facts, language: Language) -> Iterator[Mismatch]:
    where, told = f"{caption.sample_id}: caption_{language}", Coc(**caption.texts[language])
    template = (evidence.slots or {}).get(language)
    if template is None:
        draft = FORMATS["prose"].read(told, facts)
    else:
        draft = fill_answer(Coc(**template.model_dump(), flight_decision=told.flight_decision), facts, language)
    if isinstance(draft, Refused):
        yield "values", where, draft.complaint, "slots that the facts of the window fill"
        return
    if draft.coc != told and caption.repair != "fix_label":  # its text was filled before the decision was changed
        names = [name for name in vars(told) if getattr(told, name) != getattr(draft.coc, name)]
        yield "values", f"{where}_{names[0]}", getattr(told, names[0]), getattr(draft.coc, names[0])
        return
    counts = caption.values[language]
    found = check_values(draft.outside, facts, language, draft.num_filled).counts
    if (expected := tuple(vars(found).values())) != counts:
        yield "values", where, f"filled, matched, contradicted {counts}", f"{expected}, by the points of the window"
