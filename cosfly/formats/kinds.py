"""Categories of boxes and pixels: CARLA's CityObjectLabel names, numbers and colours."""

# CARLA 0.9.16 CityObjectLabel: name -> number. Numbers differ between CARLA versions, so sources are mapped by name.
KINDS: dict[str, int] = {
    "NONE": 0, "Roads": 1, "Sidewalks": 2, "Buildings": 3, "Walls": 4, "Fences": 5, "Poles": 6, "TrafficLight": 7,
    "TrafficSigns": 8, "Vegetation": 9, "Terrain": 10, "Sky": 11, "Pedestrians": 12, "Rider": 13, "Car": 14,
    "Truck": 15, "Bus": 16, "Train": 17, "Motorcycle": 18, "Bicycle": 19, "Static": 20, "Dynamic": 21, "Other": 22,
    "Water": 23, "RoadLines": 24, "Ground": 25, "Bridge": 26, "RailTrack": 27, "GuardRail": 28,
}  # fmt: skip
KIND_NAMES = {number: name for name, number in KINDS.items()}

# CARLA's own palette (CityScapes), so that masks look as its users expect; index = kind.
KIND_COLORS: dict[str, str] = {
    "NONE": "#000000", "Roads": "#804080", "Sidewalks": "#f423e8", "Buildings": "#464646", "Walls": "#66669c",
    "Fences": "#be9999", "Poles": "#999999", "TrafficLight": "#faaa1e", "TrafficSigns": "#dcdc00",
    "Vegetation": "#6b8e23", "Terrain": "#98fb98", "Sky": "#4682b4", "Pedestrians": "#dc143c", "Rider": "#ff0000",
    "Car": "#00008e", "Truck": "#000046", "Bus": "#003c64", "Train": "#005064", "Motorcycle": "#0000e6",
    "Bicycle": "#770b20", "Static": "#6ebea0", "Dynamic": "#aa7832", "Other": "#375a50", "Water": "#2d3c96",
    "RoadLines": "#9dea32", "Ground": "#510051", "Bridge": "#966464", "RailTrack": "#e6968c", "GuardRail": "#b4a5b4",
}  # fmt: skip

# Surfaces on which people and cars stand: never an obstacle, even if they are thick.
GROUND_KINDS = frozenset(KINDS[name] for name in ("Roads", "Sidewalks", "Terrain", "RoadLines", "Ground", "RailTrack"))
PAVED_KINDS = frozenset(KINDS[name] for name in ("Roads", "Sidewalks", "Ground"))
# Of surfaces in one plane the one of the higher layer is seen, and walked on; bare ground is layer 0.
LAYERS = {"Terrain": 1, "Ground": 2, "Water": 2, "Roads": 3, "RailTrack": 4, "RoadLines": 5, "Sidewalks": 6}
# Never removed for lying low: carriageways, lawns, canals and decks of bridges may lie below z = 0.
SURFACE_KINDS = GROUND_KINDS | {KINDS["Water"], KINDS["Bridge"]}
