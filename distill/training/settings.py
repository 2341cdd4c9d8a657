"""Settings of `distill train`."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, model_validator

from cosfly.runtime.config import Config, MayDiffer
from distill.student.model import Device, Dtype

STAGE = "distill.train"


class TrainConfig(Config):
    """Settings of `distill train`; those that are MayDiffer change, but for rounding, only how it is computed."""

    method: Literal["lora", "full"] = Field(
        "lora", description="lora: train small matrices next to frozen weights; full: train all weights"
    )
    train_vision: bool = Field(
        False, description="with method full: also train the vision tower, which then encodes pictures at each use"
    )
    lora_rank: int = Field(16, ge=1, description="rank of the LoRA update")
    lora_alpha: ClassVar[float] = 32.0  # the LoRA update is multiplied by alpha / rank
    epochs: int = Field(3, ge=1, description="passes over the training split")
    max_steps: int = Field(0, ge=0, description="stop after this many optimizer steps; 0: no limit")
    samples_per_step: int = Field(16, ge=1, description="samples of an optimizer step, over all processes")
    learning_rate: float = Field(
        1e-4, gt=0, description="peak learning rate of AdamW; it rises over 3 % of the steps, then falls as a cosine"
    )
    decision_weight: float = Field(
        20.0, gt=0, le=1000, description="weight of the decision's tokens in the loss; other tokens have weight 1"
    )
    chat_template: str = Field("", description="file with a chat template for a base model without one; empty: its own")
    allow_code: bool = Field(False, description="run code from the student's repository; only if you trust it")
    max_pixels: int = Field(
        0, ge=0, description="most pixels of a picture; 0: no limit, so that pixel values in texts are right"
    )
    max_tokens: int = Field(
        4096, ge=16, description="longest sample with images and answer, tokens; longer samples are skipped"
    )
    dtype: Dtype = Field("auto", description="number type of the computation; auto: bfloat16 on cuda, float32 on a CPU")

    validation_samples: int = Field(64, ge=0, description="number of samples of val, chosen at random; 0: none")
    validate_every_steps: int = Field(0, ge=0, description="steps between validations; 0: at the end of each epoch")
    patience: int = Field(
        3, ge=0, description="number of validations without an improvement after which training ends; 0: never"
    )
    keep: Literal["best", "last"] = Field(
        "best", description="weights to keep: those of the best validation, or the last"
    )

    batch_size: MayDiffer[int] = Field(1, ge=1, description="number of samples in one forward pass of one process")
    gradient_checkpointing: MayDiffer[bool] = Field(False, description="recompute activations: less memory, slower")
    data_workers: MayDiffer[int] = Field(
        -1, ge=-1, description="number of processes that read pictures; -1: one per core, at most 16"
    )
    compile: MayDiffer[bool] = Field(
        False, description="compile the layers of the language model: faster after some minutes; needs a C compiler"
    )
    report_to: MayDiffer[tuple[str, ...]] = Field(
        (), description="loggers of accelerate that get the curves, such as tensorboard or wandb; empty: none"
    )
    save_every_steps: MayDiffer[int] = Field(50, ge=1, description="steps between checkpoints")
    keep_checkpoints: ClassVar[int] = 2  # newest checkpoints that are kept, besides the best one
    device: MayDiffer[Device] = Field("auto", description="auto, cpu or cuda")

    @model_validator(mode="after")
    def _fits(self) -> TrainConfig:
        if self.train_vision and self.method != "full":
            raise ValueError("train_vision needs method=full, because adapters do not change the vision tower")
        return self
