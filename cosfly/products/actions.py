"""The closed set of decisions, `actions.yaml`: tokens, names in both languages, and the rules by which a motion shows
them.

One set ships, the paper's; another file of the same form may stand in its place (`caption.actions`), and what was made
with it says so: `actions.json` beside captions, the records of training sets, evaluations and releases. How rules are
measured lives in caption/truth/actions.py.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

from pydantic import BeforeValidator, Field, WrapSerializer, field_validator, model_validator

from cosfly.errors import ConfigError, InputError, nearest
from cosfly.reading.documents import FileFormat, read_model
from cosfly.reading.files import read_bytes
from cosfly.work.config import Config, build, read_yaml
from cosfly.work.store import write_bytes, write_model

ACTIONS_FILE = Path(__file__).with_name("actions.yaml")
ACTIONS_FORMAT = FileFormat("cosfly.actions", "1.0", "actions")
OWN_ACTIONS = "actions.json"  # beside `captions.jsonl`, where the set is not the one that ships

MOST_ACTIONS, MOST_TOKEN_CHARACTERS = 100, 40
_TOKEN = re.compile(r"[a-z]+(?:_[a-z]+)*")
RESERVED = ("none",)  # tables call so what is not there

# What of a motion is measured: see Motion in caption/truth/actions.py. ordered: 1 where the mission orders the action.
MEASURES = (
    "yaw_deg", "altitude_m", "mean_speed_mps", "speed_change_mps", "forward_gain_mps", "forward_m", "left_m",
    "approach_m", "closing_m", "sweep_deg", "target_path_m", "visible_now", "visible_share", "ordered",
)  # fmt: skip
# In front of a threshold that is a setting of `caption.label` (caption/schema.py); its settings are:
SETTING = "label."
THRESHOLDS = (
    "yaw_deg", "hard_turn_deg", "altitude_m", "speed_change_mps", "hover_mps", "moving_mps", "forward_m", "lateral_m",
    "approach_m", "circle_deg",
)  # fmt: skip

T = TypeVar("T")

_TERM = re.compile(
    r"(?P<sign>-?)\s*(?:(?P<factor>\d+(?:\.\d+)?)\s*\*\s*)?"
    r"(?:\|(?P<size>[a-z_]+)\||(?P<name>[a-z_]+(?:\.[a-z_]+)?)|(?P<number>\d+(?:\.\d+)?))"
)
_CONDITION = re.compile(r"(?P<left>[^<>=]+?)\s*(?P<how><=|>=|<|>)\s*(?P<right>[^<>=]+)")


def _each(read: Callable[[str], T], texts: Iterable[str]) -> list[T]:
    """Read each of some texts; says of all at once what is wrong."""
    found, problems = list[T](), list[str]()
    for text in texts:
        try:
            found.append(read(text))
        except ValueError as error:
            problems.append(str(error))
    if problems:
        raise ValueError("; ".join(problems))
    return found


class Term:
    """A value of a rule: `factor` times a measure, its size or a setting; times 1 for a number alone (name None)."""

    def __init__(self, text: str) -> None:
        found = _TERM.fullmatch(text.strip())
        if found is None or (found["number"] and found["factor"]):
            raise ValueError(f"{text.strip()!r} is no measure, setting or number, as in -0.5 * |left_m|")
        self.name: str | None = found["size"] or found["name"]
        self.is_size = found["size"] is not None
        self.factor = (-1.0 if found["sign"] else 1.0) * float(found["factor"] or found["number"] or 1.0)
        self.setting = self.name[len(SETTING) :] if self.name and self.name.startswith(SETTING) else None
        if self.setting is not None and self.setting not in THRESHOLDS:
            near = nearest(self.setting, THRESHOLDS)
            raise ValueError(f"no threshold {self.name!r}{near}; there are {', '.join(THRESHOLDS)}, or a number")
        if self.name is not None and self.setting is None and self.name not in MEASURES:
            near = nearest(self.name, MEASURES)
            raise ValueError(f"{self.name!r} is not measured{near}; there are {', '.join(MEASURES)}")


class Condition:
    """Two terms and how they must compare: <, <=, > or >=."""

    def __init__(self, text: str) -> None:
        found = _CONDITION.fullmatch(text.strip())
        if found is None:
            raise ValueError(f"{text!r} compares nothing, as in |yaw_deg| < label.yaw_deg")
        self.how = found["how"]
        self.left, self.right = _each(Term, (found["left"], found["right"]))


class Size:
    """A term in units of a threshold, which is a setting or a number."""

    def __init__(self, text: str) -> None:
        term, stroke, unit = text.partition("/")
        if not stroke:
            raise ValueError(f"{text!r} has no threshold, as in yaw_deg / label.yaw_deg")
        self.term, self.unit = _each(Term, (term, unit))
        if self.unit.factor <= 0 or (self.unit.name is not None and self.unit.setting is None):
            raise ValueError(f"{text!r}: the threshold must be a number over 0, or a setting of {SETTING}*")


class Rule(Config):
    """How much of an action a motion has, in units of its own threshold: the least of its sizes that can be measured,
    and nothing where a condition fails. Without sizes 1 where the conditions hold, else -1."""

    size: tuple[str, ...] = Field(
        (), max_length=8, description="terms in units of a threshold; the least of them counts"
    )
    where: tuple[str, ...] = Field((), max_length=16, description="conditions that must all hold")
    unless: tuple[str, ...] = Field(
        (), max_length=16, description="conditions of which one must fail, or be of what nobody knows"
    )

    @field_validator("size")
    @classmethod
    def _are_sizes(cls, texts: tuple[str, ...]) -> tuple[str, ...]:
        _each(Size, texts)
        return texts

    @field_validator("where", "unless")
    @classmethod
    def _are_conditions(cls, texts: tuple[str, ...]) -> tuple[str, ...]:
        _each(Condition, texts)
        return texts

    @model_validator(mode="after")
    def _says_something(self) -> Self:
        if not (self.size or self.where or self.unless):
            raise ValueError("a rule needs a size, where or unless")
        return self

    def terms(self) -> Iterator[Term]:
        for size in map(Size, self.size):
            yield from (size.term, size.unit)
        for condition in map(Condition, (*self.where, *self.unless)):
            yield from (condition.left, condition.right)


class Both(Config):
    en: str = Field(min_length=1, max_length=400, description="English")
    zh: str = Field(min_length=1, max_length=400, description="Chinese")


class Action(Config):
    """One action of the set."""

    group: str = Field(min_length=1, max_length=40, description="the heading under which tables show it")
    en: str = Field(
        min_length=2,
        max_length=80,
        pattern=r"^[a-z][a-z' -]*$",
        description="its name in running English, an infinitive",
    )
    zh: str = Field(min_length=1, max_length=40, description="its name in running Chinese")
    reason: Both = Field(
        description="a sentence that justifies it and claims nothing measurable; the rule teacher writes it"
    )
    shown: Rule = Field(description="how much of it a motion has, negative for its opposite")
    implied: Rule | None = Field(None, description="what makes it the label, from 1 on; null: nothing does")
    contradicted_below: float | None = Field(
        None, description="of `shown`: less contradicts the decision; null takes caption.label.absent_share"
    )
    reads_like: str | None = Field(
        None, description="an action that ships, whose words in texts (climbing, braking ...) speak of this one too"
    )

    @property
    def is_order(self) -> bool:
        """Whether missions order it and geometry never implies it."""
        return self.implied is not None and any(term.name == "ordered" for term in self.implied.terms())


class ActionSet(Config):
    """The whole file."""

    actions: dict[str, Action] = Field(
        min_length=2, max_length=MOST_ACTIONS, description="token -> the action, in the order of prompts and tables"
    )
    precedence: tuple[tuple[str, ...], ...] = Field(
        description="tokens: of the first line in which one is implied the most implied is the label"
    )
    terms: tuple[Both, ...] = Field(
        (), max_length=500, description="words that a translation must have beside the actions' names"
    )

    @model_validator(mode="after")
    def _is_one_set(self) -> Self:
        form = f"words of small letters joined by _, at most {MOST_TOKEN_CHARACTERS}, and not {', '.join(RESERVED)}"
        problems = [
            f"{token!r} is no token: {form}"
            for token in self.actions
            if not _TOKEN.fullmatch(token) or len(token) > MOST_TOKEN_CHARACTERS or token in RESERVED
        ]
        for what, names in (
            ("letters", [token.replace("_", "") for token in self.actions]),
            ("English name", [action.en for action in self.actions.values()]),
            ("Chinese name", [action.zh for action in self.actions.values()]),
        ):
            problems += [
                f"two actions have one {what}: {name}" for name in sorted({n for n in names if names.count(n) > 1})
            ]
        listed = [token for line in self.precedence for token in line]
        problems += [
            f"precedence names {token!r}, which is no action{nearest(token, self.actions)}"
            for token in listed
            if token not in self.actions
        ]
        problems += [f"precedence names {token} twice" for token in sorted({t for t in listed if listed.count(t) > 1})]
        problems += [
            f"{token} is implied by something and stands in no line of precedence"
            for token in self.actions
            if self.actions[token].implied and token not in listed
        ]
        kin = {token: action.reads_like for token, action in self.actions.items() if action.reads_like is not None}
        problems += [
            f"{token} reads like {like!r}, which does not ship{nearest(like, shipped_actions().tokens)}"
            for token, like in kin.items()
            if like not in shipped_actions().tokens
        ]
        if problems:
            raise ValueError("; ".join(problems))
        return self

    def __hash__(self) -> int:
        return hash(self.tokens)

    @cached_property
    def tokens(self) -> tuple[str, ...]:
        """The tokens in the order of schemas and of every table."""
        return tuple(self.actions)

    @cached_property
    def by_letters(self) -> dict[str, str]:
        return {token.replace("_", ""): token for token in self.actions}

    def kin_of(self, token: str) -> str:
        """Give the action that ships whose words in texts speak of this one; the token itself where nobody says."""
        action = self.actions.get(token)
        return (action.reads_like if action else None) or token


class _ActionsFile(ActionSet):
    """With what says which file it is."""

    schema_: str = Field(alias="schema", pattern=f"^{ACTIONS_FORMAT.schema}$", description=ACTIONS_FORMAT.schema)
    schema_version: str = Field(pattern=f"^{re.escape(ACTIONS_FORMAT.version)}$", description="version of this form")


def read_actions(path: Path) -> ActionSet:
    """Read a file of actions."""
    found = build(_ActionsFile, read_yaml(path), path)
    return ActionSet.model_construct(**{name: getattr(found, name) for name in ActionSet.model_fields})


@cache
def shipped_actions() -> ActionSet:
    """Give the set that ships."""
    return read_actions(ACTIONS_FILE)


def _or_shipped(value: Any) -> Any:
    return shipped_actions() if value is None else value


def _unless_shipped(actions: ActionSet, write: Callable[[ActionSet], Any]) -> Any:
    return None if actions == shipped_actions() else write(actions)


# As records have it: null for the set that ships.
RecordedActions = Annotated[ActionSet, BeforeValidator(_or_shipped), WrapSerializer(_unless_shipped)]


def export_actions(path: Path) -> None:
    """Write the file that ships, to begin with."""
    if path.exists() or path.is_symlink():
        raise ConfigError("there is something already", where=path, fix="choose another file")
    write_bytes(path, read_bytes(ACTIONS_FILE))


# --- beside what was made with it -------------------------------------------------------------------------------------


def write_own_actions(folder: Path, actions: ActionSet) -> list[Path]:
    """Put a set beside the captions that were made with it; nothing where it is the one that ships."""
    if actions == shipped_actions():
        return []
    write_model(folder / OWN_ACTIONS, actions, ACTIONS_FORMAT)
    return [folder / OWN_ACTIONS]


def actions_beside(captions: Path) -> ActionSet:
    """Give the set that captions were made with."""
    path = captions.parent / OWN_ACTIONS
    if not path.is_file():
        return shipped_actions()
    return read_model(path, ActionSet, ACTIONS_FORMAT, tree=path.parent)


def not_in_set(token: object, where: object, actions: ActionSet) -> InputError:
    """Give the error of a decision that is none of a set."""
    what, expected = "not an action of the closed set", f"one of {', '.join(actions.tokens)}"
    fix = f"captions of a set of their own have {OWN_ACTIONS} beside them: keep both together"
    return InputError(what, where=str(where), got=str(token), expected=expected, fix=fix)


def one_set(sets: Iterable[tuple[object, ActionSet]]) -> ActionSet:
    """Give the one set that all were made with. sets: whose, and which; one at least."""
    found = list(sets)
    for whose, one in found[1:]:
        if one != found[0][1]:
            differ = sorted(set(one.tokens) ^ set(found[0][1].tokens))
            got = f"another one than {found[0][0]}" + (f": {', '.join(differ)}" if differ else ", of the same tokens")
            what, fix = "different sets of actions", "caption them with one file (caption.actions), or use them apart"
            raise InputError(what, where=str(whose), got=got, expected="one set in all of them", fix=fix)
    return found[0][1]
