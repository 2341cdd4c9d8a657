"""Released captions against the flight that they are released with: prompt, texts, label and verdict, all made anew.

A reader for `cosfly release verify`, which gives a flight as its rows show it. What the rows do not show (the frames after a window,
where a stride left them out) is not judged.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from caption.run.windows import LabelMotion, cut_future, frames_of, label_motion
from caption.schema import FutureMotion, LabelConfig, ObservedFrame, ObservedWindow
from caption.teachers.prompts import mission_lines, system_prompt, user_prompts
from caption.truth.actions import label_of, measure, verdict_of
from caption.truth.facts import measure_facts
from caption.truth.mirror import check_mirror, flight_numbers
from caption.truth.prose import check_prose
from cosfly.products.actions import actions_in_use
from cosfly.products.shown_captions import Lie, ShownCaption, ShownFlight
from cosfly.work import in_place

NUDGE = 1e-9  # of a threshold: what taking offsets off again may cost
MOST_SHOWN = 160  # characters of a text in a finding


def read_released(shown: ShownFlight) -> list[Lie]:
    """Say what of a flight's captions cannot be."""
    with in_place.put(prompts=shown.prompts or None):
        return _read_released(shown)


def _read_released(shown: ShownFlight) -> list[Lie]:
    rows = {int(index): row for row, index in enumerate(shown.frame_indices)}
    motion, frames = label_motion(shown.flight, shown.twin), frames_of(shown.flight)
    lies: list[Lie] = []
    for caption in shown.captions:
        picked = [rows.get(index) for index in caption.window]
        if None in picked or len(picked) < 3:
            continue  # found by release verify itself
        mission = _mission_of(caption)
        window = _window(shown, frames, caption, [row for row in picked if row is not None], mission)
        lies += _prompt_lies(window, caption)
        lies += _text_lies(window, caption)
        lies += _label_lies(shown, motion, caption, rows, mission)
    return lies


def _mission_of(caption: ShownCaption) -> str | None:
    """Give the kind of the order that a prompt tells of; None where it tells of none."""
    for language, text in caption.prompts.items():
        for kind, line in mission_lines(language).items():
            if text.endswith("\n" + line):
                return kind
    return None


def _window(
    shown: ShownFlight,
    frames: tuple[ObservedFrame, ...],
    caption: ShownCaption,
    rows: list[int],
    mission: str | None,
) -> ObservedWindow:
    flight = shown.flight
    return ObservedWindow(
        sample_id=caption.sample_id, town=flight.town, trajectory=flight.trajectory, variant=flight.variant,
        indices=caption.window, width_px=flight.camera.width_px, height_px=flight.camera.height_px,
        frames=tuple(frames[row] for row in rows),
        frame_folders=(), frame_files=(), mission=mission,
    )  # fmt: skip


def _prompt_lies(window: ObservedWindow, caption: ShownCaption) -> list[Lie]:
    """The prompt must be the one that the window gives, to the letter: what more it holds nobody could have known."""
    expected = user_prompts(window, measure_facts(window, caption.picture_px))
    lies = []
    for language, text in caption.prompts.items():
        if text != expected[language]:
            where = f"{caption.sample_id}: prompt_{language}"
            lies.append(
                Lie("prompt", where, _difference(text, expected[language]), "the flight data of the window's rows")
            )
    for language, text in caption.systems.items():
        wanted = system_prompt(language)
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


def _text_lies(window: ObservedWindow, caption: ShownCaption) -> list[Lie]:
    """Texts must be true of the window, as far as their record says that they are, and say the same in both languages."""
    facts = measure_facts(window, caption.picture_px)
    lies = []
    for language, coc in caption.answers.items():
        found = check_prose(coc, facts, language)
        allowed = caption.contradicted.get(language, 0)
        if caption.writing == "claims":  # claims say what a word was meant of, and are not released
            allowed += 1
        if len(found) > allowed:
            got = f"{found[0][:MOST_SHOWN]}" + (f" and {len(found) - 1} more" if len(found) > 1 else "")
            expected = f"at most {allowed} that the flight contradicts, as its record says"
            lies.append(Lie("caption_text", f"{caption.sample_id}: {language}", got, expected))
    if len(caption.answers) == 2:
        reason = check_mirror(caption.answers["en"], caption.answers["zh"], flight_numbers(facts))
        if reason is not None:
            lies.append(Lie("languages", caption.sample_id, f"another {reason}", "the same in English and in Chinese"))
    return lies


# --- labels -----------------------------------------------------------------------------------------------------------


def _label_lies(
    shown: ShownFlight, motion: LabelMotion, caption: ShownCaption, rows: dict[int, int], mission: str | None
) -> list[Lie]:
    """The label must be what the frames after the window show, where these are released."""
    where = f"{caption.sample_id}: label"
    action = actions_in_use().actions.get(caption.label or "")
    is_order = action is not None and action.is_order
    if caption.prompts and is_order != (mission is not None):
        got = f"{caption.label}, and {'an order' if mission else 'no order'} in the prompt"
        return [Lie("label", where, got, "an order as label exactly where the prompt tells of one")]
    settings = shown.settings or {}
    label_cfg = LabelConfig.model_validate(settings.get("label", {}))
    num_future = int(settings.get("window", {}).get("future_frames", 5))
    future = _future(shown, motion, caption, rows, num_future)
    if future is None:
        return []
    if mission is not None:
        future = replace(future, order=caption.label)
    measured = measure(future)
    label = label_of(measured, label_cfg)
    if label != caption.label and caption.label not in _nearly(measured, label_cfg):
        return [Lie("label", where, str(caption.label), f"{label}, which the frames after the window show")]
    if caption.verdict is None:
        return []
    verdict = verdict_of(caption.decision, measured, label_cfg, caption.label)
    if verdict != caption.verdict:
        got = f"{caption.verdict} for {caption.decision} (label {caption.label})"
        return [Lie("verdict", f"{caption.sample_id}: verdict", got, f"{verdict}, by the frames after the window")]
    return []


def _nearly(measured: Any, cfg: LabelConfig) -> set[str | None]:
    """Give the labels of thresholds a nudge away: a value may lie on one."""
    numbers = {name: value for name, value in cfg.model_dump().items() if name != "absent_share"}
    scaled = [cfg.model_copy(update={n: v * (1.0 + side * NUDGE) for n, v in numbers.items()}) for side in (-1, 1)]
    return {label_of(measured, one) for one in scaled}


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
