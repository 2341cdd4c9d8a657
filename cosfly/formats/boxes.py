"""`boxes_3d.json` and `step2_simplified.json`: boxes in the paper's fields (tab:boxes_schema)."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator, model_validator

from cosfly.formats.columns import LARGEST, rounded
from cosfly.formats.kinds import GROUND_KINDS, KIND_COLORS, KIND_NAMES, KINDS
from cosfly.formats.meshes import Meshes, MeshRef
from cosfly.geometry.axes import axis_aligned_half_extents
from cosfly.geometry.ground import Ground
from cosfly.runtime.errors import InputError, nearest
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import MISSING, FileFormat, Record, check_schema, dump_json, read_json, validated

BOXES_FORMAT = FileFormat("cosfly.boxes_3d", "1.0", "map")
MAP_MB = 4_096  # 15 million boxes; ten million took 2.7 GB as they are written
AXES = "right-handed, metres, x east, y north, z up; degrees"
# How far a given corner may be from the computed one: exporters round, and turn boxes in single precision.
CORNER_M = 0.05
# Written from the boxes, never carried.
COMPUTED = {"schema", "schema_version", "axes", "bounds", "num_boxes", "counts"}
ARRAYS = ("centers", "half_extents", "rotations_deg", "kinds", "ids")  # of a BoxMap, one row a box

UNKNOWN_LICENCE, OUR_LICENCE = "unknown", "apache-2.0"  # the latter: of maps that cosfly invents
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


def _licence_id(text: str) -> str:
    if not re.fullmatch(r"[a-z0-9][a-z0-9.+-]*", text):
        raise ValueError("not a licence identifier as the hub spells it (cc-by-4.0, apache-2.0); words go into credits")
    return text


LicenceId = Annotated[str, AfterValidator(_licence_id)]


class _Kept(BaseModel):
    """Base of records that keep foreign keys."""

    model_config = ConfigDict(extra="allow", frozen=True, populate_by_name=True)


class MapSource(_Kept):
    """The tool, and the file or seed, of a map."""

    tool: str = ""
    version: str = ""
    file: str = ""
    seed: int = 0


class SimplifyPass(_Kept):
    """Boxes after one pass of step 2; the first entry of a list is the input."""

    name: str = Field(alias="pass")
    counts: dict[str, int]


Height = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]


class GroundGrid(Record):
    """Sloping ground in the map header. heights_m: rows from south to north, each from west to east."""

    west_m: Height
    south_m: Height
    cell_m: float = Field(gt=0, le=LARGEST)
    heights_m: list[list[Height]] = Field(min_length=2)

    @model_validator(mode="after")
    def _rows_are_even(self) -> GroundGrid:
        lengths = {len(row) for row in self.heights_m}
        if len(lengths) != 1 or lengths.pop() < 2:
            raise ValueError("the rows of heights_m are not of one length of at least two")
        return self

    def ground(self) -> Ground:
        return Ground(np.array(self.heights_m, dtype=np.float64), self.west_m, self.south_m, self.cell_m)

    @classmethod
    def of(cls, ground: Ground) -> GroundGrid:
        """Return the record of a ground, heights to a millimetre."""
        rows = np.round(ground.heights_m, 3).tolist()
        return cls(west_m=ground.west_m, south_m=ground.south_m, cell_m=ground.cell_m, heights_m=rows)


class MapHeader(_Kept):
    """The header of a map; fields that are not set are not written.

    ground_z_m: height of flat ground; where it slopes, `ground` holds the heights. All stages use `BoxMap.ground`.
    """

    name: str = "map"
    source: MapSource = MapSource()
    licence: LicenceId = UNKNOWN_LICENCE
    credits: str = ""  # who must be named, one sentence or more
    ground_z_m: float = Field(0.0, ge=-LARGEST, le=LARGEST)
    ground: GroundGrid | None = None
    extent_sources: dict[str, int] = {}  # where a box's size comes from -> boxes
    roads: dict[str, float] = {}
    added_boxes: int = 0  # boxes that the source does not hold
    derived_ground: int = 0  # of these, ground that was derived from the buildings
    offset_m: dict[str, float] = {}  # from this map's coordinates to the source's
    building_footprint_m2: float | None = None
    building_area_ratio: float | None = None
    building_covered_share: float | None = None
    num_objects: int | None = None  # of the source, those that were dropped included
    dropped_objects: dict[str, int] = {}
    passes: list[SimplifyPass] = []
    simplify: dict[str, Any] = {}  # the settings of step 2


@dataclass(frozen=True)
class BoxMap:
    """A map of boxes, the product of stages 1 and 2.

    centers, half_extents: (n, 3) float64, m. rotations_deg: (n, 3) float64: pitch, yaw, roll. kinds: (n,) uint8, KINDS.
    ids: (n,) uint64, unique and stable. meshes: what some boxes are drawn as; none in simplified maps.
    """

    centers: np.ndarray
    half_extents: np.ndarray
    rotations_deg: np.ndarray
    kinds: np.ndarray
    ids: np.ndarray
    header: MapHeader = field(default_factory=MapHeader)
    meshes: Meshes = field(default_factory=Meshes)

    def __len__(self) -> int:
        return len(self.centers)

    @property
    def name(self) -> str:
        return self.header.name

    @cached_property
    def ground(self) -> Ground:
        """The height of the ground, everywhere."""
        return self.header.ground.ground() if self.header.ground else Ground.flat(self.header.ground_z_m)

    @property
    def mins(self) -> np.ndarray:
        """(n, 3) low corners of the axis-aligned boxes round the rotated ones."""
        return self.centers - axis_aligned_half_extents(self.half_extents, self.rotations_deg)

    @property
    def maxs(self) -> np.ndarray:
        return self.centers + axis_aligned_half_extents(self.half_extents, self.rotations_deg)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the low and high corners of all boxes, (3,) each."""
        return self.mins.min(axis=0), self.maxs.max(axis=0)

    def select(self, index: np.ndarray) -> BoxMap:
        """Return the boxes at an index or mask, header unchanged."""
        return replace(self, **{name: getattr(self, name)[index] for name in ARRAYS})

    def joined(self, other: BoxMap) -> BoxMap:
        """Return these boxes and then the other's, under this header."""
        both: dict[str, Any] = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in ARRAYS}
        return replace(self, **both)

    def is_any_of(self, kinds: Collection[int]) -> np.ndarray:
        """Return which boxes are of one of some kinds, (n,) bool."""
        return np.isin(self.kinds, np.array(sorted(kinds), dtype=np.uint8))

    def counts(self) -> dict[str, int]:
        """Return the number of boxes by kind name, largest first."""
        numbers, counts = np.unique(self.kinds, return_counts=True)
        order = np.argsort(-counts, kind="stable")
        return {KIND_NAMES[int(numbers[k])]: int(counts[k]) for k in order}


def make_box_map(
    centers: Any, half_extents: Any, rotations_deg: Any, kinds: Any, ids: Any = None, header: MapHeader | None = None
) -> BoxMap:
    """Make a BoxMap from anything array-like; ids default to 1..n."""
    vectors = [np.asarray(rows, dtype=np.float64).reshape(-1, 3) for rows in (centers, half_extents, rotations_deg)]
    ids = np.asarray(np.arange(1, len(vectors[0]) + 1) if ids is None else ids, dtype=np.uint64).reshape(-1)
    kinds = np.asarray(kinds, dtype=np.uint8).reshape(-1)
    return BoxMap(vectors[0], vectors[1], vectors[2], kinds, ids, header or MapHeader())


def check_boxes(box_map: BoxMap, where: str | Path) -> None:
    """Check finite numbers, extents, kinds and ids."""
    columns = (box_map.centers, box_map.half_extents, box_map.rotations_deg)
    checks = [
        ("a box is not finite", name, rows, ~(np.abs(rows) <= LARGEST), "finite numbers")  # NaN is not
        for name, rows in zip(("center", "extent", "rotation"), columns, strict=True)
    ]
    half = box_map.half_extents
    checks.append(("a box has a negative extent", "extent", half, half < 0, "half sizes of at least 0 m"))
    for what, name, rows, is_bad, expected in checks:
        for row in np.flatnonzero(is_bad.any(axis=1)):
            place, got = f"{where}: box {box_map.ids[row]}: {name}", str(rows[row].tolist())
            raise InputError(what, where=place, got=got, expected=expected)
    unknown = [int(kind) for kind in np.unique(box_map.kinds) if int(kind) not in KIND_NAMES]
    if unknown:
        raise InputError("unknown semantic id", where=where, got=str(unknown[0]), expected="0 to 28")
    ids, counts = np.unique(box_map.ids, return_counts=True)
    if (counts > 1).any():
        raise InputError("a box id occurs more than once", where=where, got=str(ids[counts > 1][0]))


def check_ground(box_map: BoxMap, path: Path) -> None:
    """Check that a map has ground: a height, a grid of heights, or a box of it."""
    given = box_map.header.model_fields_set & {"ground_z_m", "ground"}
    if not given and not box_map.is_any_of(GROUND_KINDS).any():
        what, got = "the map has no ground", "neither ground_z_m nor heights in the header, and no box of the ground"
        fix = "put ground_z_m into the header, or boxes of Roads, Sidewalks, Terrain or Ground"
        raise InputError(what, where=path, got=got, expected="where people stand", fix=fix)


class _Box(BaseModel):
    """A box of a file; fields with a default follow from the others and are compared with them."""

    model_config = ConfigDict(strict=True, extra="forbid")  # no numbers in quotes

    type: str
    id: int = Field(ge=0, lt=2**64)
    center: Vector
    extent: Vector
    rotation: Vector
    semantic_id: int | None = None
    color: str | None = None
    min: Vector | None = None
    max: Vector | None = None
    mesh: MeshRef | None = None

    @field_validator("type")
    @classmethod
    def _is_known(cls, name: str) -> str:
        if name not in KINDS:
            raise ValueError(f"unknown type{nearest(name, KINDS)}, expected a CityObjectLabel name")
        return name


class _Boxes(BaseModel):
    boxes: list[_Box]


def write_boxes(path: Path, box_map: BoxMap) -> None:
    """Write boxes in the paper's fields (tab:boxes_schema), one box a line; meshes in `meshes.glb` next to them."""
    check_boxes(box_map, path)
    refs = box_map.meshes.relative_to(path.parent).refs
    columns = {name: np.round(getattr(box_map, name), 6) for name in ("centers", "half_extents", "rotations_deg")}
    box_map = replace(box_map, **columns)  # so that min and max agree with what is read back
    mins, maxs = box_map.mins, box_map.maxs
    low, high = box_map.bounds() if len(box_map) else (np.zeros(3), np.zeros(3))
    fields = box_map.header.model_dump(mode="json", by_alias=True, exclude_unset=True)
    last: dict[str, Any] = {name: fields.pop(name) for name in ("passes", "simplify", "ground") if name in fields}
    heights = last.pop("ground", None)
    header = BOXES_FORMAT.header | fields | {
        "axes": AXES, "bounds": {"min": rounded(low), "max": rounded(high)}, "num_boxes": len(box_map),
        "counts": box_map.counts(),
    } | last  # fmt: skip
    lines = []
    for i, (number, box_id) in enumerate(zip(box_map.kinds.tolist(), box_map.ids.tolist(), strict=True)):
        kind, mesh = KIND_NAMES[number], refs.get(box_id)
        vectors = {
            "center": box_map.centers[i], "extent": box_map.half_extents[i], "rotation": box_map.rotations_deg[i],
            "min": mins[i], "max": maxs[i],
        }  # fmt: skip
        box = {"type": kind, "semantic_id": number, "color": KIND_COLORS[kind], "id": box_id}
        box |= {name: rounded(vector) for name, vector in vectors.items()}
        lines.append(dump_json(box if mesh is None else box | {"mesh": mesh.model_dump(exclude_none=True)}))
    ground = f',\n "ground": {dump_json(heights)}' if heights else ""
    text = dump_json(header, indent=1)[:-2] + ground + ',\n "boxes": [\n' + ",\n".join(lines) + "\n]}\n"
    write_bytes(path, text.encode())


def read_boxes(path: Path) -> BoxMap:
    """Read `boxes_3d.json` or `step2_simplified.json`; also a bare list of boxes, as the paper's exporter writes."""
    if path.suffix.lower() in (".csv", ".geojson"):
        fix = f"cosfly maps --source boxes --set maps.boxes.path={path} --out DIR makes boxes_3d.json of it"
        raise InputError("boxes of one's own, not a map yet", where=path, fix=fix)
    value = read_json(path, what=BOXES_FORMAT.what, most_mb=MAP_MB)
    header = MapHeader(name=path.stem)
    records: Any = value
    if not isinstance(value, list):
        records = check_schema(value, BOXES_FORMAT, path).pop("boxes", None)
        header = validated(MapHeader, {key: field for key, field in value.items() if key not in COMPUTED}, path)
        if records is None:
            raise InputError(MISSING, where=f"{path}: boxes", expected="a list")
        if not isinstance(records, list):
            raise InputError("no list of boxes", where=f"{path}: boxes", got=type(records).__name__, expected="a list")
    if not records:
        raise InputError("the map holds no boxes", where=path, fix="check the source, or the stage that made it")
    boxes = validated(_Boxes, {"boxes": records}, path).boxes
    centers, extents, rotations = ([getattr(box, name) for box in boxes] for name in ("center", "extent", "rotation"))
    kinds, ids = [KINDS[box.type] for box in boxes], [box.id for box in boxes]
    refs = {box.id: box.mesh for box in boxes if box.mesh is not None}
    box_map = make_box_map(centers, extents, rotations, kinds, ids, header)
    box_map = replace(box_map, meshes=Meshes(refs, path.parent))
    check_boxes(box_map, path)
    _check_computed(value if isinstance(value, dict) else {}, boxes, box_map, path)
    return box_map


def _check_computed(header: dict[str, Any], boxes: list[_Box], box_map: BoxMap, path: Path) -> None:
    """Compare derived fields of a file with its boxes; other axes or units would not agree."""
    for name, follows in (("axes", AXES), ("num_boxes", len(box_map)), ("counts", box_map.counts())):
        if header.get(name, follows) != follows:
            got, expected = str(header[name])[:200], str(follows)[:200]
            raise InputError("not what its boxes are", where=f"{path}: {name}", got=got, expected=expected)
    for box in boxes:
        if box.semantic_id not in (None, KINDS[box.type]):
            where, expected = f"{path}: box {box.id}: semantic_id", f"{KINDS[box.type]}, {box.type}"
            raise InputError("not the number of its type", where=where, got=box.semantic_id, expected=expected)
    for name, corners in (("min", box_map.mins), ("max", box_map.maxs)):
        given = np.array([getattr(box, name) or [np.nan] * 3 for box in boxes])  # NaN is not off
        for row in np.flatnonzero((np.abs(given - corners) > CORNER_M + 1e-6 * np.abs(corners)).any(axis=1)):
            what, where = "does not follow from center, extent and rotation", f"{path}: box {boxes[row].id}: {name}"
            fix = "extent is half the size, in metres; rotation is pitch, yaw, roll in degrees"
            got, expected = str(given[row].tolist()), str(rounded(corners[row]))
            raise InputError(what, where=where, got=got, expected=expected, fix=fix)
