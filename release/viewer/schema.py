"""What the viewer's page is told: flights, the frames of them that are shown, their captions, and the maps below. The page's script reads these names."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from cosfly.look.frame_views import View
from cosfly.products.captions import Language, SentenceState
from cosfly.work.config import Config

Point2 = tuple[float, float]  # x, y, m


class ViewerConfig(Config):
    """How much of a release or run a page holds."""

    flights: int = Field(
        100, ge=1, description="most flights on a page; of more, trajectories spread evenly, both tracks of each"
    )
    frames: int = Field(16, ge=1, description="most frames of a flight, among them one of each verdict and decision")
    picture_px: int = Field(
        320, ge=32, le=1280, description="width of a colour picture, px; depth and mask have half of it"
    )
    jpeg_quality: int = Field(72, ge=1, le=100, description="of the pictures")
    max_mb: int = Field(
        64, ge=1, description="size of the page, MB; what would make it larger loses its pictures, which the page says"
    )


class ShownSentence(BaseModel):
    """A sentence of a caption and what the geometry says of it; None: nobody judged it."""

    field: str
    text: str
    state: SentenceState | None


class ShownCaption(BaseModel):
    """A caption. repair: how a rejected answer was mended; problems: what was found wrong; dropped: why it is not accepted."""

    decision: str | None
    label: str | None
    label_from: str | None
    verdict: str | None
    repair: str | None
    teacher: str
    writing: str | None
    window: list[int]
    texts: dict[Language, list[ShownSentence]]
    problems: list[str] = []
    dropped: str | None = None


class ShownFrame(BaseModel):
    """A frame. drone: x, y, z, m, and yaw, degrees; target: x, y, z, m; events: what became of its perturbation; box: of the
    person, xmin, ymin, xmax, ymax as shares of the picture; pictures: JPEG in base64."""

    index: int
    time_s: float
    drone: tuple[float, float, float, float]
    target: tuple[float, float, float] | None
    visibility: float | None
    is_perturbed: bool
    events: dict[str, str | None] | None
    style: str | None
    fov_deg: float
    box: tuple[float, float, float, float] | None = None
    pictures: dict[View, str] = {}
    caption: ShownCaption | None = None


class ShownFlight(BaseModel):
    """A flight. fovs_deg: the least and the greatest of its frames. group: what both tracks of a trajectory share; map: key of its map; result: of the inspection; paths from above."""

    name: str
    group: str
    map: str
    town: str
    track: Literal["clean", "perturbed"]
    split: str | None
    result: str | None
    fovs_deg: tuple[float, float]
    num_frames: int
    num_captions: int
    drone_path: list[Point2]
    target_path: list[Point2]
    frames: list[ShownFrame]


class ShownBox(BaseModel):
    """A box of the map from above: its kind and the corners of its footprint."""

    kind: str
    corners: list[Point2]


class Shown(BaseModel):
    """The whole page. notes: what it leaves out, and where it comes from."""

    title: str
    kind: Literal["release", "run"]
    notes: list[str]
    maps: dict[str, list[ShownBox]]
    flights: list[ShownFlight]
