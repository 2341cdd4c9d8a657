"""`cosfly caption doctor URL`: what an endpoint can do, found by trying, before a run pays for it.

Servers answer 200 to much that they ignore, so the checks of schema and pictures ask for something that shows in the
answer or in the count of tokens.
"""

import contextlib
import math
import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import httpx
import numpy as np

from caption.answer_formats.formats import THEREFORE
from caption.schema import CaptionConfig, ObservedFrame, ObservedWindow
from caption.teachers.prompt_files import Vocabulary
from caption.teachers.prompts import MAX_RETURNED_CHARACTERS, Correction, make_question, question_messages
from cosfly.llm.answer_text import answer_schema, object_schema
from cosfly.llm.client import LEFT_OUT, ChatClient
from cosfly.llm.contract import Reply, run_until_interrupted
from cosfly.llm.protocol import MEANINGS, BadReply, Refusal
from cosfly.llm.student_chat import EncodedImage, encoded_image
from cosfly.runtime.console import Advance, progress_bar
from cosfly.runtime.errors import TeacherError
from cosfly.runtime.json_io import parse_json
from cosfly.runtime.model_json import DECLINED
from cosfly.viz.frame_views import VIEW_FILES

State = Literal["ok", "warning", "unusable"]

MAX_COMPLAINT = 2000  # characters that a complaint hardly ever takes
ODD_WORD = "zebra-41"  # what no model writes to a greeting unless it is made to
ODD_SCHEMA = object_schema({"animal": {"type": "string", "enum": [ODD_WORD]}, "legs": {"type": "integer", "enum": [7]}})
MAX_SHOWN = 200  # characters of an answer
MIN_TOKENS = 64  # the smallest `max_tokens`
BLOCK_PX = 8  # the JPEG of a random picture with such blocks takes 44 kB at 640 x 360 px, a rendered frame 49 to 57 kB
SENTENCE = "Nothing has to change. "
PADDING = SENTENCE * 100  # makes a prompt longer by several hundred tokens
READY = "Reply with the one word: ready"
NO_THINKING = "caption.endpoint.extra_body={chat_template_kwargs: {enable_thinking: false}}"


@dataclass(frozen=True)
class Finding:
    """One line of the table. `unusable`: captioning cannot work; `warning`: it can, with a limitation."""

    name: str
    state: State
    detail: str


def examine_endpoint(url: str, cfg: CaptionConfig, vocabulary: Vocabulary) -> list[Finding]:
    """Try an endpoint and show the progress. It is usable if no finding is `unusable`. TeacherError: The URL cannot be
    asked."""
    # A greeting, the schema, a prompt with pictures and one without, the largest prompt, a longer one.
    num_requests = 1 + bool(cfg.endpoint.json_schema) + 2 * bool(cfg.num_images) + 2
    with progress_bar("doctor", num_requests) as advance:
        largest = largest_messages(cfg, vocabulary)
        examination = _Examination(ChatClient(url, cfg.endpoint), cfg, largest, advance)
        return run_until_interrupted(examination.run(), keeps_work=False)


@dataclass(frozen=True)
class _Trial:
    """The outcome of one request."""

    reply: Reply | None  # None if the request failed
    failure: str  # why it failed, "" if it did not
    seconds: float

    @property
    def text(self) -> str:
        return "" if self.reply is None else self.reply.text.strip()

    @property
    def prompt_tokens(self) -> int | None:
        """Tokens of the prompt, None if the server does not report them."""
        return None if self.reply is None or self.reply.usage is None else self.reply.usage.prompt_tokens


@dataclass
class _Examination:
    """The checks of one endpoint, and their findings so far."""

    client: ChatClient
    cfg: CaptionConfig
    largest: list[dict]  # messages as long as ours get
    advance: Advance
    tokens_per_s: float | None = None  # of the last answer that reports its tokens
    findings: list[Finding] = field(default_factory=list)

    async def run(self) -> list[Finding]:
        try:
            await self.client.start()
            self._add("model", "ok", self.client.model)
            if await self._check_answers():
                await self._check_schema()
                if not self.cfg.num_images or await self._check_images():
                    await self._check_largest_prompt()
        except TeacherError as error:
            self._add("model", "unusable", str(error))
        finally:
            await self.client.close()
        if refusal := self.client.left_out.get("no_system"):
            self._add("system role", "warning", LEFT_OUT["no_system"] % refusal)
        return self.findings

    def _add(self, name: str, state: State, detail: str) -> None:
        self.findings.append(Finding(name, state, detail))

    async def _ask(self, what: str, messages: list[dict], max_tokens: int, schema: dict | None = None) -> _Trial:
        """Send one request."""
        endpoint = self.cfg.endpoint.model_copy(update={"max_tokens": max_tokens})
        request = endpoint.request(messages, [], schema or {}, seed=0)
        on_send = partial(self.advance, 1, f"{what}, limit {endpoint.timeout_s:g} s")
        reply, failure = None, ""
        start_s = time.monotonic()
        try:
            reply = await self.client.ask(request, on_send)
        except (TimeoutError, httpx.RequestError) as error:
            failure = self.client.message_of(error)
        except Refusal as refusal:
            failure = str(refusal)
            if refusal.meaning != MEANINGS["unknown"]:
                failure += f"; {self.client.fix_of(refusal.meaning)}"
        except BadReply as error:
            failure = str(error)
        seconds = time.monotonic() - start_s
        if reply is not None and reply.usage is not None and reply.usage.completion_tokens:
            self.tokens_per_s = reply.usage.completion_tokens / seconds
        return _Trial(reply, failure, seconds)

    async def _check_answers(self) -> bool:
        """Send a greeting; return whether it is answered."""
        trial = await self._ask("answers", [_user(READY)], self.cfg.endpoint.max_tokens)
        if problem := _problem_of(trial):
            self._add("answers", "unusable", problem)
            return False
        self._add("answers", "ok", f"{trial.text[:40]!r} after {trial.seconds:.1f} s (any text counts)")
        if (trial.reply and trial.reply.num_thoughts) or "<think" in trial.text:
            fix = f"switch thinking off with {NO_THINKING}"
            self._add("thinking", "warning", f"the model thinks before it answers; {fix}")
        else:
            self._add("thinking", "ok", "off")
        return True

    async def _check_schema(self) -> None:
        """Ask for an unusual answer by a schema, which shows whether the server applies it."""
        plain = "so answers are parsed from plain text"
        if not self.cfg.endpoint.json_schema:
            self._add("JSON schema", "ok", f"switched off (caption.endpoint.json_schema=false), {plain}")
            return
        trial = await self._ask("JSON schema", [_user("Hello! How are you today?")], 256, ODD_SCHEMA)
        if refusal := self.client.left_out.get("schema"):
            self._add("JSON schema", "warning", f"refused, {plain}: {refusal}; {refusal.meaning.fix}")
            return
        if trial.reply is None:
            self._add("JSON schema", "warning", f"not tested: {trial.failure}")
            return
        answer: object = None
        with contextlib.suppress(ValueError):
            answer = parse_json(trial.text)
        if answer == {"animal": ODD_WORD, "legs": 7}:
            self._add("JSON schema", "ok", "applied: the answer has the unusual shape of the schema")
        else:
            got = f"accepted but ignored: asked for {{animal: {ODD_WORD}}}, got {trial.text[:40]!r}"
            effect = f"{plain}, and an anchored decision is not enforced"
            self._add("JSON schema", "warning", f"{got}; {effect}")

    async def _check_images(self) -> bool:
        """Send as many pictures as a prompt of ours holds; return whether the model may see them."""
        limit = self.cfg.endpoint.max_tokens
        pictures = [part for part in self.largest[1]["content"] if part["type"] == "image_url"]
        trial = await self._ask("pictures", [_user(READY, pictures)], limit)
        if trial.reply is None:
            failure = f"a prompt with {len(pictures)} pictures gets no answer: {trial.failure}"
            self._add("image input", "unusable", failure)
            return False
        count = f"{len(pictures)} pictures in a prompt"
        without = None  # tokens of the prompt without pictures
        if trial.prompt_tokens is not None:
            without = (await self._ask("no pictures", [_user(READY)], limit)).prompt_tokens
        if trial.prompt_tokens is None or without is None:
            detail = "but it is unknown whether the model sees them, because token usage is not reported"
            self._add("image input", "warning", f"{count} are accepted, {detail}")
            return True
        tokens = trial.prompt_tokens - without
        if tokens < len(pictures):
            fix = self.client.fix_of(MEANINGS["text_only"])
            self._add("image input", "unusable", f"{count} are accepted but ignored: they add {tokens} tokens; {fix}")
            return False
        self._add("image input", "ok", f"{count}, {tokens} tokens")
        return True

    async def _check_largest_prompt(self) -> None:
        """Send a prompt as long as ours get, with our answer limit and schema; report context and time."""
        endpoint = self.cfg.endpoint
        schema = answer_schema(more=THEREFORE)
        trial = await self._ask("the largest prompt", self.largest, endpoint.max_tokens, schema)
        if trial.reply is not None:
            await self._check_context(trial.prompt_tokens)
            if trial.reply.cut_advice:
                limit = f"caption.endpoint.max_tokens={endpoint.max_tokens}"
                fix = f"{trial.reply.cut_advice} (a good answer takes about 200 tokens)"
                self._add("answer length", "warning", f"the answer is cut at {limit}: {fix}")
            self._report_speed(trial.seconds)
        elif trial.seconds >= endpoint.timeout_s:
            self._report_too_slow()
        else:
            self._add("context length", "unusable", f"the largest prompt gets no answer: {trial.failure}")

    async def _check_context(self, used: int | None) -> None:
        """Check that the largest prompt, of so many tokens if they are reported, and an answer fit the context."""
        limit, context = self.cfg.endpoint.max_tokens, self.client.context
        detail = f"{used or 'unknown'} tokens of the largest prompt and {limit} for the answer"
        if context and used is not None and used + limit > context:
            self._add("context length", "unusable", f"{detail}, more than {context}: {MEANINGS['too_long'].fix}")
        elif used is not None and await self._cuts_prompts(used):
            cut = f"{used} tokens are counted for the largest prompt and for a longer one: the server drops the rest"
            self._add("context length", "unusable", f"{cut} without an error; {MEANINGS['too_long'].fix}")
        else:
            self._add("context length", "ok", detail + (f" of the context of {context}" if context else ""))

    def _report_too_slow(self) -> None:
        """Report that the largest prompt gets no answer in time, and what helps."""
        endpoint = self.cfg.endpoint
        detail = f"the largest prompt gets no answer within {endpoint.timeout_s:g} s"
        answer_s = endpoint.max_tokens / self.tokens_per_s if self.tokens_per_s else 0.0
        if self.tokens_per_s:
            speed = f"{self.tokens_per_s:.1f} tokens/s, as in the answer before"
            detail += f"; at {speed}, an answer of {endpoint.max_tokens} tokens takes {answer_s:.0f} s"
            if answer_s < endpoint.timeout_s / 2:
                detail += ", so it is probably the prompt that takes long to read"
        longer_s = 2 * max(endpoint.timeout_s, answer_s)  # as much again for the prompt
        shorter = "lower caption.endpoint.max_tokens, send smaller or no pictures (caption.image)"
        fix = f"set caption.endpoint.timeout_s={longer_s:.0f}, {shorter}, or use a faster server or a smaller model"
        self._add("speed", "unusable", f"{detail}; {fix}")

    def _report_speed(self, seconds: float) -> None:
        """Report the time of the answer to the largest prompt."""
        limit_s = self.cfg.endpoint.timeout_s
        detail = f"{seconds:.1f} s for an answer to the largest prompt, which no cache holds; most answers take less"
        if 2 * seconds <= limit_s or self.cfg.endpoint.concurrency == 1:
            self._add("speed", "ok", detail)
            return
        # A run begins with two requests at once.
        effect = f"a server with one slot may need more than caption.endpoint.timeout_s={limit_s:g} for two at once"
        fix = f"set caption.endpoint.concurrency=1 or caption.endpoint.timeout_s={3 * seconds:.0f}"
        self._add("speed", "warning", f"{detail}; {effect}: {fix}")

    async def _cuts_prompts(self, used: int) -> bool:
        """Send a longer prompt than the largest one; return whether it counts no more tokens."""
        system, question, *correction = self.largest
        padded = question | {"content": [*question["content"], {"type": "text", "text": PADDING}]}
        longer = await self._ask("a longer prompt", [system, padded, *correction], MIN_TOKENS)
        return longer.prompt_tokens is not None and longer.prompt_tokens <= used


def _problem_of(trial: _Trial) -> str:
    """Return why a simple question has no answer; "" if it has one."""
    if trial.reply is None:
        return trial.failure
    if trial.reply.finish_reason == DECLINED:
        return f"the model declines to answer: {trial.text[:MAX_SHOWN]!r}"
    if trial.text:
        return ""
    fix = f"switch thinking off with {NO_THINKING}, or raise caption.endpoint.max_tokens"
    if trial.reply.num_thoughts:
        return f"{trial.reply.num_thoughts} characters of thinking and no answer; {fix}"
    if trial.reply.finish_reason == "length":
        return f"cut short at caption.endpoint.max_tokens before the text begins, probably by thinking; {fix}"
    return "an empty answer"


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
    refused = SENTENCE * (MAX_RETURNED_CHARACTERS // len(SENTENCE))
    question = replace(
        make_question(window, cfg.image, cfg.writing, vocabulary),
        correction=Correction(refused, refused[:MAX_COMPLAINT], 1),
    )

    def make_pictures(frame_index: int) -> list[EncodedImage]:
        """Make the pictures of a frame: random blocks, so that their files are as large as those of detailed frames."""
        width_px, height_px = question.pictures.size_px
        shape = (len(question.pictures.views), math.ceil(height_px / BLOCK_PX), math.ceil(width_px / BLOCK_PX), 3)
        blocks = np.random.default_rng(frame_index).integers(0, 256, shape, dtype=np.uint8)
        views = blocks.repeat(BLOCK_PX, axis=1).repeat(BLOCK_PX, axis=2)[:, :height_px, :width_px]
        return [encoded_image(picture) for picture in question.pictures.arranged(list(views))]

    messages, _ = question_messages(question, [make_pictures(i) for i in range(count)])
    # Another beginning in every run, because a server answers a prompt in its cache faster.
    messages[0]["content"] = f"Test {time.time_ns()}.\n{messages[0]['content']}"
    return messages


def _user(text: str, pictures: list[dict] | None = None) -> dict:
    return {"role": "user", "content": [*pictures, {"type": "text", "text": text}] if pictures else text}
