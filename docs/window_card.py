"""Make one HTML page that shows a window with its caption: how the pictures in docs/images were made.

python docs/window_card.py RUN SAMPLE_ID card.html
chromium --headless --no-sandbox --window-size=1180,560 --screenshot=card.png card.html
"""

import base64
import html
import sys
from pathlib import Path

import cv2

from cosfly.formats.captions import read_captions
from cosfly.formats.frames import read_rgb
from cosfly.formats.playback_file import read_track
from cosfly.formats.tracks import find_tracks

CROP_PX = (360, 270)  # region around the target that is shown of each frame, at the size it has in a 1280x720 image

STYLE = """body{font:15px/1.45 'DejaVu Sans','Noto Sans CJK SC',sans-serif;margin:14px;width:1150px;color:#222}
.frames{display:flex;gap:6px}.frames div{font-size:12px;color:#666}img{display:block;width:224px}
.texts{display:flex;gap:22px;margin-top:10px}.texts>div{flex:1}b{color:#0b5}h3{margin:0 0 4px;font-size:15px}
.meta{color:#666;font-size:13px;margin-top:8px}p{margin:4px 0}"""


def crop(run_tree: Path, caption, index: int) -> str:
    """Return one observed frame around the target, as a JPEG data URL."""
    folders = {(f.parent.name, f.name): f for f in find_tracks(run_tree)}
    flight = read_track(folders[caption.trajectory, caption.variant])
    image = read_rgb(flight.frame_folder(index))
    scale = image.shape[1] / 1280
    width, height = int(CROP_PX[0] * scale), int(CROP_PX[1] * scale)
    u, v = flight.target.uv[index]
    left = int(min(max(u - width / 2, 0), image.shape[1] - width))
    top = int(min(max(v - height / 2, 0), image.shape[0] - height))
    part = cv2.resize(
        image[top : top + height, left : left + width],
        (448, 336),
        interpolation=cv2.INTER_AREA if scale > 1 else cv2.INTER_CUBIC,
    )
    data = cv2.imencode(".jpg", cv2.cvtColor(part, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 88])[1]
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def main(run: Path, sample_id: str, out: Path) -> None:
    caption = next(c for c in read_captions(run / "caption/captions.jsonl") if c.sample_id == sample_id)
    frames = "".join(f'<div><img src="{crop(run / "render", caption, i)}">frame {i}</div>' for i in caption.window)
    texts = "".join(
        f"<div><h3>{name}</h3><p>{html.escape(coc.critical_components)}</p><p>{html.escape(coc.reasoning_trace)}</p>"
        f"<p><b>{coc.flight_decision}</b></p></div>"
        for name, coc in (("English", caption.en), ("中文", caption.zh))
    )
    facts = f"{sample_id} · label from the future geometry ({caption.label_from}): {caption.label}"
    facts += f" · verdict: {caption.verdict} · teacher: {caption.teacher.kind}"
    if caption.repair:
        facts += f" · regenerated: {caption.repair.strategy}, first decision {caption.repair.first_decision}"
    page = f"<!doctype html><meta charset=utf-8><style>{STYLE}</style><div class=frames>{frames}</div>"
    page += f"<div class=texts>{texts}</div><div class=meta>{facts}</div>"
    out.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
