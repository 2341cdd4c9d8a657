"""Numbers in running text, in digits, with the units behind them, in English and Chinese."""

import re
from dataclasses import dataclass
from functools import cache

from caption.verification.glossary import Unit, stands_at, written_units
from cosfly.formats.captions import Language

_NO_UNIT = Unit("", 1.0)


@dataclass(frozen=True, slots=True)
class Numeral:
    """A number of a text in our units."""

    text: str
    value: float
    unit: str  # a key of the glossary's units, "" if no unit stands behind the number
    digits: int  # after the point, as written
    factor: float = 1.0  # from the unit that is written to ours
    bound: int = 0  # 1 of "more than 20 m", -1 of "less than 20 m"
    is_about: bool = False  # written as approximate
    start: int = 0  # position in the text

    @property
    def half(self) -> float:
        """Half a unit of the last digit, in our unit."""
        return 0.5 * 10.0**-self.digits * self.factor


# "Speed per hour" or "in each hour" shortly before a number: 时速 26 公里 is 26 km/h.
_HOURLY = re.compile(r"(?:时速|每小时)[^，。；]{0,4}$")
_SQUARED = re.compile(r"\s?(?:²|\^2|\*\*2|/s\b)")  # an acceleration
_DIGITS = r"(?:(?<![A-Za-z0-9_.])|(?<=\d[x×]))[-+−]?\d+(?:\.\d+)?(?!\d)"


@cache
def _pattern(language: Language) -> re.Pattern[str]:
    # A unit in letters ends where the word does: "3 m", but not "3 more".
    spellings = "|".join(re.escape(spelling) for spelling in sorted(written_units(language), key=len, reverse=True))
    unit = f"(?P<unit>{spellings})(?:(?<=[^A-Za-z])|(?![A-Za-z]))"
    english, chinese = rf"(?:\s*[- ]?{unit})?", rf"\s*个?(?:{unit})?(?P<half>半(?![秒步帧]))?"
    return re.compile(f"(?P<digits>{_DIGITS}){english if language == 'en' else chinese}", re.IGNORECASE)


def read_numerals(text: str, language: Language) -> list[Numeral]:
    """Find the numbers of a text in digits. Counts ("5 frames") are not among them; durations are, in seconds."""
    units = written_units(language)
    numerals: list[Numeral] = []
    for match in _pattern(language).finditer(text):
        spelling = match["unit"] or ""
        unit, factor = units.get(spelling.lower(), _NO_UNIT)
        before, after = text[: match.start()], text[match.end() :]
        if spelling in ("×", "x") and after.lstrip()[:1].isdigit():
            unit, factor = _NO_UNIT  # of a product, "34 × 59 px"
        if unit == "frames" or _SQUARED.match(after):
            continue
        if language == "zh" and unit in ("m", "deg") and "每秒" in re.split("[，；。：、,;:]", before)[-1]:
            unit = {"m": "mps", "deg": "dps"}[unit]
        if language == "zh" and (unit, factor) == ("m", 1000.0) and _HOURLY.search(before):
            unit, factor = "mps", 1 / 3.6
        half = 0.5 if match.groupdict().get("half") else 0.0
        number = match["digits"].replace("−", "-")
        digits, value = len(number.partition(".")[2]), abs(float(number)) + half
        if not unit and digits == 0 and value < 10 and not half and number[0] not in "+-":
            continue  # a count
        bound = -1 if stands_at("less", before, after, language) else 0
        if stands_at("more", before, after, language):
            bound = 1
        is_about, written = stands_at("about", before, after, language), match.group().strip()
        numerals.append(Numeral(written, value * factor, unit, digits, factor, bound, is_about, match.start()))
    return numerals
