"""Every benchmark of tests/benchmarks at its smallest size: it ends without a traceback and prints its figures."""

import os
import re
import sys
from pathlib import Path

import pytest
from processes import ran

FOLDER = Path(__file__).parent / "benchmarks"
SMALL_TOWN = """
import scenes
from cosfly.maps.synthetic import SyntheticConfig, load
scenes.town, scenes.city = lambda seed=0: load(SyntheticConfig(), seed), lambda: None
"""


# A benchmark; arguments, with RUN for a finished run and OUT for a new directory; a pattern of what is printed; and
# what makes the constants of the module `bench` smaller.
CASES = (
    ("bench_flying", "", r"2 side by side: .* steps a second",
             "bench.NUM_DECISIONS = 4"),
    ("bench_planning", "--planners track_astar muco", r"muco \| \d+ \| 1 of 1",
             SMALL_TOWN + "scenes.NUM_WALKS, bench.WALKS = 1, bench.WALKS.model_copy(update={'num_paths': 1})"),
    ("bench_training", "--batch 1 --steps 1", r'"tokens_per_s": \d'),
    ("seeing_student", "--language none.gguf --epochs 1 --without none --out OUT RUN/render",
             r'"target_found": {"trained": [01]\.\d+', """
bench.VISION.update(hidden_size=32, intermediate_size=32, num_hidden_layers=1, num_attention_heads=2)
bench.assemble = lambda language, out, tower: None  # needs the weights of SmolLM2
"""),
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case[0]} {case[1].partition(' ')[0]}")
def test_a_benchmark_prints_its_figures(case, request, tmp_path):
    name, words, figures, before = (*case, "")[:4]
    if "RUN" in words:
        words = words.replace("RUN", str(request.getfixturevalue("small_run")))
    arguments = [f"{name}.py", *words.replace("OUT", str(tmp_path / "out")).split()]
    program = f"import sys, {name} as bench\n{before}\nsys.argv = {arguments!r}\nbench.main()\n"
    paths = [str(FOLDER), str(FOLDER.parent), str(FOLDER.parents[1])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    done = ran(sys.executable, "-c", program, cwd=tmp_path, env=environment)
    assert "Traceback" not in done.stderr
    assert re.search(figures, done.stdout), done.stdout[-3000:]


def test_every_benchmark_is_run():
    programs = {path.stem for path in FOLDER.glob("*.py") if '__name__ == "__main__"' in path.read_text()}
    assert {name for name, *_ in CASES} == programs
