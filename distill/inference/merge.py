"""An adapter merged into its base: a model folder for transformers, vLLM and any server."""

import shutil
from pathlib import Path

from cosfly.llm.student_chat import CHAT_FORMAT_FILE
from cosfly.runtime.config import Config
from cosfly.runtime.io import atomic_folder
from cosfly.runtime.run_dir import StageFolder, Tally
from distill.student.model import load_student, loading_errors, student_path, weight_files
from distill.student.saving import check_adapter, write_student

STAGE = "distill.merge"


def run(model: Path, adapter: Path, out: Path) -> Path:
    """Read a base model and an adapter that was trained on it; write and return `model/`, for transformers and vLLM.

    peft adds the update in float32, and each weight is rounded once to the type of the base.

    Raises:
        InputError: the adapter belongs to another base, or cannot be merged.
        StorageError: the disk is full. EnvironmentMissing: torch, transformers or peft is missing.
    """
    model = student_path(str(model))
    inputs = {**weight_files(model), **check_adapter(adapter, model)}
    stage = StageFolder.open(out, STAGE, config=Config(), inputs=inputs, seed=0)
    merged = out / "model"
    if stage.is_complete:
        return merged
    student = load_student(model, device="cpu", dtype="float32", adapter=adapter)
    with loading_errors("adapter", adapter):
        student.model = student.model.merge_and_unload()
    if student.stored is not None:
        student.model.to(student.stored)
    with atomic_folder(merged) as partial:
        write_student(student, partial, model)
        shutil.copyfile(adapter / CHAT_FORMAT_FILE, partial / CHAT_FORMAT_FILE)
    stage.finish([path for path in merged.iterdir() if path.is_file()], Tally(input=1, kept=1))
    return merged
