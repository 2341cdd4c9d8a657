"""Prompts: versioned text files (prompt_files.py) filled with the facts of one observed window, and its pictures.

Nothing here reads the future. Every caption records the hash of its question.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

from caption.answer_formats.formats import FORMATS, AnswerFormat, Draft
from caption.schema import ImageConfig, ObservedWindow
from caption.teachers.prompt_files import Vocabulary
from caption.verification.facts import Facts, measure_facts
from caption.verification.glossary import LANGUAGES, form_of, prompt_line, translations, written_unit
from caption.verification.references import QUANTITIES, Fact, Reference, look_up
from cosfly.formats.captions import ACTIONS, GOAL_WORDS, PICTURES_MARK, TOKENS, Language, Prompt, Writing
from cosfly.llm.student_chat import EncodedImage, chat_messages
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import dump_json
from cosfly.viz.frame_views import VIEW_FILES, Pictures, scaled_size

MAX_RETURNED_CHARACTERS = 6000  # of a refused answer that is returned to its teacher
Frames = Sequence[Sequence[EncodedImage]]  # the pictures of each frame, oldest first


@dataclass(frozen=True)
class Correction:
    """An answer that was refused, and why."""

    answer: str
    complaint: str
    number: int  # of the ask that follows, from 1


@dataclass(frozen=True)
class Question:
    """A question to a teacher about one window: facts for the rule teacher, prompts and pictures for a model."""

    window: ObservedWindow
    facts: Facts
    prompts: dict[Language, Prompt]  # with a mark in place of the sentence about the pictures, which `asked` has
    pictures: Pictures
    writing: Writing
    vocabulary: Vocabulary
    decision: str | None = None  # that the answer must contain (anchored); None: the answer is free
    rejected: str | None = None  # the decision of an earlier, rejected answer (hint)
    ask: int = 0  # number among the asks of its kind, so that each has its own sampling seed and journal key
    correction: Correction | None = None  # an answer to this question that was refused

    @property
    def purpose(self) -> str:
        """The name of this ask: the same in every run, and unique in its window."""
        kind = self.decision or (f"hint_{self.rejected}" if self.rejected else "free")
        return f"{kind}/{self.ask}" + (f"/correction_{self.correction.number}" if self.correction else "")

    @property
    def format(self) -> AnswerFormat:
        return FORMATS[self.writing]

    @property
    def asked(self) -> dict[Language, Prompt]:
        return {language: prompt.filled(self.pictures.sentence(language)) for language, prompt in self.prompts.items()}


@lru_cache
def system_prompt(name: str, vocabulary: Vocabulary) -> str:
    """Return a system prompt: `system_en` and `system_zh` are those of students, which captions record."""
    return vocabulary.templates[name].substitute(actions=", ".join(TOKENS))


def teacher_prompt(question: Question) -> str:
    """Return the system prompt of a teacher; a decision is a constraint (the anchored strategy of sec:appendix_e)."""
    return system_prompt(question.format.system, question.vocabulary) + regeneration_lines(question)


def regeneration_lines(question: Question) -> str:
    """Return what a regeneration adds to the system prompt: the decision, or the rejected one."""
    lines, templates = "", question.vocabulary.templates
    if question.decision is not None:
        words = ACTIONS[question.decision].en
        lines += "\n" + templates["anchored_en"].substitute(decision=question.decision, decision_words=words)
    if question.rejected is not None:
        lines += "\n" + templates["hint_en"].substitute(rejected=question.rejected)
    return lines


def user_prompts(window: ObservedWindow, facts: Facts, vocabulary: Vocabulary) -> dict[Language, str]:
    """Return the questions of a window, with a mark for the sentence about the pictures, without system prompts."""
    is_paper = vocabulary.text_state == "paper"
    numbers = {"num_frames": str(len(facts)), "step_s": f"{facts.step_s:g}", "pictures": PICTURES_MARK}
    users: dict[Language, str] = {}
    for language in LANGUAGES:
        state = _paper_state(window, facts, language) if is_paper else _relative_state(facts, language)
        question = vocabulary.templates[f"user_{language}"].substitute(numbers | state)
        users[language] = "\n".join([question, *_further_lines(window, facts, language)])
    return users


def prompt_hash(question: Question) -> str:
    """Return the hash of a free question and its system prompts."""
    prompts = question.asked.values()
    systems = _hash_of([*[prompt.system for prompt in prompts], teacher_prompt(question)])
    return _hash_of([systems, *[prompt.user for prompt in prompts]])[:16]


def _hash_of(texts: Sequence[str]) -> str:
    return sha256_bytes("\x00".join(texts).encode())


def _further_lines(window: ObservedWindow, facts: Facts, language: Language) -> Iterator[str]:
    """Yield the lines about the goal and the other people, of tracks with other people, and about the mission."""
    if window.goal:
        yield GOAL_WORDS[language] % window.goal[language]
    if None not in facts.others_in_view:
        counts = ", ".join([str(count) for count in facts.others_in_view])
        distances = ", ".join(["-" if away is None else f"{away:.1f}" for away in facts.other_distance_m])
        differences = ", ".join(["-" if count is None else str(count) for count in facts.alike_differences])
        yield prompt_line("others", language) % (counts, distances, differences)
    if window.mission is not None:
        yield prompt_line(window.mission, language)


# Values of the current frame, or of the whole window, in the relative state: quantity -> the words of its two directions.
_CURRENT = {
    "yaw_rate": "left_right", "yaw": "left_right", "forward_speed": "forward_backward",
    "sideways_speed": "left_right", "climb_speed": "up_down", "speed": None, "altitude": None,
    "target_forward_speed": "forward_backward", "target_sideways_speed": "left_right", "target_speed": None,
    "ahead": "forward_backward", "left": "left_right", "above": "up_down", "distance": None, "bearing": "left_right",
    "offset_x": "right_left", "offset_y": "down_up",
}  # fmt: skip
_FIRST = ("speed", "target_speed", "bearing")  # whose values at the first frame are in it, too
# The size in pixels depends on the zoom, which differs between tracks and says nothing about the motion.
_CHANGES = {
    Reference("altitude", "change"): "higher_lower",
    Reference("distance", "change"): "farther_nearer",
    Reference("box_height", "growth"): "larger_smaller",
}


def _relative_state(facts: Facts, language: Language) -> dict[str, str]:
    """Return values of the current frame, some of the first frame, and three changes. A direction is a word, because a
    small student learns a sign badly, and it learns less from prompts with the values of each frame."""

    def written(value: float | None, digits: int, direction: str | None) -> str:
        if value is None:
            return prompt_line("unknown", language)
        text = f"{value:z.{digits}f}"
        if direction is None:
            return text
        positive, negative = prompt_line(direction, language).split("/")
        return f"{negative if text.startswith('-') else positive} {text.removeprefix('-')}"

    _, left, above = facts.place_m[-1] or (None, None, None)
    # Values that are no quantity of the slots, with their digits.
    further = {"left": (left, 1), "above": (above, 1), "climb_speed": (facts.velocity_mps[2], 2)}
    state = {}
    for name, direction in _CURRENT.items():
        if name in further:
            state[name] = written(*further[name], direction)
            continue
        series, digits = QUANTITIES[name].read(facts), QUANTITIES[name].digits
        state[name] = written(series[-1], digits, direction)
        if name in _FIRST:
            state[f"first_{name}"] = written(series[0], digits, direction)
    for change, direction in _CHANGES.items():
        fact = look_up(change, facts)
        name = f"{change.quantity}_{change.aspect}"
        value, digits = (float(fact.value), fact.digits) if isinstance(fact, Fact) else (None, 0)
        state[name] = written(value, digits, direction)
    words = [form_of(word, 0, language) for word in facts.visibility]
    state["visibility"] = ", ".join(words)
    if len(set(words)) == 1:
        state["visibility"] = prompt_line("in_all_frames", language) % words[0]
    return state


def _paper_state(window: ObservedWindow, facts: Facts, language: Language) -> dict[str, str]:
    """Return what the paper's sample states: series of the drone, its poses, the target's mean speed and positions."""
    unknown = prompt_line("unknown", language)
    speeds = [speed for speed in facts.target_step_speeds_mps if speed is not None]
    positions = [
        "(" + ", ".join([f"{axis_m:z.2f}" for axis_m in frame.target_m]) + ")" if place else unknown
        for frame, place in zip(window.frames, facts.place_m, strict=True)
    ]
    poses = []
    for frame in window.frames:
        (x, y, z), (pitch, yaw, roll) = frame.position_m, frame.rotation_deg
        poses.append(f"({x:z.2f}, {y:z.2f}, {z:z.2f}; {pitch:z.1f}, {yaw:z.1f}, {roll:z.1f})")
    return {
        # The oldest frame has no earlier one in the window: 0.0 by definition, as in the paper's sample.
        "speed": ", ".join(["0.0" if v is None else f"{v:.2f}" for v in facts.step_speeds_mps]),
        "altitude": ", ".join([f"{v:.1f}" for v in facts.altitude_m]),
        "yaw": ", ".join([f"{v:.1f}" for v in facts.yaw_deg]),
        "pose": "; ".join(poses),
        "target_speed": f"{sum(speeds) / len(speeds):.2f} {written_unit('mps', language)}" if speeds else unknown,
        "target": "; ".join(positions),
        "visibility": ", ".join([form_of(word, 0, language) for word in facts.visibility]),
    }


# --- requests ---------------------------------------------------------------------------------------------------------


def question_messages(question: Question, frames: Frames) -> tuple[list[dict], list[str]]:
    """Return the chat messages of a question and the digests of its pictures. The pictures come before the flight data:
    windows of one flight share the system prompt as a prefix and four of five frames."""
    parts = [[{"type": "image_url", "image_url": {"url": image.url}} for image in images] for images in frames]
    table = question.format.table(question.facts)
    text = question.asked["en"].user + ("\n" + table if table else "")
    messages = chat_messages(Prompt(system=teacher_prompt(question), user=text), parts)
    if question.correction is not None:
        complaint = question.vocabulary.templates["correction_en"].substitute(complaint=question.correction.complaint)
        messages += [
            {"role": "assistant", "content": question.correction.answer[:MAX_RETURNED_CHARACTERS]},
            {"role": "user", "content": [{"type": "text", "text": complaint}]},
        ]
    return messages, [image.digest for images in frames for image in images]


def mirror_messages(question: Question, english: Draft, complaint: str | None = None) -> list[dict]:
    """Return the chat messages that ask for the Chinese mirror of an English answer, with a complaint about the last."""
    templates = question.vocabulary.templates
    glossary = "\n".join(f"{en} = {zh}" for en, zh in translations())
    system = templates[question.format.mirror_system].substitute(glossary=glossary)
    if complaint:
        system += "\n" + templates["correction_en"].substitute(complaint=complaint)
    user = templates["mirror_user"].substitute(english=dump_json(english.written))
    return [{"role": "system", "content": system}, {"role": "user", "content": user}]


def pictures_of(window: ObservedWindow, cfg: ImageConfig) -> Pictures:
    """Return which pictures of a window are sent: the views of the settings that every observed frame has (public trees
    can lack depth). If none has, pixel values refer to the camera's picture."""
    in_all_frames = frozenset.intersection(*window.frame_files)
    views = tuple([view for view in cfg.modalities if VIEW_FILES[view] in in_all_frames])
    all_are_missing = bool(cfg.modalities) and not views
    size_px = scaled_size(window.width_px, window.height_px, None if all_are_missing else cfg.max_side_px)
    return Pictures(views, size_px, cfg.layout, cfg.depth_range_m)


def make_question(window: ObservedWindow, image: ImageConfig, writing: Writing, vocabulary: Vocabulary) -> Question:
    """Return the free question of a window. Its pixels are those of the pictures that are sent."""
    pictures = pictures_of(window, image)
    facts = measure_facts(window, pictures.size_px)
    prompts = {
        language: Prompt(system=system_prompt(f"system_{language}", vocabulary), user=user)
        for language, user in user_prompts(window, facts, vocabulary).items()
    }
    return Question(window, facts, prompts, pictures, writing, vocabulary)
