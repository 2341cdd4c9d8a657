"""`cosfly caption doctor URL`: what an endpoint can do, found by trying, before a run pays for it.

Servers answer 200 to much that they ignore, so the checks of schema and pictures ask for something that shows in the
answer or in the count of tokens.
"""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import httpx
import numpy as np

from caption.answer_formats.contract import THEREFORE
from caption.schema import CaptionConfig, ObservedFrame, ObservedWindow
from caption.teachers.prompt_files import Vocabulary
from caption.teachers.prompts import MAX_RETURNED_CHARACTERS, Correction, make_question, question_messages
from cosfly.llm.answer_text import answer_schema
from cosfly.llm.client import ChatClient
from cosfly.llm.contract import Reply
from cosfly.llm.protocol import BadReply, read_body, thoughts_of
from cosfly.llm.refusals import MEANINGS, RefusedRequest
from cosfly.llm.student_chat import EncodedImage, encoded_image
from cosfly.runtime.errors import TeacherError
from cosfly.runtime.json_io import parse_json
from cosfly.viz.frame_views import VIEW_FILES, Pictures

State = Literal["ok", "warning", "unusable"]

MAX_COMPLAINT = 2000  # characters that a complaint hardly ever takes
ODD_WORD = "zebra-41"  # what no model writes to a greeting unless it is made to
ODD_SCHEMA = {
    "type": "object",
    "properties": {"animal": {"type": "string", "enum": [ODD_WORD]}, "legs": {"type": "integer", "enum": [7]}},
    "required": ["animal", "legs"],
    "additionalProperties": False,
}
READY = "Reply with the one word: ready"
NO_THINKING = "endpoint.extra_body={chat_template_kwargs: {enable_thinking: false}}"


@dataclass(frozen=True)
class Finding:
    """One line of the table. `unusable`: captioning cannot work; `warning`: it can, with a limitation."""

    name: str
    state: State
    detail: str


def examine_endpoint(url: str, cfg: CaptionConfig, vocabulary: Vocabulary) -> list[Finding]:
    """Try an endpoint; it is usable if no finding is `unusable`. TeacherError: the URL cannot be asked."""
    return asyncio.run(_Examination(ChatClient(url, cfg.endpoint), cfg, vocabulary).run())


@dataclass(frozen=True)
class _Probe:
    """The result of one request.

    reply: None if the request failed. detail: Why it failed. refuses_schema: The server refused the schema.
    thoughts: Characters before the answer.
    """

    reply: Reply | None
    detail: str = ""
    refuses_schema: bool = False
    thoughts: int = 0

    @property
    def text(self) -> str:
        return "" if self.reply is None else self.reply.text.strip()

    @property
    def prompt_tokens(self) -> int | None:
        return None if self.reply is None or self.reply.usage is None else self.reply.usage.prompt_tokens


class _Examination:
    def __init__(self, client: ChatClient, cfg: CaptionConfig, vocabulary: Vocabulary) -> None:
        self.client, self.cfg = client, cfg
        self.largest = largest_messages(cfg, vocabulary)
        self.takes_schema = cfg.endpoint.json_schema
        self.findings: list[Finding] = []

    async def run(self) -> list[Finding]:
        try:
            await self.client.start()
            self._add("model", "ok", self.client.model)
            if await self._answers():
                await self._try_schema()
                if await self._takes_images():
                    await self._try_context()
        except TeacherError as error:
            self._add("model", "unusable", str(error))
        finally:
            await self.client.close()
        return self.findings

    def _add(self, name: str, state: State, detail: str) -> None:
        self.findings.append(Finding(name, state, detail))

    async def _ask(self, messages: list[dict], max_tokens: int, schema: dict | None = None) -> _Probe:
        endpoint = self.cfg.endpoint.model_copy(update={"max_tokens": max_tokens})
        request = endpoint.request(messages, [], schema or {}, seed=0)  # sampled as a run samples
        try:
            response, reply = await self.client.ask_once(request, schema)
        except (TimeoutError, httpx.RequestError) as error:
            return _Probe(None, self.client.message_of(error))
        except RefusedRequest as error:
            refusal = error.refusal
            fix = "" if refusal.kind == "unknown" else f"; {refusal.meaning.fix}"
            return _Probe(None, refusal.summary + fix, refusal.kind == "schema")
        except BadReply as error:
            return _Probe(None, str(error))
        return _Probe(reply, thoughts=thoughts_of(read_body(response.body)))

    async def _answers(self) -> bool:
        probe = await self._ask([_user(READY)], self.cfg.endpoint.max_tokens)
        if not probe.text:
            empty = f"{probe.thoughts} characters of thinking and no answer; switch thinking off with {NO_THINKING}"
            self._add("answers", "unusable", probe.detail or (empty if probe.thoughts else "an empty answer"))
            return False
        self._add("answers", "ok", f"{probe.text[:40]!r}")
        is_off = not probe.thoughts and "<think" not in probe.text
        fix = f"the model thinks before it answers; switch thinking off with {NO_THINKING}"
        self._add("thinking", "ok" if is_off else "warning", "off" if is_off else fix)
        return True

    async def _try_schema(self) -> None:
        probe = await self._ask([_user("Hello! How are you today?")], 256, ODD_SCHEMA)
        answer: object = None
        with contextlib.suppress(ValueError):
            answer = parse_json(probe.text)
        if probe.reply is None:
            self.takes_schema &= not probe.refuses_schema
            self._add("JSON schema", "warning", f"refused ({probe.detail}), so answers are parsed from plain text")
        elif answer == {"animal": ODD_WORD, "legs": 7}:
            self._add("JSON schema", "ok", "applied: the answer has the unusual shape of the schema")
        else:
            got = f"accepted but ignored: asked for {{animal: {ODD_WORD}}}, got {probe.text[:40]!r}"
            effect = "so answers are parsed from plain text, and an anchored decision is not enforced"
            self._add("JSON schema", "warning", f"{got}; {effect}")

    async def _takes_images(self) -> bool:
        """Send as many pictures as a prompt of ours holds."""
        limit = self.cfg.endpoint.max_tokens
        pictures = [part for part in self.largest[1]["content"] if part["type"] == "image_url"]
        probe, tokens = await self._ask([_user(READY, pictures)], limit), None
        count = f"{len(pictures)} pictures in a prompt"
        if probe.prompt_tokens is not None:
            without = (await self._ask([_user(READY)], limit)).prompt_tokens
            tokens = None if without is None else probe.prompt_tokens - without
        if probe.reply is None:
            self._add("image input", "unusable", f"a prompt with {len(pictures)} pictures is refused: {probe.detail}")
        elif tokens is None:
            detail = "but it is unknown whether the model sees them, because token usage is not reported"
            self._add("image input", "warning", f"{count} are accepted, {detail}")
        elif tokens < len(pictures):
            self._add("image input", "unusable", f"{count} are accepted but ignored: they add {tokens} tokens")
        else:
            self._add("image input", "ok", f"{count}, {tokens} tokens")
        return self.findings[-1].state != "unusable"

    async def _try_context(self) -> None:
        """Send a prompt as long as ours get, with our answer limit and schema."""
        limit, context = self.cfg.endpoint.max_tokens, self.client.context
        probe = await self._ask(self.largest, limit, answer_schema(more=THEREFORE) if self.takes_schema else None)
        used, known = probe.prompt_tokens, f" of the context of {context}" if context else ""
        detail = f"{used or 'unknown'} tokens of the largest prompt and {limit} for the answer"
        if probe.reply is None:
            self._add("context length", "unusable", f"the largest prompt is refused: {probe.detail}")
        elif context and used is not None and used + limit > context:
            self._add("context length", "unusable", f"{detail}, more than {context}: {MEANINGS['too_long'].fix}")
        else:
            self._add("context length", "ok", f"{detail}{known}")


def largest_messages(cfg: CaptionConfig, vocabulary: Vocabulary) -> list[dict]:
    """Return messages as long as ours get: a made-up window of plain pictures whose numbers have many digits."""
    far_m, rotation_deg = (-12345.67, -12345.67, -12345.67), (-123.4, -123.4, -123.4)
    box_px = (1200.0, 600.0, 1260.0, 700.0)
    frame = ObservedFrame(0.0, far_m, rotation_deg, far_m, (1234.5, 654.3), box_px, True, True, 0.5)
    count = cfg.window.num_frames
    window = ObservedWindow(
        sample_id="doctor_ORI_frame_00004", town="doctor", trajectory="doctor", variant="ORI",
        indices=tuple(range(count)), width_px=1280, height_px=720,
        frames=tuple(replace(frame, time_s=0.5 * i, target_m=(i - 12245.67, -12245.67, 0.0)) for i in range(count)),
        frame_folders=tuple(Path(str(i)) for i in range(count)),
        frame_files=(frozenset(VIEW_FILES.values()),) * count,
    )  # fmt: skip
    refused = "Nothing has to change. " * (MAX_RETURNED_CHARACTERS // 23)
    question = replace(
        make_question(window, cfg.image, cfg.writing, vocabulary),
        correction=Correction(refused, refused[:MAX_COMPLAINT], 1),
    )

    def draw(folder: Path, pictures: Pictures) -> list[EncodedImage]:
        """Draw the pictures of a frame, each in another grey, so that a server takes none for another."""
        num_views, (width_px, height_px) = len(pictures.views), pictures.size_px
        shape = (height_px, width_px * (num_views if pictures.layout == "tiled" else 1), 3)
        greys = [
            (num_views * int(folder.name) + view) % 256
            for view in range(1 if pictures.layout == "tiled" else num_views)
        ]
        return [encoded_image(np.full(shape, grey, np.uint8)) for grey in greys]

    return question_messages(question, draw)[0]


def _user(text: str, pictures: list[dict] | None = None) -> dict:
    return {"role": "user", "content": [*pictures, {"type": "text", "text": text}] if pictures else text}
