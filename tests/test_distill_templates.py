"""distill: what a student is taught is what its own chat template writes, for the templates of Qwen3.5, 3.6 and 3.8.

The templates here were written for these tests; they branch where the public ones do: texts are trimmed, thoughts of
the last answer are kept and others dropped, 3.6 can keep them (`preserve_thinking`), 3.8 keeps them unless told
otherwise, takes thoughts from their own field alone, and begins its system text with how much to think unless thinking
is off.
"""

import later  # noqa: F401  # skips without torch
import pytest
from specimens_students import FAST, load, samples_of

from cosfly.runtime.errors import InputError
from distill.student.chat import Processor
from distill.training import stage as train
from distill.training.settings import TrainConfig

pytestmark = pytest.mark.usefixtures("one_thread")

TEMPLATE = """
{%- macro words(content) -%}
    {%- if content is string -%}{{ content }}
    {%- else -%}
        {%- for part in content -%}
            {%- if part.type == 'image' -%}{{- '<|vision_start|><|image_pad|><|vision_end|>' -}}
            {%- else -%}{{ part.text }}
            {%- endif -%}
        {%- endfor -%}
    {%- endif -%}
{%- endmacro -%}
{%- set place = namespace(last_question=-1) -%}
{%- for message in messages if message.role == 'user' -%}
    {%- set place.last_question = messages.index(message) -%}
{%- endfor -%}
{%- set effort = '' -%}
EFFORT
{%- for message in messages -%}
    {%- set text = words(message.content) | trim -%}
    {%- if message.role == 'system' and effort -%}{%- set text = effort + '\\n\\n' + text -%}{%- endif -%}
    {%- if message.role == 'assistant' -%}
        {%- set thought = message.reasoning_content if message.reasoning_content is string else '' -%}
        FROM_TEXT
        {%- if KEEPS or loop.index0 > place.last_question -%}
            {%- set text = '<think>\\n' + (thought | trim) + '\\n</think>\\n\\n' + text -%}
        {%- endif -%}
    {%- endif -%}
    {{- '<|im_start|>' + message.role + '\\n' + text + '<|im_end|>\\n' -}}
{%- endfor -%}
{%- if add_generation_prompt -%}
    {{- '<|im_start|>assistant\\n<think>\\n' -}}
    {%- if enable_thinking is defined and enable_thinking is false -%}{{- '\\n</think>\\n\\n' -}}{%- endif -%}
{%- endif -%}
"""
FROM_TEXT = """
        {%- if not thought and '</think>' in text -%}
            {%- set thought = text.split('</think>')[0].split('<think>')[-1] -%}
            {%- set text = text.split('</think>')[-1].lstrip('\\n') -%}
        {%- endif -%}"""
EFFORT = """
{%- if enable_thinking is undefined or enable_thinking is true -%}
    {%- set effort = 'Reasoning effort is set to ' ~ (reasoning_effort | default('xhigh')) ~ '.' -%}
{%- endif -%}"""


def template(keeps_thoughts: str, from_text: str = FROM_TEXT, effort: str = "") -> str:
    return TEMPLATE.replace("KEEPS", keeps_thoughts).replace("FROM_TEXT", from_text).replace("EFFORT", effort)


TEMPLATES = {
    "3.5": template("false"),
    "3.6": template("(preserve_thinking is defined and preserve_thinking)"),
    "3.8": template("(preserve_thinking | default(true))", "", EFFORT),
}


@pytest.fixture(params=TEMPLATES)
def processor(place, request) -> Processor:
    own = load(place)
    return Processor(own.tokenizer, own.library, TEMPLATES[request.param])


def test_prompt_answer_and_end_are_the_whole_chat(place, processor):
    assert processor.end_of_answer == "<|im_end|>\n"
    for sample in samples_of(place)[:4]:
        prompt = processor.prompt_text(sample)
        assert prompt + sample.answer + processor.end_of_answer == processor.chat_text(sample)
        assert prompt.endswith("<|im_start|>assistant\n<think>\n\n</think>\n\n")  # the thought is over before it begins
        assert "Reasoning effort" not in prompt
        assert prompt.count("<|image_pad|>") == len(sample.images) == 5
        row = processor.encode(sample)
        taught = processor.tokenizer.decode([*row.prompt_ids, *row.answer_ids])
        pictures = "<|image_pad|>" * 2  # 64 x 36 px, which the processor rounds to two squares of 32 px
        assert taught == prompt.replace("<|image_pad|>", pictures) + sample.answer + "<|im_end|>"


def test_a_template_that_writes_something_else_ends_before_the_first_step(place, tmp_path):
    """One that signs every answer: what is taught would not be what the student's own template writes."""
    import shutil

    folder = shutil.copytree(place / "student", tmp_path / "student")
    path = folder / "chat_template.jinja"
    text = path.read_text()
    signed = text.replace(
        "{{ '<|im_end|>\n' }}", "{%- if m.role == 'assistant' %}{{ ' -- end' }}{%- endif %}{{ '<|im_end|>\n' }}"
    )
    assert signed != text
    path.write_text(signed)
    with pytest.raises(InputError, match="the training text differs from that of the chat template"):
        train.run(TrainConfig(**FAST), place / "set", [place / "tree"], folder, tmp_path / "out")
