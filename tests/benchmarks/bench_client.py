"""How many requests a second the caption client sends: `python tests/benchmarks/bench_client.py`.

A local server in its own process answers every request after a fixed 200 ms. The client captions windows of 15 pictures
of 640x360, once with pictures encoded beforehand and once encoded on the way.
"""

import argparse
import asyncio
import json
import multiprocessing
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scenes  # noqa: F401  # finds the specimens
from specimens_captions import VOCABULARY
from teacher_server import CHINESE, ENGLISH, kept_answers

from caption.schema import CaptionConfig
from caption.stage.asking import Asking
from caption.stage.stage import open_stage
from caption.stage.tracks import find_inputs
from caption.teachers import teacher
from cosfly.formats.frames import SKY_DEPTH_M
from cosfly.viz.frame_views import VIEW_FILES
from specimens import make_playback_tree

WIDTH, HEIGHT, DELAY_S = 640, 360, 0.2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--windows", type=int, default=1600)
    parser.add_argument("--concurrency", type=int, default=64)
    args = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    port = context.Queue()
    server = context.Process(target=_serve, args=(port,), daemon=True)
    server.start()
    url = f"http://127.0.0.1:{port.get(timeout=60)}/v1"
    folder = Path(tempfile.mkdtemp(prefix="bench_client_"))
    try:
        tree = _make_tree(folder / "tree", args.windows)
        endpoint = {"concurrency": args.concurrency, "model": "bench"}
        settings = {"teacher": url, "endpoint": endpoint, "repair": {"hard_conflict": "keep"}}
        cfg = CaptionConfig.model_validate(settings)
        # First run: pictures on the way, cold. Second: another folder, the same pictures already encoded.
        encoded: dict[tuple, list] = {}
        rates = [_client(cfg, tree, folder / name, encoded) for name in ("cold", "warm")]
    finally:
        server.terminate()
        shutil.rmtree(folder)
    for name, rate in zip(("encoded on the way", "encoded before"), rates, strict=True):
        print(f"pictures {name:<20} {rate:7.1f} requests/s")


def _client(cfg: CaptionConfig, tree: Path, out: Path, encoded: dict[tuple, list]) -> float:
    """Caption the tree and return requests per second; pictures of a frame that are in `encoded` are not made again.

    The product is not merged: only asking counts.
    """
    stage = open_stage(cfg, tree, out, 0)
    tracks, _ = find_inputs(cfg, tree)
    plain_encode = teacher.encode_frame

    def encoding(*args: Any) -> list:
        if args[:2] not in encoded:
            encoded[args[:2]] = plain_encode(*args)
        return encoded[args[:2]]

    teacher.encode_frame = encoding
    try:
        start_s = time.monotonic()
        asked = asyncio.run(Asking(stage, cfg, VOCABULARY, 0).run(tracks))
        seconds = time.monotonic() - start_s
    finally:
        teacher.encode_frame = plain_encode
    assert not asked.unanswered, asked.unanswered[:3]
    return len(kept_answers(out)) / seconds


def _make_tree(root: Path, num_windows: int) -> Path:
    """Flights of 40 windows with textured pictures, as large once encoded as rendered ones are."""
    num_flights = max(1, num_windows // 40)
    make_playback_tree(root, num_flights, 49, with_images=False, with_augmented=False, width_px=WIDTH, height_px=HEIGHT)
    rng = np.random.default_rng(0)
    rows = np.linspace(3.0, 90.0, HEIGHT, dtype=np.float32)[:, None]
    for folder in root.rglob("trajectory.json"):
        for index in range(49):
            frame = folder.parent / "frames_playback" / f"frame_{index:05d}"
            frame.mkdir(parents=True, exist_ok=True)
            coarse = rng.integers(0, 255, (HEIGHT // 8, WIDTH // 8, 3), dtype=np.uint8)
            rgb = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
            cv2.imwrite(str(frame / VIEW_FILES["rgb"]), rgb, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            depth_m = np.broadcast_to(rows, (HEIGHT, WIDTH)) + rng.integers(0, 5)
            np.save(frame / VIEW_FILES["depth"], np.where(rows < 5.0, SKY_DEPTH_M, depth_m).astype(np.float32))
            tags = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
            tags[..., 2] = np.repeat(np.repeat(rng.integers(1, 25, (9, 16)), 40, axis=0), 40, axis=1)
            cv2.imwrite(str(frame / VIEW_FILES["segmentation"]), tags, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return root


def _serve(port) -> None:
    """Answer chat completions after the fixed delay, with as little work as can be."""
    decided = {"flight_decision": "hover"}
    replies = [_reply(ENGLISH | {"therefore": "hover"} | decided), _reply(CHINESE | decided)]

    async def handle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while True:
                head = await reader.readuntil(b"\r\n\r\n")
                if head.startswith(b"GET"):
                    writer.write(_http(json.dumps({"data": [{"id": "bench"}]}).encode()))
                    continue
                length = int(head.lower().split(b"content-length:")[1].split(b"\r\n")[0])
                body = await reader.readexactly(length)
                start_s = time.monotonic()
                reply = replies[0] if b'"image_url"' in body else replies[1]
                await asyncio.sleep(DELAY_S - (time.monotonic() - start_s))
                writer.write(reply)
                await writer.drain()
        except (asyncio.IncompleteReadError, ConnectionError):
            writer.close()

    async def run() -> None:
        server = await asyncio.start_server(handle, "127.0.0.1", 0, limit=4 * 2**20, backlog=256)
        port.put(server.sockets[0].getsockname()[1])
        await server.serve_forever()

    asyncio.run(run())


def _reply(answer: dict) -> bytes:
    message = {"role": "assistant", "content": json.dumps(answer, ensure_ascii=False)}
    usage = {"prompt_tokens": 3500, "completion_tokens": 100}
    return _http(json.dumps({"choices": [{"message": message, "finish_reason": "stop"}], "usage": usage}).encode())


def _http(body: bytes) -> bytes:
    return b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: %d\r\n\r\n" % len(body) + body


if __name__ == "__main__":
    main()
