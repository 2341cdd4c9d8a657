"""Prompts: versioned text files (prompt_files.py) filled with the facts of one observed window, and the pictures that
go with them.

Nothing here takes the future. Every caption records the hash of what was asked.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from caption.answer_formats.contract import Draft, WayOfWriting, way_of
from caption.schema import ImageConfig, ObservedFrame, ObservedWindow
from caption.teachers.images import FrameSource, pictures_of
from caption.teachers.prompt_files import prompt_format
from caption.verification.facts import Facts, measure_facts
from caption.verification.glossary import load_glossary
from caption.verification.vocabulary import Vocabulary
from cosfly.formats.captions import ACTIONS, GOAL_WORDS, PICTURES_MARK, TOKENS, Language, Prompt, Writing
from cosfly.formats.segments import MISSION_KINDS
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import dump_json
from cosfly.viz.frame_views import Pictures, frame_label

MAX_RETURNED_CHARACTERS = 6000  # of a refused answer, when it is shown to who wrote it


@dataclass(frozen=True)
class Correction:
    """An answer that was refused, and why; number: of the ask that follows from it, from 1."""

    answer: str
    complaint: str
    number: int


@dataclass(frozen=True)
class Question:
    """What a teacher is asked about one window: the facts for those who compute, prompts and pictures for those who
    look.

    prompts: with a mark where the sentence about the pictures goes; `asked` has the sentence for these pictures.
    decision: None for a free answer, else the decision that the answer must hold (anchored). rejected: the decision of
    an earlier answer that did not fit, named as a hint. ask: counts the asks of the
    same kind, so that each has its own sampling seed and journal key. correction: an answer to this question that was
    not taken.
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
        """A name of this ask, stable between runs and unlike any other of its window."""
        kind = self.decision or (f"hint_{self.rejected}" if self.rejected else "free")
        return f"{kind}/{self.ask}" + (f"/correction_{self.correction.number}" if self.correction else "")

    @property
    def asked(self) -> dict[Language, Prompt]:
        return {language: prompt.told(self.pictures.sentence(language)) for language, prompt in self.prompts.items()}


@lru_cache
def _with_actions(name: str, vocabulary: Vocabulary) -> str:
    return vocabulary.templates[name].substitute(actions=", ".join(TOKENS))


def system_prompt(language: Language, vocabulary: Vocabulary) -> str:
    return _with_actions(f"system_{language}", vocabulary)


def way_prompt(way: WayOfWriting, decision: str | None = None) -> str:
    """Return the system prompt of a way of writing; a decision is a hard constraint (the anchored strategy of
    sec:appendix_e)."""
    prompt = _with_actions(way.system, way.vocabulary)
    return prompt if decision is None else f"{prompt}\n{decision_words(decision, way.vocabulary)}"


def decision_words(decision: str, vocabulary: Vocabulary) -> str:
    """Return the words that tie an answer to a decision."""
    words = ACTIONS[decision].en
    return vocabulary.templates["anchored_en"].substitute(decision=decision, decision_words=words)


def build_prompts(window: ObservedWindow, facts: Facts, vocabulary: Vocabulary) -> dict[Language, Prompt]:
    """Write the prompts of both languages from one window, with a mark for the sentence about the pictures."""
    users = user_prompts(window, facts, vocabulary)
    return {language: Prompt(system=system_prompt(language, vocabulary), user=user) for language, user in users.items()}


def user_prompts(window: ObservedWindow, facts: Facts, vocabulary: Vocabulary) -> dict[Language, str]:
    """Write the questions alone, without what stands before all of them."""
    numbers = _numbers(window, facts)
    languages: tuple[Language, Language] = ("en", "zh")
    return {language: _user_prompt(numbers, window, facts, language, vocabulary) for language in languages}


def mission_lines(language: Language) -> dict[str, str]:
    """Return the last line of a prompt that tells of an order, by its kind."""
    return _MISSION[language]


def prompt_hash(question: Question) -> str:
    """Return the hash of the plain question and of how its answer is to be written."""
    standing = _standing_hash(*[prompt.system for prompt in question.prompts.values()], way_prompt(question.way))
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
    speed = facts.target_speed_mps
    words = load_glossary().visibility
    own = {
        "pictures": PICTURES_MARK,
        "target_speed": unknown if speed is None else f"{speed:.2f}{unit}",
        "visibility": ", ".join([words[word][language] for word in facts.visibility]),
        "target": "; ".join([_target_text(frame) or unknown for frame in window.frames]),
    }
    told = prompt_format(f"user_{language}", vocabulary) % (numbers | own)
    told = "\n".join([told, *_company_lines(window, facts, language)])
    return told if window.mission is None else f"{told}\n{_MISSION[language][window.mission]}"


def _company_lines(window: ObservedWindow, facts: Facts, language: Language) -> list[str]:
    """Tell whom to follow and who else is there, in windows of flights with other people."""
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


# A state of the drone like its speed: told from the frame on at which it knows, and not what follows from it.
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


def _numbers(window: ObservedWindow, facts: Facts) -> dict[str, str]:
    """Return the numbers of a prompt, which are the same in both languages."""
    frames = window.frames
    step_s = (frames[-1].time_s - frames[0].time_s) / (len(frames) - 1)
    return {
        "num_frames": str(len(window.indices)),
        "step_s": f"{round(step_s, 3):g}",
        # The oldest frame has no earlier one in the window: 0.0 by definition, as in the paper's sample.
        "speed": ", ".join(["0.0" if v is None else f"{v:.2f}" for v in facts.speed_mps]),
        "altitude": ", ".join([f"{v:.1f}" for v in facts.altitude_m]),
        "yaw": ", ".join([f"{v:.1f}" for v in facts.yaw_deg]),
        "pose": "; ".join([_pose_text(frame) for frame in frames]),
    }


# Five windows of a flight share a frame, and both languages its text.
@lru_cache(maxsize=64)
def _pose_text(frame: ObservedFrame) -> str:
    (x, y, z), (pitch, yaw, roll) = frame.position_m, frame.rotation_deg
    return f"({x:z.2f}, {y:z.2f}, {z:z.2f}; {pitch:z.1f}, {yaw:z.1f}, {roll:z.1f})"


@lru_cache(maxsize=64)
def _target_text(frame: ObservedFrame) -> str:
    """Return the target's position, "" where it is not known."""
    x, y, z = frame.target_m
    return "" if x != x else f"({x:z.2f}, {y:z.2f}, {z:z.2f})"


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
    system, templates = way_prompt(question.way, question.decision), question.way.vocabulary.templates
    if question.rejected is not None:
        system += "\n" + templates["hint_en"].substitute(rejected=question.rejected)
    messages: list[dict] = [{"role": "system", "content": system}, {"role": "user", "content": content}]
    return messages + correction_messages(question.correction, question.way.vocabulary), digests


def text_of(question: Question) -> str:
    """Return the text of a question: the flight data, and what its way of writing shows beside them."""
    table = question.way.table(question.facts)
    return question.asked["en"].user + ("\n" + table if table else "")


def correction_messages(correction: Correction | None, vocabulary: Vocabulary) -> list[dict]:
    """Return the messages that follow a question whose answer was refused: that answer, and what was wrong."""
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
        complaint: what was wrong with an earlier one.
    """
    templates = way.vocabulary.templates
    system = templates[way.mirror_system].substitute(glossary=way.vocabulary.quoted())
    if complaint:
        system += "\n" + templates["correction_en"].substitute(complaint=complaint)
    user = templates["mirror_user"].substitute(english=dump_json(english.written))
    return [{"role": "system", "content": system}, {"role": "user", "content": user}]


def make_question(window: ObservedWindow, image: ImageConfig, writing: Writing, vocabulary: Vocabulary) -> Question:
    """Make the free question of a window; its pixels are those of the pictures that are sent."""
    pictures = pictures_of(window, image)
    facts = measure_facts(window, pictures.size_px)
    prompts = build_prompts(window, facts, vocabulary)
    return Question(window, facts, prompts, pictures, way_of(writing, vocabulary))
