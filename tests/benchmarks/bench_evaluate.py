"""Time of `distill evaluate` over made-up answers, and BERTScore beside the library called plainly: docs/distillation.md.

python tests/benchmarks/bench_evaluate.py --samples 10000
python tests/benchmarks/bench_evaluate.py --pairs 300 --width 256     # a random encoder in roberta's shape, layer 17 of 18
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from specimens_distill import make_caption, write_set

from cosfly.products.actions import action_tokens
from cosfly.work.store import dump_json
from distill.evaluation.bertscore import BertScoreConfig, Scorer, score_beside_floors
from distill.evaluation.floors import coc_of, shuffled_groups, shuffled_places
from distill.evaluation.measure import text_of
from distill.evaluation.stage import EvaluateConfig, run
from distill.inference.outcome import make_prediction
from distill.prepare.stage import PrepareConfig, make_sample
from distill.schema import Sample


def samples_of(count: int) -> list[Sample]:
    """English samples of walks of fifty windows each."""
    made = make_sample(make_caption("Town01", "trajectory_1", "ORI", 4), "en", PrepareConfig(), walk="w")
    assert isinstance(made, Sample)
    rng = np.random.default_rng(0)
    found = []
    for number in range(count):
        words = " ".join(f"{value:.1f} m" for value in rng.uniform(5, 50, int(rng.integers(4, 40))))
        answer = coc_of(made).model_copy(
            update={
                "reasoning_trace": f"The pedestrian keeps at {words}.",
                "flight_decision": action_tokens()[number % 5],
            }
        )
        found.append(made.model_copy(update={
            "sample_id": f"trajectory_{number // 50}_ORI_frame_{number % 50:05d}", "walk": f"walk_{number // 50}",
            "answer": dump_json(answer.model_dump()), "decision": answer.flight_decision, "contradicted": ("ascend",),
        }))  # fmt: skip
    return found


def evaluation(count: int) -> None:
    rng = np.random.default_rng(1)
    samples = samples_of(count)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_set(folder / "set", {"train": samples[: count // 2], "test": samples})
        with open(folder / "predictions.jsonl", "w", encoding="utf-8") as file:
            for sample in samples:
                text = sample.answer if rng.random() < 0.7 else sample.answer.replace(sample.decision, "hover")
                file.write(make_prediction(sample, "test", text, 90, True).model_dump_json() + "\n")
        start_s = time.process_time()
        run(EvaluateConfig(), folder / "predictions.jsonl", folder / "set", folder / "out")
        print(f"evaluation of {count:,} samples: {time.process_time() - start_s:.2f} s of processor time")


def make_encoder(folder: Path, width: int, texts: list[str]) -> None:
    import torch
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors, trainers
    from transformers import PreTrainedTokenizerFast, RobertaConfig, RobertaModel

    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=True)
    tokenizer.decoder = decoders.ByteLevel()
    special = ["<s>", "<pad>", "</s>", "<unk>", "<mask>"]
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    tokenizer.train_from_iterator(
        texts,
        trainers.BpeTrainer(vocab_size=600, special_tokens=special, initial_alphabet=alphabet, show_progress=False),
    )
    tokenizer.post_processor = processors.RobertaProcessing(("</s>", 2), ("<s>", 0))
    marks = dict(zip(("cls_token", "pad_token", "sep_token", "unk_token", "mask_token"), special, strict=True))
    PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, bos_token="<s>", eos_token="</s>", model_max_length=512, **marks
    ).save_pretrained(folder)
    config = RobertaConfig(
        vocab_size=tokenizer.get_vocab_size(), hidden_size=width, num_hidden_layers=18, num_attention_heads=width // 64,
        intermediate_size=4 * width, max_position_embeddings=514, pad_token_id=1, initializer_range=0.3,
    )  # fmt: skip
    torch.manual_seed(0)
    RobertaModel(config).save_pretrained(folder)


def bertscore(count: int, width: int, device: str, turns: int) -> None:
    """Print each figure as it comes: processor time on a CPU, time on the clock on an accelerator."""
    import bert_score

    clock = time.process_time if device == "cpu" else time.perf_counter
    references = [text_of(coc_of(sample)) for sample in samples_of(count)]
    candidates = [text.replace("keeps", "stays", 1) + " It walks on." for text in references]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "encoder"
        make_encoder(folder, width, references)
        plain = bert_score.BERTScorer(model_type=str(folder), num_layers=17, device=device, nthreads=1)
        own = Scorer(BertScoreConfig.model_validate({"device": device}), "en", folder, references)
        groups = shuffled_groups(count, np.random.default_rng(0))
        others = [references[place] for place in shuffled_places(groups)]
        who = {"student": candidates, "shuffled": others, "constant": [references[0]] * count}
        plain.score(candidates[:64], references[:64])
        own.score(list(zip(candidates[:64], references[:64], strict=True)))
        for turn in range(turns):
            start_s = clock()
            expected = np.stack([part.numpy() for part in plain.score(candidates, references)], axis=1)
            print(f"turn {turn}: {count} pairs, width {width}: plain {clock() - start_s:.1f} s", flush=True)
            start_s = clock()
            found = own.score(list(zip(candidates, references, strict=True)))
            difference = np.abs(found - expected).max()
            print(f"  ours {clock() - start_s:.1f} s; largest difference {difference:.1e}", flush=True)
            start_s = clock()
            score_beside_floors(own.score, groups, who, references, "en")
            print(f"  ours with two floors {clock() - start_s:.1f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int)
    parser.add_argument("--pairs", type=int)
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--turns", type=int, default=2)
    args = parser.parse_args()
    if args.samples:
        evaluation(args.samples)
    if args.pairs:
        bertscore(args.pairs, args.width, args.device, args.turns)


if __name__ == "__main__":
    main()
