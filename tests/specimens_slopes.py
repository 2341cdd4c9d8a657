"""A city on ground that slopes. Made by us; no foreign material."""

import numpy as np

CITY_EAST_M, CITY_NORTH_M, CITY_LOW_M = 2000.0, 340_000.0, 28.0
CITY_SIZE_M = (240.0, 200.0)


def city_height_m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height over the datum in a city that rises 18 m to the north-west, bent a little."""
    across = (CITY_SIZE_M[0] - x + y) / (CITY_SIZE_M[0] + CITY_SIZE_M[1])
    return CITY_LOW_M + 18.0 * across + 0.6 * np.sin(x / 30.0)


class _Vertices:
    def __init__(self) -> None:
        self.rows: list[list[int]] = []

    def add(self, x: float, y: float, z: float) -> int:
        self.rows.append([round(1000 * x), round(1000 * y), round(1000 * z)])
        return len(self.rows) - 1

    def sheet(self, low: tuple[float, float], high: tuple[float, float], step_m: float) -> list:
        xs, ys = (np.linspace(low[k], high[k], max(2, round((high[k] - low[k]) / step_m) + 1)) for k in (0, 1))
        number = np.array([[self.add(x, y, float(city_height_m(x, y))) for x in xs] for y in ys])
        a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
        return [
            [[int(k) for k in t]]
            for three in ((a, b, c), (a, c, d))
            for t in zip(*(v.ravel() for v in three), strict=True)
        ]

    def house(self, x: float, y: float, size: tuple[float, float], height: float) -> list:
        """The outer shell of a flat-roofed house that stands on its lowest foot."""
        corners = [(x, y), (x + size[0], y), (x + size[0], y + size[1]), (x, y + size[1])]
        foot = min(float(city_height_m(*corner)) for corner in corners)
        k = [self.add(*corner, z) for z in (foot, foot + height) for corner in corners]
        faces = ([3, 2, 1, 0], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7])
        return [[[k[i] for i in face]] for face in faces]


def sloped_city(*, terrain: bool = True, streets: bool = True) -> dict:
    """A CityJSON 2.0 quarter of sixteen houses on the slope; without terrain and streets only feet tell of it."""
    vertices, objects = _Vertices(), {}
    for row in range(4):
        for column in range(4):
            shell = vertices.house(
                20.0 + 55.0 * column, 15.0 + 45.0 * row, (30.0, 22.0), 9.0 + 2.0 * ((row + column) % 3)
            )
            solid = {"type": "Solid", "lod": "1.2", "boundaries": [shell]}
            objects[f"house {row} {column}"] = {"type": "Building", "geometry": [solid]}
    if terrain:
        sheet = {"type": "CompositeSurface", "lod": "1", "boundaries": vertices.sheet((0.0, 0.0), CITY_SIZE_M, 10.0)}
        objects["terrain"] = {"type": "TINRelief", "geometry": [sheet]}
    for row in range(3 if streets else 0):
        y = 43.0 + 45.0 * row
        sheet = {
            "type": "MultiSurface", "lod": "1", "boundaries": vertices.sheet((0.0, y), (CITY_SIZE_M[0], y + 8.0), 8.0),
        }  # fmt: skip
        objects[f"street {row}"] = {"type": "Road", "geometry": [sheet]}
    if streets:
        wall = vertices.sheet((5.0, 20.0), (5.6, 180.0), 5.0)
        objects["wall"] = {
            "type": "GenericCityObject", "attributes": {"bgt_type": "muur"},
            "geometry": [{"type": "MultiSurface", "lod": "1", "boundaries": wall}],
        }  # fmt: skip
        for triangle in wall:  # a metre and a half high
            for k in triangle[0]:
                vertices.rows[k][2] = round(
                    1000 * (float(city_height_m(*(c / 1000 for c in vertices.rows[k][:2]))) + 1.5)
                )
    return {
        "type": "CityJSON", "version": "2.0", "vertices": vertices.rows, "CityObjects": objects,
        "transform": {"scale": [0.001] * 3, "translate": [CITY_EAST_M, CITY_NORTH_M, 0.0]},
    }  # fmt: skip
