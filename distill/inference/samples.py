"""Types of an inference: its settings, its inputs, and the outcome of a sample."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

from pydantic import Field

from cosfly.formats.predictions import FAILED, Prediction, Split
from cosfly.llm.answer_text import parse_answer
from cosfly.llm.answers import Answer
from cosfly.llm.student_chat import CHAT_FORMAT_FILE, StudentEndpointConfig, read_chat_format
from cosfly.llm.vllm_engine import VllmConfig
from cosfly.runtime.config import Config, MayDiffer
from cosfly.runtime.model_json import CONTEXT_FULL
from cosfly.runtime.run_dir import Failed
from distill.schema import Sample
from distill.student.model import Device

STAGE = "distill.infer"


class InferConfig(Config):
    """Settings of `distill infer`."""

    split: Split = Field("test", description="split whose samples are answered")
    max_samples: int = Field(0, ge=0, description="samples to answer, chosen at random, the same in every run; 0: all")
    max_new_tokens: int = Field(
        512, ge=1, description="longest answer, tokens; a longer answer is cut and does not parse"
    )
    engine: Literal["transformers", "endpoint", "vllm"] = Field(
        "transformers", description="transformers or vLLM in this process, or a server (endpoint) at the URL in --model"
    )
    constrained: bool = Field(
        False, description="endpoint and vllm: enforce the JSON schema of answers; the parse rate then says nothing"
    )
    batch_size: int = Field(
        8, ge=1, description="samples that transformers answers together; rounding may depend on it"
    )
    max_pixels: int = Field(0, ge=0, description="most pixels of a picture; 0: as in training, if that is known")
    allow_code: bool = Field(False, description="run code from the student's repository; only if you trust it")
    device: Device = Field("auto", description="auto, cpu or cuda for transformers; bfloat16 on cuda, float32 on a CPU")
    endpoint: StudentEndpointConfig = Field(
        StudentEndpointConfig(),
        description="requests of endpoint and vllm; max_new_tokens and constrained take precedence",
    )
    vllm: MayDiffer[VllmConfig] = Field(VllmConfig(), description="settings of the engine vllm")

    @property
    def sampling(self) -> StudentEndpointConfig:
        """How engines are asked."""
        return self.endpoint.model_copy(update={"max_tokens": self.max_new_tokens, "json_schema": self.constrained})


@dataclass(frozen=True)
class Inputs:
    """What a run reads."""

    samples: Sequence[Sample]
    trees: Mapping[str, Path]  # run -> playback tree
    model: str | Path  # a folder, or the URL of a server
    adapter: Path | None

    @property
    def training_pixels(self) -> int:
        """Most pixels of a picture in the student's training; 0 if not known, as of a server or a base model."""
        folder = self.adapter or Path(self.model)
        return read_chat_format(folder).max_pixels if (folder / CHAT_FORMAT_FILE).is_file() else 0

    @property
    def name(self) -> str:
        """Name by the folders: `x/student/model` is "student", with the adapter `x/lora/adapter` "student+lora"."""
        folder = Path(self.model).absolute()
        name = folder.parent.name if folder.name == "model" else folder.name
        return name if self.adapter is None else f"{name}+{self.adapter.absolute().parent.name}"


@dataclass(frozen=True)
class SampleOutcome:
    """A sample with its answer, or with the reason why there is none."""

    sample: Sample
    result: Answer | Failed
    is_new: bool = False  # not recorded by an earlier run

    @classmethod
    def failed(cls, sample: Sample, code: str, error: object) -> Self:
        """Return the outcome of a sample that got no answer."""
        return cls(sample, Failed(id=sample.key, code=code, message=str(error)))

    def prediction(self, split: Split, model: str) -> Prediction:
        """Return the record of the sample."""
        if isinstance(self.result, Failed):
            record = make_prediction(self.sample, split, failure=self.result.code)
        else:
            is_finished = self.result.finish_reason not in ("length", CONTEXT_FULL)
            num_tokens = self.result.usage.get("completion_tokens", 0)
            record = make_prediction(self.sample, split, self.result.text, num_tokens, is_finished)
        return record.model_copy(update={"model": model})


def make_prediction(
    sample: Sample, split: Split, text: str = "", num_tokens: int = 0, is_finished: bool = False, *, failure: str = ""
) -> Prediction:
    """Parse an answer and return its record; `failure` is the code of the reason if there is no answer."""
    parsed = parse_answer(text, sample.language, finish_reason=None if is_finished else "length")
    return Prediction(
        **sample.model_dump(include={"sample_id", "language", "run", "window_id"}), split=split, raw=text,
        num_tokens=num_tokens, is_finished=is_finished, coc=parsed.coc,
        reason=f"{FAILED}{failure}" if failure else parsed.reason, recovered=list(parsed.recovered),
    )  # fmt: skip
