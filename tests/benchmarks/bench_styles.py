"""Which labels the styles of planned flights give, without a picture: `python tests/benchmarks/bench_styles.py
DRONE_TRACE.json ...`.

What the camera sees is told from the five rays and a field of view of 60 degrees, so a rendered flight has a few labels
of search more.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

from caption.run.windows import current_frames, order_comes_within
from caption.schema import FutureMotion, LabelConfig, WindowConfig
from caption.truth.actions import label_of, measure
from cosfly.geometry import look_at, wrap_deg
from cosfly.products.traces import DroneTrace, read_traces

HALF_WIDTH_DEG, HALF_HEIGHT_DEG = 30.0, 18.0


def labels_of(trace: DroneTrace, window: WindowConfig, label: LabelConfig) -> list[tuple[str, str]]:
    """Give (style, label) of every window of a flight."""
    pitch, yaw = (np.degrees(angle) for angle in look_at(trace.positions_m, trace.targets_m))
    aside = np.abs(wrap_deg(yaw - trace.rotations_deg[:, 1])) * np.cos(np.radians(pitch))
    in_view = (aside < HALF_WIDTH_DEG) & (np.abs(pitch - trace.rotations_deg[:, 0]) < HALF_HEIGHT_DEG)
    visible, dt_s, found = in_view & (trace.visibility > 0), float(trace.time_s[1] - trace.time_s[0]), []
    for now in current_frames(len(trace.time_s), window):
        if order_comes_within(trace.mission, now, window.future_frames):
            continue
        span = slice(now, now + window.future_frames + 1)
        before_mps = float(np.linalg.norm(trace.positions_m[now] - trace.positions_m[now - 1])) / dt_s
        order = None if trace.mission is None else trace.mission.order_at(now)
        future = FutureMotion(
            tuple(range(now + 1, span.stop)), trace.time_s[span], trace.positions_m[span], trace.rotations_deg[span, 1],
            trace.targets_m[span], visible[span], before_mps, order=order,
        )  # fmt: skip
        style = next((part.style for part in trace.segments if part.begin <= now < part.end), "follow")
        found.append((style, label_of(measure(future), label) or "none"))
    return found


def shares(counts: Counter) -> str:
    return ", ".join(f"{name} {100 * number / counts.total():.1f}" for name, number in counts.most_common())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("traces", nargs="+", type=Path)
    by_style: dict[str, Counter] = defaultdict(Counter)
    kept = [t for path in parser.parse_args().traces for t in read_traces(path) if t.drop_reason is None]
    for trace in kept:
        for style, label in labels_of(trace, WindowConfig(), LabelConfig()):
            by_style[style][label] += 1
    heights = np.concatenate([t.positions_m[:, 2] - t.targets_m[:, 2] + 0.9 for t in kept])
    slants = np.concatenate([np.linalg.norm(t.positions_m - t.targets_m, axis=1) for t in kept])
    total = sum(by_style.values(), Counter())
    print(f"{len(kept)} flights, {total.total()} windows; percent of them: {shares(total)}")
    for name, values in (("height", heights), ("distance", slants)):
        print(f"{name}, 5th, 50th, 95th percentile: {np.percentile(values, [5, 50, 95]).round(1).tolist()} m")
    for style, counts in sorted(by_style.items()):
        print(f"{style:12} {counts.total():6}  {shares(counts)}")


if __name__ == "__main__":
    main()
