"""Released captions against the flight that they are released with: prompt, texts, label and verdict, all made anew.

A reader for `cosfly release verify`, which gives a flight as its rows show it. What the rows do not show (the frames
after a window, where a stride left them out) is not judged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np

from caption.run.windows import LabelMotion, cut_future, frames_of, goal_of, label_motion
from caption.schema import EvidenceConfig, FutureMotion, LabelConfig, ObservedFrame, ObservedWindow
from caption.teachers.prompt_files import shipped_prompts
from caption.teachers.prompts import mission_lines, system_prompt, user_prompts
from caption.teachers.reader import judge_text
from caption.truth.actions import Motion, measure, table_of
from caption.truth.facts import Facts, measure_facts
from caption.truth.mirror import check_mirror, flight_numbers
from caption.truth.vocabulary import Vocabulary
from caption.writing.contract import WAYS, Draft, Refused, WayOfWriting, way_of
from cosfly.products.actions import ActionSet
from cosfly.products.answer_text import Parsed
from cosfly.products.captions import Coc, Evidence, Language
from cosfly.products.shown_captions import Lie, ShownCaption, ShownFlight
from cosfly.reading.documents import parse_json

NUDGE = 1e-9  # of a threshold: what taking offsets off again may cost
MOST_SHOWN = 160  # characters of a text in a finding


def read_released(shown: ShownFlight) -> list[Lie]:
    """Say what of a flight's captions cannot be."""
    vocabulary = _vocabulary(shown.actions, tuple(shown.prompts.items()))
    rows = {int(index): row for row, index in enumerate(shown.frame_indices)}
    motion, frames = label_motion(shown.flight, shown.twin), frames_of(shown.flight)
    evidence_cfg = EvidenceConfig.model_validate(shown.settings.get("evidence", {}))
    lies: list[Lie] = []
    for caption in shown.captions:
        picked = [rows.get(index) for index in caption.window]
        if None in picked or len(picked) < 3:
            continue  # found by release verify itself
        mission = _mission_of(caption)
        window = _window(shown, frames, caption, [row for row in picked if row is not None], mission)
        lies += _prompt_lies(window, caption, vocabulary)
        lies += _text_lies(window, caption, evidence_cfg, vocabulary)
        lies += _label_lies(shown, motion, caption, rows, mission)
    return lies


@lru_cache(maxsize=16)
def _vocabulary(actions: ActionSet, prompts: tuple[tuple[str, str], ...]) -> Vocabulary:
    """Give the one vocabulary of all flights that are shown with these."""
    return Vocabulary(actions, shipped_prompts() | dict(prompts))


def _mission_of(caption: ShownCaption) -> str | None:
    """Give the kind of the order that a prompt tells of; None where it tells of none."""
    for language, text in caption.prompts.items():
        for kind, line in mission_lines(language).items():
            if text.endswith("\n" + line):
                return kind
    return None


def _window(
    shown: ShownFlight, frames: tuple[ObservedFrame, ...], caption: ShownCaption, rows: list[int], mission: str | None
) -> ObservedWindow:
    flight = shown.flight
    return ObservedWindow(
        sample_id=caption.sample_id, town=flight.town, trajectory=flight.trajectory, variant=flight.variant,
        indices=caption.window, width_px=flight.camera.width_px, height_px=flight.camera.height_px,
        frames=tuple(frames[row] for row in rows),
        frame_folders=(), frame_files=(), mission=mission, goal=goal_of(flight),
    )  # fmt: skip


def _prompt_lies(window: ObservedWindow, caption: ShownCaption, vocabulary: Vocabulary) -> list[Lie]:
    """The prompt must be the one that the window gives, to the letter: what more it holds nobody could have known."""
    expected = user_prompts(window, measure_facts(window, caption.picture_px), vocabulary)
    lies = []
    for language, text in caption.prompts.items():
        if text != expected[language]:
            where = f"{caption.sample_id}: prompt_{language}"
            lies.append(
                Lie("prompt", where, _difference(text, expected[language]), "the flight data of the window's rows")
            )
    for language, text in caption.systems.items():
        wanted = system_prompt(language, vocabulary)
        if text != wanted:
            where = f"{caption.sample_id}: system_{language}"
            lies.append(
                Lie("prompt", where, _difference(text, wanted), "what stands before every question of these prompts")
            )
    return lies


def _difference(found: str, wanted: str) -> str:
    """Show two texts from where they part."""
    at = next((k for k, (a, b) in enumerate(zip(found, wanted, strict=False)) if a != b), min(len(found), len(wanted)))
    start = max(0, at - 20)
    return f"{found[start : start + 60]!r} where the rows give {wanted[start : start + 60]!r}"


# --- texts ------------------------------------------------------------------------------------------------------------


def _text_lies(window: ObservedWindow, caption: ShownCaption, cfg: EvidenceConfig, vocabulary: Vocabulary) -> list[Lie]:
    """Texts must be what their templates give, each sentence of the state that its evidence gives, and the same in both
    languages."""
    facts = measure_facts(window, caption.picture_px)
    # A decision outside the closed set is found by release verify itself; no template can be filled with it.
    is_closed = caption.decision in vocabulary.actions.actions
    is_judged = caption.evidence is not None and caption.writing in WAYS and is_closed
    lies = state_lies(caption, facts, cfg, vocabulary) if is_judged else []
    if len(caption.answers) == 2:
        reason = check_mirror(caption.answers["en"], caption.answers["zh"], flight_numbers(facts))
        if reason is not None:
            lies.append(Lie("languages", caption.sample_id, f"another {reason}", "the same in English and in Chinese"))
    return lies


def state_lies(caption: ShownCaption, facts: Facts, cfg: EvidenceConfig, vocabulary: Vocabulary) -> list[Lie]:
    assert caption.evidence is not None
    way = way_of(caption.writing, vocabulary)
    try:
        evidence = Evidence.model_validate(parse_json(caption.evidence))
    except ValueError as error:
        got = " ".join(str(error).split())[:MOST_SHOWN]
        return [Lie("evidence", f"{caption.sample_id}: evidence", got, "JSON of what its states follow from")]
    drafts = drafts_of(caption.answers, way, evidence, facts)
    if isinstance(drafts, Refused):
        got = f"{drafts.reason}: {drafts.complaint}"[:MOST_SHOWN]
        return [Lie("evidence", f"{caption.sample_id}: evidence", got, "templates that the flight fills")]
    lies = []
    for language, draft in drafts.items():
        where, shown = f"{caption.sample_id}: {language}", caption.answers[language]
        if draft.coc != shown:
            name = next(name for name in Coc.model_fields if getattr(draft.coc, name) != getattr(shown, name))
            got = _difference(getattr(shown, name), getattr(draft.coc, name))
            lies.append(Lie("caption_text", where, got, "the text that its template gives of the flight"))
            continue
        states = caption.states.get(language)
        judged = judge_text(draft, way, evidence.reader, facts, cfg, language)
        wrong = [n for n, one in enumerate(judged) if states is not None and states[n : n + 1] != (one.state,)]
        if wrong:
            one, called = judged[wrong[0]], (states or ())[wrong[0] : wrong[0] + 1]
            got = f"{one.text or f'sentence {wrong[0] + 1}'} is called {''.join(called) or 'nothing'}"[:MOST_SHOWN]
            expected = f"{one.state}, by flight and evidence" + (f" ({one.problems[0]})" if one.problems else "")
            lies.append(Lie("caption_text", where, got, expected[:MOST_SHOWN]))
    return lies


def drafts_of(
    answers: Mapping[Language, Coc], way: WayOfWriting, evidence: Evidence, facts: Facts
) -> dict[Language, Draft] | Refused:
    """Make the texts of a caption again, from its templates where it was written with slots."""
    if way.name != "slots":
        claims = tuple(evidence.claims or ()) if way.name == "claims" else ()
        return {language: Draft(coc, claims=claims) for language, coc in answers.items()}
    written: dict[Language, Parsed] = {
        language: Parsed(
            Coc(**template.model_dump(exclude={"claims"}), flight_decision=answers[language].flight_decision),
            more=template.model_dump(include={"claims"}),
        )
        for language, template in (evidence.slots or {}).items()
        if language in answers
    }
    if set(written) != set(answers):
        return Refused("slots", f"templates in {', '.join(written) or 'no language'}")
    english = way.read(written["en"], facts)
    if isinstance(english, Refused) or "zh" not in written:
        return english if isinstance(english, Refused) else {"en": english}
    chinese = way.read_mirror(written["zh"], english, facts)
    return chinese if isinstance(chinese, Refused) else {"en": english, "zh": chinese}


# --- labels -----------------------------------------------------------------------------------------------------------


def _label_lies(
    shown: ShownFlight, motion: LabelMotion, caption: ShownCaption, rows: dict[int, int], mission: str | None
) -> list[Lie]:
    """The label must be what the frames after the window show, where these are released."""
    where = f"{caption.sample_id}: label"
    action = shown.actions.actions.get(caption.label or "")
    is_order = action is not None and action.is_order
    if caption.prompts and is_order != (mission is not None):
        got = f"{caption.label}, and {'an order' if mission else 'no order'} in the prompt"
        return [Lie("label", where, got, "an order as label exactly where the prompt tells of one")]
    settings = shown.settings
    label_cfg = LabelConfig.model_validate(settings.get("label", {}))
    num_future = int(settings.get("window", {}).get("future_frames", 5))
    future = _future(shown, motion, caption, rows, num_future)
    if future is None:
        return []
    if mission is not None:
        future = replace(future, order=caption.label)
    measured = measure(future)
    table = table_of(shown.actions, label_cfg)
    label = table.label_of(measured)
    if label != caption.label and caption.label not in _nearly(measured, shown.actions, label_cfg):
        return [Lie("label", where, str(caption.label), f"{label}, which the frames after the window show")]
    if caption.verdict is None:
        return []
    verdict = table.verdict_of(caption.decision, measured, caption.label)
    if verdict != caption.verdict:
        got = f"{caption.verdict} for {caption.decision} (label {caption.label})"
        return [Lie("verdict", f"{caption.sample_id}: verdict", got, f"{verdict}, by the frames after the window")]
    return []


def _nearly(measured: Motion, actions: ActionSet, cfg: LabelConfig) -> set[str | None]:
    """Give the labels of thresholds a nudge away: a value may lie on one."""
    numbers = {name: value for name, value in cfg.model_dump().items() if name != "absent_share"}
    scaled = [cfg.model_copy(update={n: v * (1.0 + side * NUDGE) for n, v in numbers.items()}) for side in (-1, 1)]
    return {table_of(actions, one).label_of(measured) for one in scaled}


def _future(
    shown: ShownFlight, motion: LabelMotion, caption: ShownCaption, rows: dict[int, int], num_future: int
) -> FutureMotion | None:
    """Cut the motion after a window out of the released rows; None where one of its frames is not released."""
    found = [rows.get(caption.frame_index + k) for k in range(-1, num_future + 1)]
    wanted = [row for row in found if row is not None]
    if len(wanted) < len(found) or wanted != list(range(wanted[0], wanted[0] + len(wanted))):
        return None
    return (
        None
        if np.isnan(shown.flight.positions_m[wanted]).any()
        else cut_future(shown.flight, motion, wanted[1], num_future)
    )
