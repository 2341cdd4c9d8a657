"""Prompts: versioned text files filled with the facts of one observed window, and the pictures that go with them.

Nothing here takes the future. The files are `prompts/*.txt`; their first line is a version, and every caption records the
hash of what was asked.
"""

from __future__ import annotations

import importlib.resources
from dataclasses import dataclass
from functools import cache
from string import Template

from caption.facts import Facts
from caption.glossary import load_glossary
from caption.images import EncodedImage, FrameEncoder, available_modalities
from caption.schema import ImageConfig, Modality, ObservedWindow
from cosfly.coc import ACTIONS, FIELDS, Coc, Language, Prompt
from cosfly.store import dump_json, sha256_bytes

_MODALITY_WORDS: dict[Language, dict[Modality, str]] = {
    "en": {
        "rgb": "RGB",
        "depth": "depth in pseudo-colour (bright is near, dark is far)",
        "segmentation": "segmentation with the pedestrian in red",
    },
    "zh": {"rgb": "RGB 图像", "depth": "深度伪彩色图（亮为近，暗为远）", "segmentation": "分割图（行人标为红色）"},
}


@dataclass(frozen=True)
class Question:
    """What a teacher is asked about one window: the facts for those who compute, prompts and pictures for those who look.

    decision: None for a free answer, else the decision that the answer must hold (anchored). rejected: the decision of an
    earlier answer that did not fit, named as a hint. ask: counts the asks of the
    same kind, so that each has its own sampling seed and journal key.
    """

    window: ObservedWindow
    facts: Facts
    prompts: dict[Language, Prompt]
    modalities: tuple[Modality, ...]
    decision: str | None = None
    rejected: str | None = None
    ask: int = 0

    @property
    def purpose(self) -> str:
        """A name of this ask, stable between runs and unlike any other of its window."""
        kind = self.decision or (f"hint_{self.rejected}" if self.rejected else "free")
        return f"{kind}/{self.ask}"


@cache
def read_prompt(name: str) -> Template:
    """Read `prompts/<name>.txt` without its version line."""
    text = (importlib.resources.files("caption") / "prompts" / f"{name}.txt").read_text(encoding="utf-8")
    version, _, body = text.partition("\n")
    assert version.startswith("# version: "), f"{name}.txt lacks its version line"
    return Template(body.rstrip("\n"))


@cache
def system_prompt(language: Language) -> str:
    return read_prompt(f"system_{language}").substitute(actions=", ".join(ACTIONS))


@cache
def anchored_prompt(decision: str) -> str:
    """Give the English system prompt with a decision as a hard constraint (the anchored strategy of sec:appendix_e)."""
    words = load_glossary().actions[decision]["en"]
    return system_prompt("en") + "\n" + read_prompt("anchored_en").substitute(decision=decision, decision_words=words)


def build_prompts(
    window: ObservedWindow, facts: Facts, modalities: tuple[Modality, ...], layout: str
) -> dict[Language, Prompt]:
    """Write the prompts of both languages from one window."""
    return {
        language: Prompt(system=system_prompt(language), user=_user_prompt(window, facts, modalities, layout, language))
        for language in ("en", "zh")
    }


def prompt_hash(prompts: dict[Language, Prompt]) -> str:
    return sha256_bytes("\x00".join(f"{p.system}\x00{p.user}" for p in prompts.values()).encode())[:16]


def _user_prompt(
    window: ObservedWindow, facts: Facts, modalities: tuple[Modality, ...], layout: str, language: Language
) -> str:
    glossary = load_glossary()
    unknown = {"en": "unknown", "zh": "未知"}[language]
    unit = {"en": " m/s", "zh": " 米/秒"}[language]
    speed = facts.target_speed_mps
    step_s = float(window.time_s[-1] - window.time_s[0]) / (len(window.indices) - 1)
    return read_prompt(f"user_{language}").substitute(
        num_frames=len(window.indices),
        step_s=f"{step_s:.1f}",
        images=_images_sentence(modalities, layout, language),
        # The oldest frame has no earlier one in the window: 0.0 by definition, as in the paper's sample.
        speed=", ".join("0.0" if v is None else f"{v:.2f}" for v in facts.speed_mps),
        altitude=", ".join(f"{v:.1f}" for v in facts.altitude_m),
        yaw=", ".join(f"{v:.1f}" for v in facts.yaw_deg),
        target_speed=unknown if speed is None else f"{speed:.2f}{unit}",
        visibility=", ".join(glossary.visibility[word][language] for word in facts.visibility),
        pose=_tuples(window, language),
        target="; ".join(
            unknown if p[0] != p[0] else "({:z.2f}, {:z.2f}, {:z.2f})".format(*p) for p in window.targets_m.tolist()
        ),
    )


def _tuples(window: ObservedWindow, language: Language) -> str:
    rows = zip(window.positions_m.tolist(), window.rotations_deg.tolist(), strict=True)
    return "; ".join("({:z.2f}, {:z.2f}, {:z.2f}; {:z.1f}, {:z.1f}, {:z.1f})".format(*p, *r) for p, r in rows)


@cache
def _images_sentence(modalities: tuple[Modality, ...], layout: str, language: Language) -> str:
    if not modalities:
        return {"en": "No images are given.", "zh": "未提供图像。"}[language]
    words = [_MODALITY_WORDS[language][modality] for modality in modalities]
    if language == "zh":
        listed = "、".join(words)
        return f"每帧一张图像，从左到右为：{listed}。" if layout == "tiled" else f"每帧依次给出：{listed}。"
    listed = ", ".join(words)
    if layout == "tiled":
        return f"Each frame is one image, from left to right: {listed}."
    return f"Each frame is given as: {listed}."


# --- requests ---------------------------------------------------------------------------------------------------------


def answer_schema(decision: str | None = None) -> dict:
    """Give the JSON schema of an answer; a given decision is the enum's one value."""
    limits = {"critical_components": (20, 1200), "reasoning_trace": (30, 1600)}  # bounded: a server may pad for ever
    properties: dict[str, dict] = {
        name: {"type": "string", "minLength": low, "maxLength": high} for name, (low, high) in limits.items()
    }
    properties["flight_decision"] = {"type": "string", "enum": [decision] if decision else list(ACTIONS)}
    return {"type": "object", "properties": properties, "required": list(FIELDS), "additionalProperties": False}


def mirror_schema(decision: str) -> dict:
    """Give the schema of the Chinese mirror: shorter texts, the decision fixed."""
    schema = answer_schema(decision)
    schema["properties"]["critical_components"]["minLength"] = 7
    schema["properties"]["reasoning_trace"]["minLength"] = 10
    return schema


def question_messages(question: Question, encoder: FrameEncoder) -> tuple[list[dict], list[str]]:
    """Give the chat messages of a question and the digests of its pictures.

    The pictures come first, oldest first, each frame under its name, then the flight data: windows of one flight share the
    system prompt as a prefix and four of five frames as identical pictures.
    """
    content: list[dict] = []
    digests: list[str] = []
    if question.modalities:
        for number, folder in enumerate(question.window.frame_folders):
            content.append({"type": "text", "text": f"t{number}:"})
            for image in encoder.encode(folder, question.modalities):
                content.append(_image_part(image))
                digests.append(image.digest)
    content.append({"type": "text", "text": question.prompts["en"].user})
    system = system_prompt("en") if question.decision is None else anchored_prompt(question.decision)
    if question.rejected is not None:
        system += "\n" + read_prompt("hint_en").substitute(rejected=question.rejected)
    return [{"role": "system", "content": system}, {"role": "user", "content": content}], digests


def _image_part(image: EncodedImage) -> dict:
    return {"type": "image_url", "image_url": {"url": image.url}}


def mirror_messages(english: Coc) -> list[dict]:
    """Give the chat messages that ask for the Chinese mirror of an English answer."""
    system = read_prompt("mirror_system").substitute(glossary=load_glossary().quoted())
    user = read_prompt("mirror_user").substitute(english=dump_json(english.model_dump()))
    return [{"role": "system", "content": system}, {"role": "user", "content": user}]


def make_question(window: ObservedWindow, facts: Facts, image: ImageConfig) -> Question:
    """Make the free question of a window."""
    modalities = available_modalities(window, image.modalities)
    return Question(window, facts, build_prompts(window, facts, modalities, image.layout), modalities)
