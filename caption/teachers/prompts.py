"""Prompts: versioned text files (prompt_files.py) filled with the facts of one observed window, and its pictures.

Nothing here reads the future. Every caption records the hash of its question.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from caption.answer_formats.contract import Draft, WayOfWriting, way_of
from caption.schema import ImageConfig, ObservedFrame, ObservedWindow, TextState
from caption.teachers.images import FrameSource, pictures_of
from caption.teachers.prompt_files import prompt_format
from caption.verification.facts import Facts, Series, measure_facts
from caption.verification.glossary import load_glossary
from caption.verification.references import Fact, Reference, look_up
from caption.verification.vocabulary import Vocabulary
from cosfly.formats.captions import ACTIONS, GOAL_WORDS, PICTURES_MARK, TOKENS, Language, Prompt, Writing
from cosfly.formats.segments import MISSION_KINDS
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import dump_json
from cosfly.viz.frame_views import Pictures, frame_label

MAX_RETURNED_CHARACTERS = 6000  # of a refused answer that is returned to its teacher


@dataclass(frozen=True)
class Correction:
    """An answer that was refused, and why. number: of the ask that follows, from 1."""

    answer: str
    complaint: str
    number: int


@dataclass(frozen=True)
class Question:
    """A question to a teacher about one window: facts for the rule teacher, prompts and pictures for a model.

    Args:
        prompts: with a mark in place of the sentence about the pictures; `asked` has the sentence.
        decision: the decision that the answer must contain (anchored); None: the answer is free.
        rejected: the decision of an earlier, rejected answer (hint).
        ask: number of this ask among those of its kind, so that each has its own sampling seed and journal key.
        correction: an answer to this question that was refused.
    """

    window: ObservedWindow
    facts: Facts
    prompts: dict[Language, Prompt]
    pictures: Pictures
    way: WayOfWriting
    decision: str | None = None
    rejected: str | None = None
    ask: int = 0
    correction: Correction | None = None

    @property
    def purpose(self) -> str:
        """The name of this ask: the same in every run, and unique in its window."""
        kind = self.decision or (f"hint_{self.rejected}" if self.rejected else "free")
        return f"{kind}/{self.ask}" + (f"/correction_{self.correction.number}" if self.correction else "")

    @property
    def asked(self) -> dict[Language, Prompt]:
        return {language: prompt.told(self.pictures.sentence(language)) for language, prompt in self.prompts.items()}


@lru_cache
def _with_actions(name: str, vocabulary: Vocabulary) -> str:
    return vocabulary.templates[name].substitute(actions=", ".join(TOKENS))


def student_prompt(language: Language, vocabulary: Vocabulary) -> str:
    """Return the system prompt that a student is trained with, and that captions record."""
    return _with_actions(f"system_{language}", vocabulary)


def teacher_prompt(way: WayOfWriting, decision: str | None = None) -> str:
    """Return the system prompt of a teacher; a decision is a constraint (the anchored strategy of sec:appendix_e)."""
    prompt = _with_actions(way.system, way.vocabulary)
    return prompt if decision is None else f"{prompt}\n{decision_words(decision, way.vocabulary)}"


def decision_words(decision: str, vocabulary: Vocabulary) -> str:
    """Return the sentences that constrain an answer to a decision."""
    words = ACTIONS[decision].en
    return vocabulary.templates["anchored_en"].substitute(decision=decision, decision_words=words)


def build_prompts(window: ObservedWindow, facts: Facts, vocabulary: Vocabulary) -> dict[Language, Prompt]:
    """Return the prompts of a window in both languages, with a mark for the sentence about the pictures."""
    users = user_prompts(window, facts, vocabulary)
    return {
        language: Prompt(system=student_prompt(language, vocabulary), user=user) for language, user in users.items()
    }


def user_prompts(window: ObservedWindow, facts: Facts, vocabulary: Vocabulary) -> dict[Language, str]:
    """Return the questions without the system prompt, which is the same for all windows."""
    numbers = _numbers(window, facts, vocabulary.text_state)
    languages: tuple[Language, Language] = ("en", "zh")
    return {language: _user_prompt(numbers, window, facts, language, vocabulary) for language in languages}


def mission_lines(language: Language) -> dict[str, str]:
    """Return the last line of a prompt by the kind of the mission's order."""
    return _MISSION[language]


def prompt_hash(question: Question) -> str:
    """Return the hash of the free question and its system prompts."""
    standing = _standing_hash(*[prompt.system for prompt in question.prompts.values()], teacher_prompt(question.way))
    users = [
        prompt.user.replace(PICTURES_MARK, question.pictures.sentence(language))
        for language, prompt in question.prompts.items()
    ]
    return sha256_bytes("\x00".join([standing, *users]).encode())[:16]


@lru_cache(maxsize=16)
def _standing_hash(*texts: str) -> str:
    """Return the hash of the texts that are the same in every question."""
    return sha256_bytes("\x00".join(texts).encode())


def _user_prompt(
    numbers: dict[str, str], window: ObservedWindow, facts: Facts, language: Language, vocabulary: Vocabulary
) -> str:
    unknown, unit = _WORDS_OF_NUMBERS[language]
    glossary = load_glossary()
    own = {"pictures": PICTURES_MARK}
    visibility = [glossary.visibility(word, language) for word in facts.visibility]
    if vocabulary.text_state == "paper":
        speed = _mean_step_speed(facts)
        own |= {
            "visibility": ", ".join(visibility),
            "target_speed": unknown if speed is None else f"{speed:.2f}{unit}",
            "target": "; ".join([place or unknown for place in _target_texts(window, facts)]),
        }
    else:
        own |= {"visibility_before": ", ".join(visibility[:-1]), "visibility": visibility[-1]}
    lines = [prompt_format(f"user_{language}", vocabulary) % (numbers | own), *_company_lines(window, facts, language)]
    if window.mission is not None:
        lines.append(_MISSION[language][window.mission])
    return "\n".join(lines)


def _company_lines(window: ObservedWindow, facts: Facts, language: Language) -> list[str]:
    """Return the lines about the goal and the other people, of tracks with other people."""
    lines = [GOAL_WORDS[language] % window.goal[language]] if window.goal else []
    if None in facts.others_in_view:
        return lines
    away = ["-" if one is None else f"{one:.1f}" for one in facts.other_distance_m]
    alike = ["-" if one is None else str(one) for one in facts.alike_differences]
    told = (map(str, facts.others_in_view), away, alike)
    return [*lines, _OTHERS[language] % tuple(", ".join(one) for one in told)]


_OTHERS: dict[Language, str] = {
    "en": "Other people in view: [%s]; from the target to the nearest: [%s] m; the most alike differs from it in [%s] "
    "of the items of appearance.",
    "zh": "视野内其他行人数：[%s]；其中最近者距目标：[%s] 米；外观与目标最相近者有 [%s] 项不同。",
}


# The state of the mission, from the frame on at which the drone knows it; the decision that follows is not named.
_MISSION: dict[Language, dict[str, str]] = {
    "en": {
        "geofence": "Mission: the border of the permitted area is reached; the pursuit may not go on.",
        "battery": "Mission: the battery is down to the reserve for the way home.",
        "time_over": "Mission: the time of the mission is over.",
    },
    "zh": {
        "geofence": "任务状态：已到达允许飞行区域的边界，不得继续跟踪。",
        "battery": "任务状态：电池电量已降至返航储备。",
        "time_over": "任务状态：任务时间已到。",
    },
}
assert all(set(told) == set(MISSION_KINDS) for told in _MISSION.values())

_WORDS_OF_NUMBERS: dict[Language, tuple[str, str]] = {"en": ("unknown", " m/s"), "zh": ("未知", " 米/秒")}


def _numbers(window: ObservedWindow, facts: Facts, text_state: TextState) -> dict[str, str]:
    """Return the numbers of a prompt, which are the same in both languages."""
    numbers = {"num_frames": str(len(facts)), "step_s": f"{facts.step_s:g}"}
    return numbers | (_paper_numbers(window, facts) if text_state == "paper" else _relative_numbers(facts))


def _relative_numbers(facts: Facts) -> dict[str, str]:
    """Return the earlier values, the current value and the change of every series, and the velocities.

    The change is that of the slot `{change:...}`: from the first frame at which the value is known.
    """
    numbers = dict[str, str]()
    for name, (series, form) in _series(facts).items():
        texts = ["-" if value is None else form % value for value in series]
        known = [value for value in series if value is not None]
        numbers[f"{name}_before"], numbers[name] = ", ".join(texts[:-1]), texts[-1]
        numbers[f"{name}_change"] = (
            "-" if series[-1] is None or len(known) < 2 else _signed(form % (known[-1] - known[0]))
        )
    velocities: dict[str, float | None] = dict(zip(_VELOCITY, facts.velocity_mps, strict=True))
    velocities |= zip(_TARGET_VELOCITY, facts.target_velocity_mps or (None, None), strict=True)
    numbers |= {name: "-" if speed is None else f"{speed:.2f}" for name, speed in velocities.items()}
    growth = look_up(_BOX_GROWTH, facts)
    numbers["box_growth"] = _signed(f"{growth.value:.0f}") if isinstance(growth, Fact) else "-"
    return numbers | {"yaw_rate": f"{facts.yaw_rate_dps[-1]:.1f}"}


def _signed(number: str) -> str:
    """Return a printed number with its sign; a zero has none."""
    return "0" if not number.strip("-0.") else number if number[0] == "-" else f"+{number}"


# The size in pixels depends on the zoom, which differs between tracks and says nothing about the motion.
_BOX_GROWTH = Reference("box_height", "growth")
_VELOCITY = ("forward_speed", "sideways_speed", "climb_speed")
_TARGET_VELOCITY = ("target_forward_speed", "target_sideways_speed")


def _series(facts: Facts) -> dict[str, tuple[Series, str]]:
    """Return the series of the relative state, each with its format."""
    ahead, left, above = ([place and place[axis] for place in facts.place_m] for axis in range(3))
    return {
        "ahead": (ahead, "%.1f"), "left": (left, "%.1f"), "above": (above, "%.1f"),
        "distance": (facts.distance_m, "%.1f"), "bearing": (facts.bearing_deg, "%.1f"),
        "offset_x": (facts.offset_x_px, "%d"), "offset_y": (facts.offset_y_px, "%d"),
        "target_speed": (facts.target_speeds_mps, "%.2f"), "speed": (facts.speed_mps, "%.2f"),
        "yaw": (facts.yaw_deg, "%.1f"), "altitude": (facts.altitude_m, "%.1f"),
    }  # fmt: skip


def _paper_numbers(window: ObservedWindow, facts: Facts) -> dict[str, str]:
    return {
        # The oldest frame has no earlier one in the window: 0.0 by definition, as in the paper's sample.
        "speed": ", ".join(["0.0" if v is None else f"{v:.2f}" for v in facts.step_speeds_mps]),
        "altitude": ", ".join([f"{v:.1f}" for v in facts.altitude_m]),
        "yaw": ", ".join([f"{v:.1f}" for v in facts.yaw_deg]),
        "pose": "; ".join([_pose_text(frame) for frame in window.frames]),
    }


def _mean_step_speed(facts: Facts) -> float | None:
    speeds = [speed for speed in facts.target_step_speeds_mps if speed is not None]
    return sum(speeds) / len(speeds) if speeds else None


# Five windows of a track share a frame, and both languages its text.
@lru_cache(maxsize=64)
def _pose_text(frame: ObservedFrame) -> str:
    (x, y, z), (pitch, yaw, roll) = frame.position_m, frame.rotation_deg
    return f"({x:z.2f}, {y:z.2f}, {z:z.2f}; {pitch:z.1f}, {yaw:z.1f}, {roll:z.1f})"


def _target_texts(window: ObservedWindow, facts: Facts) -> list[str]:
    """Return the target's position at each frame, "" where the target is not seen."""
    return [
        "(" + ", ".join([f"{axis_m:z.2f}" for axis_m in frame.target_m]) + ")" if place else ""
        for frame, place in zip(window.frames, facts.place_m, strict=True)
    ]


# --- requests ---------------------------------------------------------------------------------------------------------


def question_messages(question: Question, encoder: FrameSource) -> tuple[list[dict], list[str]]:
    """Return the chat messages of a question and the digests of its pictures.

    The pictures come first, oldest first, each frame under its name, then the flight data: windows of one flight share
    the system prompt as a prefix and four of five frames as identical pictures.
    """
    content: list[dict] = []
    digests: list[str] = []
    if question.pictures.views:
        for number, folder in enumerate(question.window.frame_folders):
            content.append({"type": "text", "text": frame_label(number)})
            for image in encoder.encode(folder, question.pictures):
                content.append({"type": "image_url", "image_url": {"url": image.url}})
                digests.append(image.digest)
    content.append({"type": "text", "text": text_of(question)})
    system, templates = teacher_prompt(question.way, question.decision), question.way.vocabulary.templates
    if question.rejected is not None:
        system += "\n" + templates["hint_en"].substitute(rejected=question.rejected)
    messages: list[dict] = [{"role": "system", "content": system}, {"role": "user", "content": content}]
    return messages + correction_messages(question.correction, question.way.vocabulary), digests


def text_of(question: Question) -> str:
    """Return the text of a question: the flight data, and the table that its answer format adds."""
    table = question.way.table(question.facts)
    return question.asked["en"].user + ("\n" + table if table else "")


def correction_messages(correction: Correction | None, vocabulary: Vocabulary) -> list[dict]:
    """Return the messages after a question whose answer was refused: the answer, and what is wrong with it."""
    if correction is None:
        return []
    text = vocabulary.templates["correction_en"].substitute(complaint=correction.complaint)
    return [
        {"role": "assistant", "content": correction.answer[:MAX_RETURNED_CHARACTERS]},
        {"role": "user", "content": [{"type": "text", "text": text}]},
    ]


def mirror_messages(english: Draft, way: WayOfWriting, complaint: str | None = None) -> list[dict]:
    """Return the chat messages that ask for the Chinese mirror of an English answer.

    Args:
        complaint: what is wrong with an earlier one.
    """
    templates = way.vocabulary.templates
    system = templates[way.mirror_system].substitute(glossary=way.vocabulary.quoted())
    if complaint:
        system += "\n" + templates["correction_en"].substitute(complaint=complaint)
    user = templates["mirror_user"].substitute(english=dump_json(english.written))
    return [{"role": "system", "content": system}, {"role": "user", "content": user}]


def make_question(window: ObservedWindow, image: ImageConfig, writing: Writing, vocabulary: Vocabulary) -> Question:
    """Return the free question of a window. Its pixels are those of the pictures that are sent."""
    pictures = pictures_of(window, image)
    facts = measure_facts(window, pictures.size_px)
    prompts = build_prompts(window, facts, vocabulary)
    return Question(window, facts, prompts, pictures, way_of(writing, vocabulary))
